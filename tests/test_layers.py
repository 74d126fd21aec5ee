"""Layers of the package: which packages may import which others. Read from the sources; nothing is imported.

``python tests/test_layers.py`` prints the picture in docs/architecture.md.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("shadowmap_dr", "mitsuba_baselines")

#: Package -> what it may import of the others: packages, or modules of theirs. "" is the package itself, for its version.
MAY_IMPORT = {
    "errors": (),
    "_llvm": ("errors",),
    "variants": ("errors",),
    "jit": (),
    "io": ("", "_llvm", "errors"),
    "raster": ("jit",),
    "shadow": ("jit", "raster"),
    "scene": ("errors", "jit"),
    "scene.lights": ("errors", "jit", "shadow.light_camera"),
    "rendering": ("errors", "jit", "raster", "scene", "shadow"),
    "integrator": ("errors", "jit", "rendering", "scene", "shadow"),
    "torch": ("errors", "jit", "raster", "rendering", "shadow"),
    "inverse": ("errors", "io", "jit", "raster", "rendering", "scene.lights", "shadow"),
    "cameras": ("errors", "scene.pixel_filter", "scene.sensor"),
    "interactive": ("errors", "inverse", "io", "jit.types"),
    "mitsuba_baselines": ("", "errors", "inverse", "io", "scene.mitsuba_meshes"),
    "experiments": (
        *(
            "",
            "_llvm",
            "errors",
            "inverse",
            "io",
            "jit",
            "mitsuba_baselines",
            "raster",
            "rendering",
            "scene",
            "shadow",
            "variants",
        ),
    ),
    "cli": ("", "_llvm", "errors", "experiments", "interactive", "inverse", "io", "rendering.film.aovs", "variants"),
    "": ("_llvm", "errors", "integrator", "rendering", "shadow", "variants"),
}

#: Packages within packages: what they may import of the one around them.
INSIDE = {
    "raster.antialiasing": (
        *("raster.barycentrics", "raster.screen_planes", "raster.shape_seams", "raster.topology", "raster.triangle_setup"),
        "raster.types",
    ),
    "shadow.methods": (),
    "scene.shapes": ("scene.mitsuba_meshes", "scene.mitsuba_objects", "scene.changes"),
    "scene.lights": ("scene.geometry", "scene.mitsuba_objects", "scene.changes", "scene.sums", "scene.transforms"),
    "rendering.gbuffer": (),
    "rendering.receivers": (),
    "rendering.film": ("rendering.gbuffer",),
    "rendering.extended_lights": ("rendering.direct_light", "rendering.gbuffer", "rendering.shadow_pass"),
    "inverse.runs": (),
    "inverse.faces": (),
    "inverse.light_directions": (),
    "inverse.shadow_art": (),
    "experiments.common": (),
}

#: The most layers.
LAYERS = 9

# Modules that all packages may import; the picture leaves them out.
_EVERYWHERE = ("_llvm", "errors", "variants")


@functools.cache
def modules() -> dict[str, Path]:
    """Modules by dotted name; that of a package is its ``__init__``."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@functools.cache
def imports(module: str) -> tuple[str, ...]:
    """Modules of these packages that a module imports, anywhere in it."""
    return tuple(dict.fromkeys(_imports(module)))


