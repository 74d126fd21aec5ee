"""Annotations say what values are: a bare ``Any`` is rare, and has its reason beside it. That types fit is for mypy to find."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("shadowmap_dr", "mitsuba_baselines")
#: Most annotations that may be a bare ``Any``.
SHARE = 0.03


def annotations(tree: ast.Module) -> list[ast.expr]:
    found: list[ast.expr | None] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            own = node.args
            arguments = [*own.posonlyargs, *own.args, *own.kwonlyargs, own.vararg, own.kwarg]
            found += [argument.annotation for argument in arguments if argument is not None] + [node.returns]
        elif isinstance(node, ast.AnnAssign):
            found.append(node.annotation)
    return [annotation for annotation in found if annotation is not None]


def test_few_annotations_are_a_bare_any_and_each_has_its_reason() -> None:
    count, bare, without = 0, 0, []
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        for annotation in annotations(ast.parse(text)):
            count += 1
            if isinstance(annotation, ast.Name) and annotation.id == "Any":
                bare += 1
                near = "\n".join(lines[max(0, annotation.lineno - 6) : annotation.lineno + 1])
                if "Any:" not in near.replace(": Any:", ""):
                    without.append(f"{path.relative_to(ROOT)}:{annotation.lineno}")
    assert count > 5000
    assert bare <= SHARE * count
    assert not without, "give the reason in a comment '# Any: ...': " + ", ".join(without)
