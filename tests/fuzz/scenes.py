"""Scenes as dictionaries and as XML, with parts of all kinds, valid and not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import shadowmap_dr
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io import images

from . import mesh_files
from .commands import run_command
from .outcome import check
from .values import chance, integer, mutated, mutated_text, number, pick

SIZE = 12
#: Settings that keep scenes small.
SMALL = {
    "shadow_map_resolution": 32,
    "soft_map_resolution": 16,
    "area_light_samples": 4,
    "environment_light_samples": 4,
    "tessellation": 8,
    "shadow_samples": 1,
}

Plugin = dict[str, Any]


def run(rng: np.random.Generator, folder: Path) -> str:
    """Render a scene by the command, or from its dictionary."""
    return pick(rng, (_file, _file, _dictionary))(rng, folder)


def _file(rng: np.random.Generator, folder: Path) -> str:
    plugins = random_scene(rng, folder)
    text = "\n".join(['<scene version="3.0.0">', *(_element(name, part) for name, part in plugins.items()), "</scene>\n"])
    sound = chance(rng, 0.4)
    text = text if sound else _changed(rng, text)
    # Mitsuba 3.9 ends the process if a sampler has no sample.
    text = re.sub(r'(name="sample_count" value=")0"', r'\g<1>1"', text)
    path = folder / "scene.xml"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    options = ["--integrator", "scene"] if chance(rng, 0.8) else []
    if chance(rng, 0.15):
        options += pick(
            rng, (["--size", "9x7"], ["--spp", "4"], ["--size", "0x1"], ["--aovs", "depth"], ["--integrator", "path"])
        )
    said = run_command(["render", str(path), "-o", "image.exr", *options])
    channels, _ = images.read_exr(folder / "image.exr")
    colours = [channels[name] for name in ("R", "G", "B", "Y", "A") if name in channels]
    check(colours and all(np.isfinite(plane).all() for plane in colours), "an image has no colours, or is not finite")
    return said.strip()


def _changed(rng: np.random.Generator, text: str) -> str:
    """XML with other numbers; one of three with any fault."""
    if chance(rng, 0.2):
        return mutated_text(rng, text)
    for _ in range(int(rng.integers(1, 4))):
        found = list(re.finditer(r'(?<=[" ])-?\d+(\.\d+)?(e-?\d+)?(?=[",])', text))
        at = pick(rng, found)
        numbers = (0, 1, -1, 2, 7, 40) if "." not in at[0] and chance(rng, 0.9) else (1e-3, 1e10, 1e38, -5.5, 300, 0, number(rng))
        new = str(pick(rng, numbers))
        text = text[: at.start()] + new + text[at.end() :]
    return text


def _dictionary(rng: np.random.Generator, folder: Path) -> str:
    plugins = random_scene(rng, folder)
    plugins.pop("integrator", None)
    description = {"type": "scene", **{name: scene_entry(part) for name, part in plugins.items()}}
    renderer = shadowmap_dr.Renderer.from_dict(description, **SMALL)
    if not renderer.data.sensors:
        raise ShadowmapError("the scene has no sensor.")
    image = renderer.render().numpy()
    check(image.ndim == 3 and image.shape[2] <= 4, f"an image of shape {image.shape}")
    check(np.isfinite(image).all(), "an image is not finite")
    return f"{image.shape}, mean {image.mean():.3f}"


def random_scene(rng: np.random.Generator, folder: Path, damaged: bool = True) -> dict[str, Plugin]:
    """Shapes, lights, a camera and an integrator by name. ``damaged``: one of ten lacks one of them, others have wrong values."""
    plugins: dict[str, Plugin] = {
        "floor": {"type": "rectangle", "to_world": ("scale", (3, 3, 3)), "bsdf": _bsdf(rng)},
        "camera": _camera(rng),
        "integrator": {"type": "shadowmap", **SMALL, **_options(rng)},
    }
    for k in range(int(rng.integers(0, 3))):
        plugins[f"shape{k}"] = _shape(rng, folder)
    for k in range(int(pick(rng, (0, 1, 1, 1, 2)))):
        plugins[f"light{k}"] = _light(rng)
    if damaged and chance(rng, 0.1):
        del plugins[pick(rng, tuple(plugins))]
    if damaged and chance(rng, 0.12):
        _damage(rng, plugins)
    return plugins


def _shape(rng: np.random.Generator, folder: Path) -> Plugin:
    kind = (
        pick(rng, (*("cube", "sphere", "disk", "cylinder", "rectangle", "file", "file") * 2, "bsplinecurve", "linearcurve"))
        if chance(rng, 0.97)
        else "shapegroup"
    )
    shape: Plugin = {"type": kind, "to_world": _transform(rng), "bsdf": _bsdf(rng)}
    if kind == "file":
        suffix, data = mesh_files.files()[pick(rng, ("obj", "obj of quads", "ply", "ascii ply"))]
        path = folder / f"mesh{int(rng.integers(1000))}{suffix}"
        path.write_bytes(data if chance(rng, 0.8) else mutated(rng, data))
        shape.update(type=suffix[1:], filename=str(path))
    elif kind.endswith("curve"):
        path = folder / "curve.txt"
        path.write_text(
            "\n".join(f"{k} {k % 2} 1 {pick(rng, ('0.1',) * 8 + ('0', 'nan', ''))}" for k in range(int(rng.integers(1, 7))))
        )
        shape["filename"] = str(path)
    if chance(rng, 0.15):
        shape["emitter"] = {"type": "area", "radiance": _colour(rng)}
    return shape


def _bsdf(rng: np.random.Generator) -> Plugin:
    kinds = ("twosided", "plastic", "roughplastic", "roughconductor", "dielectric", "principled", "null", "mask", "conductor")
    # Mitsuba 3.9 ends the process on a `blendbsdf` without two BSDFs in it.
    kind = pick(rng, ("diffuse",) * 6 + kinds) if chance(rng, 0.97) else pick(rng, ("bumpmap", "measured", ""))
    if kind in ("twosided", "mask", "bumpmap"):
        nested: Plugin = {"type": "diffuse", "reflectance": _colour(rng)}
        return {"type": kind, "nested": nested, **({"opacity": float(rng.uniform(0, 1))} if kind == "mask" else {})}
    return {"type": kind, "reflectance": _colour(rng)} if kind == "diffuse" else {"type": kind}


def _light(rng: np.random.Generator) -> Plugin:
    kind = pick(rng, ("point", "directional", "spot", "constant", "envmap", "projector"))
    kind = kind if chance(rng, 0.95) else pick(rng, ("directionalarea", "sunsky", "area", "timedsunsky", ""))
    light: Plugin = {"type": kind}
    if kind == "point":
        light |= {"position": _vector(rng), "intensity": _colour(rng)}
    elif kind == "directional":
        light |= {"direction": _vector(rng), "irradiance": _colour(rng)}
    elif kind == "spot":
        light |= {"to_world": _transform(rng), "intensity": _colour(rng), "cutoff_angle": float(rng.uniform(1, 80))}
    elif kind == "constant":
        light |= {"radiance": _colour(rng)}
    elif kind in ("envmap", "projector"):
        height = int(pick(rng, (1, 2, 5)))
        images.write_exr(Path("light.exr"), {name: rng.uniform(0, 2, (height, 2 * height)).astype(np.float32) for name in "RGB"})
        light |= (
            {"filename": "light.exr"}
            if kind == "envmap"
            else {"irradiance": {"type": "bitmap", "filename": "light.exr"}, "fov": 40.0}
        )
    return light


def _camera(rng: np.random.Generator) -> Plugin:
    kind = (
        pick(rng, (*("perspective",) * 8, "orthographic", "orthographic", "thinlens", "thinlens"))
        if chance(rng, 0.97)
        else pick(rng, ("batch", "distant", "irradiancemeter"))
    )
    film: Plugin = {
        "type": pick(rng, ("hdrfilm",) * 20 + ("specfilm",)),
        "width": SIZE,
        "height": int(pick(rng, (SIZE, SIZE, 5, 1))),
        "pixel_format": pick(rng, (*("rgb", "rgba", "luminance", "luminance_alpha") * 4, "xyz")),
        "rfilter": {"type": pick(rng, ("box", "gaussian", "tent", "lanczos"))},
    }
    if chance(rng, 0.2):
        film |= {"crop_offset_x": 2, "crop_width": int(pick(rng, (3, 1, 5, 20)))}
    camera: Plugin = {"type": kind, "to_world": ("look_at", (2, -3, 4), (0, 0, 0.5), (0, 0, 1)), "film": film}
    if kind in ("perspective", "thinlens"):
        camera["fov"] = float(pick(rng, (45, 10, 120, 1e-3, 179)))
    if kind == "thinlens":
        camera |= {"aperture_radius": 0.1, "focus_distance": 4.0}
    if chance(rng, 0.3):
        camera["sampler"] = {
            "type": pick(rng, ("independent", "multijitter", "stratified")),
            "sample_count": int(pick(rng, (1, 4, 9))),
        }
    if chance(rng, 0.2):
        camera |= {"near_clip": float(pick(rng, (1e-3, 1.0, 10.0))), "far_clip": float(pick(rng, (5.0, 1e6)))}
    return camera


def _options(rng: np.random.Generator) -> Plugin:
    """Parameters of the integrator."""
    choices: Plugin = {
        "shadow_method": pick(rng, ("vsm", "esm", "evsm2", "msm", "csm", "pcf", "standard", "none")),
        "shadow_filter": pick(rng, ("box", "gaussian", "wendland", "none")),
        "shadow_filter_size": int(pick(rng, (1, 3, 5, 5, 2, 27, 255))),
        "antialias": chance(rng, 0.5),
        "hide_emitters": chance(rng, 0.5),
        "max_depth": int(pick(rng, (0, 1, 2, 2, 5, -1, -2))),
        "emitter_shadows": pick(rng, ("single", "samples", "samples", "x")),
        "compat": chance(rng, 0.3),
        "recorded": chance(rng, 0.3),
        "shadow_supersampling": int(pick(rng, (2, 2, 2, 9))),
        "shadow_cull_backfaces": True,
        "aovs": pick(rng, ("depth", "position,normal", "a:depth,b:visibility", "a:depth,a:depth")),
        "light_memory": float(pick(rng, (1e-5, 1e-4, 1.0, -1))),
        "ambient": float(pick(rng, (0.1, 1.0, 1e10, -1.0))),
        "rr_depth": 3,
    }
    if chance(rng, 0.03):
        return {"unknown": 1}
    names = rng.permutation(sorted(choices))[: int(rng.integers(0, 3))]
    return {str(name): choices[str(name)] for name in names}


def _colour(rng: np.random.Generator) -> Any:
    if chance(rng, 0.8):
        return tuple(float(x) for x in rng.uniform(0, 1, 3).round(3))
    return pick(rng, (0.5, (0.0, 0.0, 0.0), (1e10, 1.0, 1.0), (-1.0, 0.0, 1.0), 1e-30))


def _vector(rng: np.random.Generator) -> tuple[str, tuple[float, ...]]:
    x, y = rng.normal(size=2).round(3)
    return "vector", (float(x), float(y), float(pick(rng, (3.0, -1.0, 0.0)))) if chance(rng, 0.9) else (
        0.0,
        0.0,
        float(pick(rng, (0.0, 1e10, 1e20))),
    )


def _transform(rng: np.random.Generator) -> tuple[Any, ...]:
    if chance(rng, 0.7):
        return "translate", tuple(float(x) for x in rng.uniform(-1, 1, 3).round(3))
    return pick(
        rng,
        (
            ("scale", (1, 1, 0)),
            ("scale", (-1, 1, 1)),
            ("scale", (1e-8, 1e-8, 1e-8)),
            ("translate", (0, 0, 1e8)),
            ("scale", (0.5, 0.5, 0.5)),
        ),
    )


def _damage(rng: np.random.Generator, plugins: dict[str, Plugin]) -> None:
    """Replace a value by another one, or add a parameter."""
    part = plugins[pick(rng, tuple(plugins))]
    nested = [value for value in part.values() if isinstance(value, dict)]
    if nested and chance(rng, 0.5):
        part = pick(rng, nested)
    key = pick(rng, tuple(part)) if chance(rng, 0.8) else pick(rng, ("unknown", "radius", "fov", "id", "center"))
    part[key] = pick(
        rng,
        (
            number(rng),
            min(integer(rng), 40),
            "text",
            "",
            True,
            (0.0, 0.0, 0.0),
            ("scale", (0, 0, 0)),
            {"type": "diffuse"},
            {"type": "none"},
        ),
    )


_TAGS = {
    **dict.fromkeys(("camera",), "sensor"),
    "film": "film",
    "rfilter": "rfilter",
    "sampler": "sampler",
    "integrator": "integrator",
    "irradiance": "texture",
    "bsdf": "bsdf",
    "nested": "bsdf",
    "emitter": "emitter",
    "floor": "shape",
}


def _element(name: str, value: Any) -> str:
    """XML of a part or a value."""
    if isinstance(value, dict):
        tag = _TAGS.get(name, "emitter" if name.startswith("light") else "shape")
        kind = value.get("type", "")
        inner = "\n".join(_element(key, part) for key, part in value.items() if key != "type")
        mark = f' id="{name}"' if tag in ("shape", "sensor") else f' name="{name}"' if tag == "texture" else ""
        return f'<{tag} type="{kind}"{mark}>\n{inner}\n</{tag}>'
    if isinstance(value, bool):
        return f'<boolean name="{name}" value="{str(value).lower()}"/>'
    if isinstance(value, int):
        return f'<integer name="{name}" value="{value}"/>'
    if isinstance(value, float):
        return f'<float name="{name}" value="{value!r}"/>'
    if isinstance(value, str):
        return f'<string name="{name}" value="{value}"/>'
    if value[0] == "vector":
        return f'<{"point" if name == "position" else "vector"} name="{name}" value="{", ".join(map(str, value[1]))}"/>'
    if value[0] == "look_at":
        origin, target, up = (", ".join(map(str, v)) for v in value[1:])
        return f'<transform name="{name}">\n<lookat origin="{origin}" target="{target}" up="{up}"/>\n</transform>'
    if isinstance(value[0], str):
        return f'<transform name="{name}">\n<{value[0]} value="{", ".join(map(str, value[1]))}"/>\n</transform>'
    return f'<rgb name="{name}" value="{", ".join(map(str, value))}"/>'


def scene_entry(value: Any) -> Any:
    """A part or a value for ``mi.load_dict``."""
    if isinstance(value, dict):
        return {key: scene_entry(part) for key, part in value.items()}
    if not isinstance(value, tuple):
        return value
    if value[0] == "vector":
        return list(value[1])
    if isinstance(value[0], str):
        return getattr(mi.ScalarTransform4f(), value[0])(*(list(v) for v in value[1:]))
    return {"type": "rgb", "value": list(value)}