def _imports(module: str) -> Iterator[str]:
    path = modules()[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                name = f"{base}.{alias.name}"
                if name in modules() or base in modules():
                    yield name if name in modules() else base


def short(module: str) -> str:
    """Name within the package; "" is the package itself."""
    return module.removeprefix("shadowmap_dr").removeprefix(".")


def package_of(module: str) -> str:
    """The package in which a module lies."""
    return short(module).partition(".")[0]


def within(module: str, places: tuple[str, ...]) -> bool:
    """True if a module is one of some places, or lies in one."""
    name = short(module)
    return any(name == place or (place and name.startswith(place + ".")) for place in places)


def picture() -> str:
    """A Mermaid diagram: packages, with arrows to those that they import. What an imported package imports has no arrow."""
    below: dict[str, set[str]] = {}
    for module in modules():
        package = package_of(module)
        others = {package_of(other) for other in imports(module)} - {package, "", *_EVERYWHERE}
        if package not in ("", *_EVERYWHERE):
            below.setdefault(package, set()).update(others)

    @functools.cache
    def reached(package: str) -> frozenset[str]:
        return frozenset().union(*({other} | reached(other) for other in below[package]))

    lines = ["```mermaid", "flowchart TD"]
    for package in sorted(below):
        direct = sorted(other for other in below[package] if not any(other in reached(between) for between in below[package]))
        lines += [f"    {package} --> {other}" for other in direct] or [f"    {package}"]
    return "\n".join([*lines, "```"])


def test_the_picture_shows_the_imports() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    assert picture() in page, f"docs/architecture.md: its picture should be\n{picture()}"


def test_packages_import_what_they_may() -> None:
    wrong = []
    for module in modules():
        most = max((place for place in MAY_IMPORT if within(module, (place,))), key=len, default=None)
        assert most is not None, f"{module} lies in no package: give it one, or add one to this list"
        for other in imports(module):
            if package_of(other) != package_of(module) and not within(other, MAY_IMPORT[most]):
                wrong.append(f"{module} imports {other}")
    assert not wrong, wrong


def test_packages_within_packages() -> None:
    wrong = []
    for place, others in INSIDE.items():
        for module in modules():
            if within(module, (place,)):
                inside = [
                    other for other in imports(module) if package_of(other) == package_of(module) and not within(other, (place,))
                ]
                wrong += [f"{module} imports {other}" for other in inside if not within(other, others)]
    assert not wrong, wrong


def test_no_circles_and_few_layers() -> None:
    layers: dict[str, int] = {}

    def layer(name: str, above: tuple[str, ...]) -> int:
        assert name not in above, f"a circle: {' -> '.join([*above[above.index(name) :], name])}"
        if name not in layers:
            below = {package_of(other) for module in modules() if package_of(module) == name for other in imports(module)}
            # The version is all that is asked of the package itself.
            below -= {name, ""}
            layers[name] = 1 + max((layer(other, (*above, name)) for other in below), default=-1)
        return layers[name]

    assert max(layer(name, ()) for name in {package_of(module) for module in modules()}) < LAYERS, layers


def test_modules_import_each_other_in_no_circle() -> None:
    done: set[str] = set()

    def visit(module: str, above: tuple[str, ...]) -> None:
        assert module not in above, f"a circle: {' -> '.join([*above[above.index(module) :], module])}"
        if module not in done:
            for other in imports(module):
                if other not in PACKAGES:
                    visit(other, (*above, module))
            done.add(module)

    for module in modules():
        visit(module, ())


@pytest.mark.parametrize("place", ["raster", "shadow"])
def test_no_mitsuba(place: str) -> None:
    """Triangles and shadow maps are Dr.Jit's business alone."""
    for module, path in modules().items():
        if package_of(module) == place:
            for node in ast.walk(ast.parse(path.read_text())):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None) or ""]
                if isinstance(node, (ast.Import, ast.ImportFrom)):
                    assert not any(name.partition(".")[0] == "mitsuba" for name in names), module


def test_the_program_imports_no_command() -> None:
    """``shadowmap-dr --help`` is quick: commands are imported when they are called."""
    assert [short(other) for other in imports("shadowmap_dr.cli.main")] == ["", "errors", "cli.usage"]
    assert [short(other) for other in imports("shadowmap_dr.cli.usage")] == ["errors"]


def test_nothing_lies_flat() -> None:
    flat = {path.stem for path in (ROOT / "shadowmap_dr").glob("*.py")}
    assert flat == {"__init__", "_llvm", "errors", "variants"}


def test_the_package_shows_its_public_names_only() -> None:
    import shadowmap_dr

    assert [name for name in dir(shadowmap_dr) if not name.startswith("__")] == sorted(
        set(shadowmap_dr.__all__) - {"__version__"}
    )


if __name__ == "__main__":
    print(picture())
