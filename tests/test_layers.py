"""Layers of the package: which packages may import which others. Read from the sources; nothing is imported.

``python tests/test_layers.py`` draws the picture in docs/architecture.md.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("shadowmap_dr", "mitsuba_baselines")
PICTURE = ROOT / "docs" / "architecture.svg"

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
    "torch": ("errors", "fitting", "jit", "raster", "rendering", "scene.sensor", "scene.transforms", "shadow"),
    "inverse": ("errors", "io", "jit", "raster", "rendering", "scene.lights", "shadow"),
    "fitting": ("errors", "io", "jit", "raster", "rendering", "scene", "shadow"),
    "importing": ("errors", "io"),
    "cameras": ("errors", "scene.pixel_filter", "scene.sensor"),
    "interactive": ("errors", "inverse", "io", "jit.types"),
    "mitsuba_baselines": ("", "errors", "inverse", "io", "jit.arrays", "scene.mitsuba_meshes"),
    "experiments": (
        *(
            "",
            "_llvm",
            "errors",
            "fitting",
            "inverse",
            "io",
            "jit",
            "mitsuba_baselines",
            "raster",
            "rendering",
            "scene",
            "shadow",
            "torch",
            "variants",
        ),
    ),
    "cli": (
        "",
        "_llvm",
        "errors",
        "experiments",
        "fitting",
        "importing",
        "interactive",
        "inverse",
        "io",
        "jit.threads",
        "rendering.film.aovs",
        "variants",
    ),
    "": ("_llvm", "errors", "fitting", "integrator", "rendering", "shadow", "variants"),
}

#: Packages within packages: what they may import of the one around them.
INSIDE = {
    "raster.antialiasing": (
        *("raster.barycentrics", "raster.screen_planes", "raster.shape_seams", "raster.topology", "raster.triangle_setup"),
        "raster.types",
    ),
    "shadow.methods": (),
    "scene.shapes": ("scene.mitsuba_meshes", "scene.mitsuba_objects", "scene.changes"),
    "scene.lights": (
        *("scene.geometry", "scene.mitsuba_objects", "scene.changes", "scene.naming", "scene.sums", "scene.transforms"),
    ),
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


def arrows() -> dict[str, tuple[str, ...]]:
    """Packages, and those that they import. What an imported package imports is left out."""
    below: dict[str, set[str]] = {}
    for module in modules():
        package = package_of(module)
        others = {package_of(other) for other in imports(module)} - {package, "", *_EVERYWHERE}
        if package not in ("", *_EVERYWHERE):
            below.setdefault(package, set()).update(others)

    @functools.cache
    def reached(package: str) -> frozenset[str]:
        return frozenset().union(*({other} | reached(other) for other in below[package]))

    def direct(package: str) -> Iterator[str]:
        return (other for other in sorted(below[package]) if not any(other in reached(between) for between in below[package]))

    return {package: tuple(direct(package)) for package in sorted(below)}


def picture() -> str:
    """A drawing (SVG): packages in rows by their layer, with arrows to those that they import."""
    below = arrows()

    @functools.cache
    def layer(package: str) -> int:
        return 1 + max(map(layer, below[package]), default=-1)

    places: dict[str, tuple[float, float]] = {}
    top = max(map(layer, below))
    for number in range(top + 1):
        row = [package for package in below if layer(package) == number]
        # Each as far as possible above those that it imports.
        middles = {package: sum(places[other][0] for other in below[package]) / max(1, len(below[package])) for package in row}
        row.sort(key=middles.__getitem__)
        for k, package in enumerate(row):
            x = middles[package] if len(row) == 1 else _WIDTH * (k + 1) / (len(row) + 1)
            places[package] = (x, _ROW * (top - number + 0.5))
    height, half = _ROW * (top + 1), _BOX[1] / 2
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}">',
        "<title>Packages, with arrows to those that they import</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#4d4d4d"/></marker></defs>',
        f'<rect width="{_WIDTH}" height="{height}" fill="#fff"/>',
    ]
    for package, others in below.items():
        for other in others:
            (x, y), (to_x, to_y) = places[package], places[other]
            ends = f'x1="{x:.0f}" y1="{y + half:.0f}" x2="{to_x:.0f}" y2="{to_y - half:.0f}"'
            lines.append(f'<line {ends} stroke="#4d4d4d" marker-end="url(#tip)"/>')
    for package, (x, y) in places.items():
        corner = f'x="{x - _BOX[0] / 2:.0f}" y="{y - half:.0f}" width="{_BOX[0]}" height="{_BOX[1]}"'
        lines.append(f'<rect {corner} rx="4" fill="#e6f1f8" stroke="#0072b2"/>')
        lines.append(
            f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle" font-family="sans-serif" font-size="14">{package}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


# Sizes in pixels: of the drawing, from row to row, and of a box.
_WIDTH, _ROW, _BOX = 640, 62, (150, 30)


def test_the_picture_shows_the_imports() -> None:
    assert PICTURE.read_text(encoding="utf-8") == picture(), "run python tests/test_layers.py"
    assert f"]({PICTURE.name})" in (PICTURE.parent / "architecture.md").read_text(encoding="utf-8")


def test_the_picture_has_all_packages_above_what_they_import() -> None:
    drawn = ElementTree.fromstring(picture())
    texts = {text.text: (float(text.get("x", "")), float(text.get("y", ""))) for text in drawn.iter(f"{_SVG}text")}
    assert texts.keys() == {package_of(module) for module in modules()} - {"", *_EVERYWHERE}
    assert all(texts[package][1] < texts[other][1] for package, others in arrows().items() for other in others)
    assert len(list(drawn.iter(f"{_SVG}line"))) == sum(map(len, arrows().values()))


_SVG = "{http://www.w3.org/2000/svg}"


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
    PICTURE.write_text(picture(), encoding="utf-8")
