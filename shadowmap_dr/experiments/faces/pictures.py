"""Pictures of the experiment on faces: profile shadows side by side, and distances drawn on the heads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...inverse.faces.morphable import MorphableModel
from ...io import meshes, plot_style, plots
from ...io.images import to_linear, to_srgb
from ...scene.mitsuba_meshes import make_mesh
from .metrics import distances

#: Distance at the end of the colour map (head within [-1, 1]^3).
COLOUR_END = 0.05
_SIZE = 220
_GREY = 0.6
# Beside and before the head, which faces +x, so that profile and face are seen.
_EYE, _FOV_DEG = (4.2, 0.9, 4.6), 18.0


FloatArray = npt.NDArray[np.float32]


class Sheets:
    """Collects the pictures of a mode; heads are rows."""

    def __init__(self, model: MorphableModel, mode: str) -> None:
        self._model, self._mode = model, mode
        self._profiles: dict[int, dict[str, dict[str, FloatArray]]] = {}
        self._heads: dict[int, dict[str | int, FloatArray]] = {}

    def add(
        self,
        seed: int,
        lights: int,
        true: FloatArray,
        start: FloatArray,
        found: FloatArray,
        target: FloatArray,
        shadow_start: FloatArray,
        shadow_found: FloatArray,
    ) -> None:
        """Add a head: vertices (V, 3) of the true head, the start and the result; the shadows (H, W, 1) of the three."""
        self._profiles.setdefault(lights, {})[f"head {seed}"] = {
            "target": target,
            "start": shadow_start,
            "result": shadow_found,
            "difference": np.abs(shadow_found - target),
        }
        heads = self._heads.setdefault(seed, {"true": true, "start": start})
        heads[lights] = found

    def write(self, out: Path) -> None:
        """Write `MODE-profiles-N.png` for each number N of shadows, and `MODE-errors.png`."""
        for lights, rows in self._profiles.items():
            plots.image_sheet(out / f"{self._mode}-profiles-{lights}.png", rows)
        rows = {}
        for seed, heads in self._heads.items():
            faces = self._model.faces
            row = {"head": picture(heads["true"], faces, self._model.mask)}
            keys: list[str | int] = ["start", *sorted(k for k in heads if isinstance(k, int))]
            for key in keys:
                title = f"{key} shadow{'s' * (key > 1)}" if isinstance(key, int) else key
                error = distances(heads[key], heads["true"], faces)
                row[title] = picture(heads[key], faces, self._model.mask, error)
            rows[f"head {seed}"] = row
        error_sheet(out / f"{self._mode}-errors.png", rows)


def picture(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, mask: npt.ArrayLike, error: npt.ArrayLike | None = None, size: int = _SIZE
) -> npt.NDArray[np.float32]:
    """Linear picture (size, size, 3) of a head from the side and the front, above the neck; coloured by ``error`` (V,)."""
    from matplotlib import colormaps

    p, f, m = np.asarray(vertices, np.float32), np.asarray(faces), np.asarray(mask, bool)
    f = f[m[f].all(1)]
    if error is None:
        colours = np.full((len(p), 3), _GREY)
    else:
        colours = to_linear(colormaps[plot_style.SEQUENTIAL](np.clip(np.asarray(error) / COLOUR_END, 0, 1))[:, :3])
    mesh = _mesh(p, f)
    mesh.add_attribute("vertex_paint", 3, np.ascontiguousarray(colours, np.float32).ravel())
    mesh.set_bsdf(
        mi.load_dict(
            {
                "type": "twosided",
                "material": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}},
            }
        )
    )
    middle = [float(x) for x in 0.5 * (p[m].min(0) + p[m].max(0))]
    eye = [a + b for a, b in zip(_EYE, middle, strict=True)]
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": _FOV_DEG,
                "to_world": mi.ScalarTransform4f().look_at(eye, middle, [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgba"},
            },
            "head": mesh,
            "key": {"type": "directional", "direction": [-1.0, -0.9, -0.5], "irradiance": {"type": "rgb", "value": 1.6}},
            "fill": {"type": "directional", "direction": [-0.3, -0.2, -1.0], "irradiance": {"type": "rgb", "value": 1.4}},
        },
        optimize=False,
    )
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "shadowmap"}), spp=9))
    return image[..., :3] + (1 - image[..., 3:4])  # over white


def error_sheet(path: str | os.PathLike[str], rows: dict[str, dict[str, npt.NDArray[np.float32]]]) -> None:
    """Draw a grid of pictures with the colour bar beside it."""
    columns = max(len(row) for row in rows.values())
    with plot_style.drawn(path, 2.2 * columns + 0.8, 2.2 * len(rows) + 0.3, dpi=120) as figure:
        grid = np.atleast_2d(figure.subplots(len(rows), columns, squeeze=False))
        for i, (row_title, row) in enumerate(rows.items()):
            for j, (title, image) in enumerate(row.items()):
                axes = grid[i, j]
                axes.imshow(to_srgb(image))
                axes.set_title(title if i == 0 else "", fontsize=9)
                axes.set_ylabel(row_title if j == 0 else "", fontsize=9)
            for axes in grid[i]:
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(False)
                axes.grid(False)
        label = "distance from the head [units of the model]"
        plot_style.colour_bar(figure, list(grid.flat), plot_style.SEQUENTIAL, 0.0, COLOUR_END, label)


def write_ply(path: str | os.PathLike[str], vertices: npt.ArrayLike, faces: npt.ArrayLike) -> None:
    """Write a mesh as a binary PLY file."""
    mesh = _mesh(np.asarray(vertices, np.float32), np.asarray(faces))
    meshes.write_ply(path, mesh)


def _mesh(vertices: npt.NDArray[np.float32], faces: npt.NDArray[Any]) -> mi.Mesh:
    return make_mesh("head", vertices, faces)
