"""Stained glass: the tints of small panes are fitted until the sun throws a given picture through them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.frozen import freeze, recordings_of
from ...jit.types import Float
from ...rendering.receivers.checks import is_real, is_whole, real_array
from ...rendering.renderer import Renderer

Array = npt.NDArray[np.float32]

#: Direction of the sun, from which the sheet's shadow lies beside it, and index of refraction of the glass.
DIRECTION, IOR = (1.0, -1.0, 0.0), 1.5
#: Height of the sheet above the floor, in half sides of the picture, and reflectance of the floor.
HEIGHT, REFLECTANCE = 3.0, 0.8
# Panes beyond each border of the picture: filters of shadow maps mix their light into it. Tints at the start.
_BORDER, _START = 2, 0.5
_KEY = "sheet.bsdf.specular_transmittance.data"


class StainedSheet:
    """A sheet of square panes, each with a tint, whose coloured shadow on a floor becomes a picture.

    The sheet is parallel to the floor. The sun is so bright that light through clear panes makes the floor white (1). The loss is
    the mean squared difference between the floor, seen from above, and the picture. Adam takes steps on the tints. Derivatives
    flow through the transmittance that shadow maps store beside depths. A step is recorded once.

    Args:
        picture: linear colours (H, H, 3) in 0..1, top row first.
        panes: along each side of the picture. The sheet has two more at each border.
        step_size: of Adam.
        map_resolution: texels along each side of the shadow map; 0 for four for each pane, and at least 256.

    Raises ShadowmapError for a picture or a setting that cannot be used.
    """

    def __init__(self, picture: npt.ArrayLike, *, panes: int = 64, step_size: float = 0.05, map_resolution: int = 0) -> None:
        pixels = real_array("picture", picture)
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.shape[0] != pixels.shape[1]:
            raise ShadowmapError(f"a picture of shape {pixels.shape}: give a square one, (H, H, 3).")
        if not (np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
            raise ShadowmapError("the picture has values outside of 0 (dark) to 1 (lit).")
        if not is_whole(panes) or not 1 <= panes <= 1024:
            raise ShadowmapError(f"{panes} panes along each side: give 1 to 1024.")
        if not is_real(step_size) or not step_size > 0:
            raise ShadowmapError(f"a step size of {step_size}: give a positive number.")
        self.panes, self._picture, self._step_size = int(panes), pixels, float(step_size)
        side = self.panes + 2 * _BORDER
        self._shape = (side, side, 3)
        self._texels = map_resolution or max(256, 4 * self.panes)
        start = np.full(self._shape, _START, np.float32)
        scene = mi.load_dict(description(start, self.panes, len(pixels)), optimize=False)
        # Sheet and floor are far apart: depths need no range of their own.
        self._renderer = Renderer.from_scene(scene, shadow_map_resolution=self._texels, shadow_receiver_range=False)
        self._gradient, self._look = freeze(_gradient), freeze(_image)
        self._wanted = device_array(mi.Float, pixels.ravel())
        self.load_state({"tints": start, "m": 0 * start, "v": 0 * start, "t": np.zeros(1), "steps": np.zeros(1)})

    @property
    def steps(self) -> int:
        """Number of steps since the start, those before a loaded state included."""
        return self._steps

    def step(self) -> Float:
        """Take one step. Returns the loss before the step, ``Float`` (1,)."""
        tints = self._optimizer["tints"]
        loss, slope = self._gradient(dr.detach(tints), self._wanted, self._renderer)
        dr.set_grad(tints, slope)
        self._optimizer.step()
        self._optimizer["tints"] = dr.clip(dr.detach(self._optimizer["tints"]), 0, 1)
        dr.eval(self._optimizer["tints"])
        self._steps += 1
        return loss

    def target(self) -> Array:
        """The picture (H, H, 3), a copy."""
        return self._picture.copy()

    def picture(self) -> Array:
        """The floor (H, H, 3), linear, through the panes as they are."""
        image = self._look(dr.detach(self._optimizer["tints"]), self._renderer)
        return np.array(image, np.float32).reshape(self._picture.shape)

    def tints(self) -> Array:
        """Transmittances (N, N, 3) of all panes, seen from above, those beyond the borders included."""
        return np.array(dr.detach(self._optimizer["tints"]), np.float32).reshape(self._shape)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The tints, Adam's moments m and v, its step count t and the number of steps: the input of `load_state`."""
        tints, _, _, (t, m, v, _) = self._optimizer.state["tints"]
        arrays = {"tints": dr.detach(tints), "m": m, "v": v, "t": t}
        return {**{name: np.array(array) for name, array in arrays.items()}, "steps": np.array([self._steps])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`, possibly of another process."""
        tints, m, v = (device_array(mi.Float, np.ravel(state[name])) for name in ("tints", "m", "v"))
        if {dr.width(tints), dr.width(m), dr.width(v)} != {int(np.prod(self._shape))}:
            raise ShadowmapError(f"a state of {dr.width(tints)} numbers for {int(np.prod(self._shape))} tints.")
        self._optimizer = mi.ad.Adam(lr=self._step_size, params={"tints": tints})
        value, promoted, rate, (t, *_, v_max) = self._optimizer.state["tints"]
        self._optimizer.state["tints"] = value, promoted, rate, (device_array(type(t), state["t"]), m, v, v_max)
        self._steps = int(np.asarray(state["steps"]).reshape(-1)[0])

    def recordings(self) -> int:
        """Number of recordings of a step so far."""
        return recordings_of(self._gradient)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {
            "panes": self.panes, "border_panes": _BORDER, "resolution": len(self._picture), "map_resolution": self._texels,
            "direction": list(DIRECTION), "height": HEIGHT, "int_ior": IOR, "optimizer": "Adam", "step_size": self._step_size,
        }  # fmt: skip


def description(tints: Array, panes: int, size: int) -> dict[str, Any]:
    """A scene for ``mi.load_dict``: the sheet, the floor, the sun, and a camera above the sheet's shadow.

    Args:
        tints: (N, N, 3) of all panes, seen from above.
        panes: number along each side of the picture, which has the half side 1 on the floor.
        size: pixels along each side of the camera's image.
    """
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    above = T().look_at([0, 1, 0], [0, 0, 0], [0, 0, -1])
    place = T().translate([-HEIGHT * DIRECTION[0], HEIGHT, 0]) @ T().rotate([1, 0, 0], 90) @ T().scale(len(tints) / panes)
    texture = {
        "type": "bitmap", "bitmap": mi.Bitmap(np.asarray(tints, np.float32)), "raw": True, "format": "variant",
        "filter_type": "nearest", "wrap_mode": "clamp",
    }  # fmt: skip
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 2},
        "camera": {"type": "orthographic", "to_world": above, "film": film},
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90) @ T().scale(8),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": REFLECTANCE}},
        },
        "sheet": {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "thindielectric", "int_ior": IOR, "specular_transmittance": texture},
        },
        "sun": {"type": "directional", "direction": list(DIRECTION), "irradiance": {"type": "rgb", "value": irradiance()}},
    }


def scene_text(texture: str, panes: int, count: int, size: int) -> str:
    """The scene of :func:`description` as the text of a scene file.

    Args:
        texture: file of the tints, linear, beside the scene file.
        panes: number along each side of the picture.
        count: number along each side of the sheet.
        size: pixels along each side of the camera's image.
    """
    x, y, z = DIRECTION
    return f"""<?xml version="1.0"?>
<!-- A sheet of {count} x {count} tinted panes; the sun throws their colours on a floor, which the camera sees from above. -->
<scene version="3.0.0">
    <integrator type="volpath">
        <integer name="max_depth" value="2"/>
    </integrator>
    <sensor type="orthographic" id="camera">
        <transform name="to_world">
            <lookat origin="0, 1, 0" target="0, 0, 0" up="0, 0, -1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/>
            <integer name="height" value="{size}"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="directional" id="sun">
        <vector name="direction" x="{x:g}" y="{y:g}" z="{z:g}"/>
        <rgb name="irradiance" value="{irradiance():.7g}"/>
    </emitter>
    <shape type="rectangle" id="floor">
        <transform name="to_world">
            <rotate x="1" angle="-90"/>
            <scale value="8"/>
        </transform>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="{REFLECTANCE:g}"/>
        </bsdf>
    </shape>
    <shape type="rectangle" id="sheet">
        <transform name="to_world">
            <scale value="{count / panes:.9g}"/>
            <rotate x="1" angle="90"/>
            <translate x="{-HEIGHT * x:g}" y="{HEIGHT:g}" z="0"/>
        </transform>
        <bsdf type="thindielectric">
            <float name="int_ior" value="{IOR:g}"/>
            <texture name="specular_transmittance" type="bitmap">
                <string name="filename" value="{texture}"/>
                <string name="filter_type" value="nearest"/>
                <string name="wrap_mode" value="clamp"/>
                <boolean name="raw" value="true"/>
            </texture>
        </bsdf>
    </shape>
</scene>
"""


def irradiance() -> float:
    """Irradiance of a sun whose light makes the floor white through clear panes."""
    cosine = -DIRECTION[1] / float(np.linalg.norm(DIRECTION))
    # Fresnel's equations, without polarisation; light that is reflected to and fro within a pane leaves it, too.
    inside = np.sqrt(1 - (1 - cosine**2) / IOR**2)
    parallel, perpendicular = (IOR * cosine - inside) / (IOR * cosine + inside), (cosine - IOR * inside) / (cosine + IOR * inside)
    reflected = (parallel**2 + perpendicular**2) / 2
    passed = (1 - reflected) / (1 + reflected)
    return float(np.pi / (cosine * REFLECTANCE * passed))


@contextmanager
def _tinted(tints: Float, renderer: Renderer) -> Iterator[Float]:
    """Context of a flat image of the floor through panes of these tints, attached. The panes have their old ones afterwards."""
    table = mi.traverse(renderer.data.scene)
    before = table[_KEY]
    old = type(before)(dr.detach(before))
    table[_KEY] = type(old)(tints, old.shape)
    table.update()
    try:
        yield renderer.render(spp=1).array
    finally:
        table[_KEY] = old
        table.update()


def _image(tints: Float, renderer: Renderer) -> Float:
    """Flat image of the floor."""
    with _tinted(tints, renderer) as image:
        dr.eval(image)
        return image


def _gradient(tints: Float, wanted: Float, renderer: Renderer) -> tuple[Float, Float]:
    """(loss, its derivative by the tints)."""
    own = mi.Float(tints)
    dr.enable_grad(own)
    with _tinted(own, renderer) as image:
        difference = dr.detach(image) - wanted
        scale = 1 / dr.opaque(mi.Float, dr.width(wanted))
        dr.set_grad(image, 2 * scale * difference)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        loss, slope = dr.sum(difference * difference) * scale, dr.grad(own)
        dr.eval(loss, slope)
    return loss, slope
