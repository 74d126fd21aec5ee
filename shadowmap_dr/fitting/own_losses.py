"""Residuals and losses of users: plain functions of an image and a picture, with Dr.Jit's derivatives.

They are called between passes, never in a recording: a function that cannot be recorded would end the process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import device_tensor
from ..jit.types import TensorXf
from .comparison import Observation

Image = npt.NDArray[np.float32]

#: (image, picture), linear TensorXf (H, W, 3) -> residuals, or a loss. The image is attached.
OwnFunction = Callable[[TensorXf, TensorXf], Any]  # Any: a tensor or another float array of Dr.Jit's


def function_name(function: OwnFunction) -> str:
    """The name of a function; that of its type, for other objects that can be called."""
    return str(getattr(function, "__name__", type(function).__name__))


# Effect of pixels that do not count on a residual, as a share of that of all pixels, up to which it counts; number of images of
# noise by which effects are measured.
_LITTLE, _TRIALS = 0.1, 3
# Sides of arrays that count as images: shorter ones have no neighbours to speak of.
_SHORTEST = 4


class _OwnFunction:
    """A user's function of images and one picture. Pixels that do not count are black in both."""

    kind = ""

    def __init__(self, function: OwnFunction, seen: Observation) -> None:
        if not callable(function):
            raise ShadowmapError(f"{self.kind}: {function!r:.60} is no function: give one of an image and a picture.")
        self._function, self.name = function, f"{self.kind} {function_name(function)}"
        self._counts = (seen.weight > 0)[..., None]
        self._picture = self._masked(seen.image)
        share = seen.weight[..., None].astype(np.float64)
        mean = (share * seen.image).sum((0, 1)) / max(float(share.sum()), 1e-30)
        #: A picture that shows nothing: the mean colour.
        self._flat = self._masked(np.broadcast_to(mean, seen.image.shape))

    @contextmanager
    def _uncovered(self) -> Iterator[None]:
        """Context in which pixels that do not count are seen."""
        counts, self._counts = self._counts, np.ones_like(self._counts)
        try:
            yield
        finally:
            self._counts = counts

    def _masked(self, image: npt.NDArray[Any]) -> Image:
        return np.asarray(np.where(self._counts, image, 0), np.float32)

    def _value(self, image: TensorXf, picture: TensorXf) -> TensorXf:
        """The function's value, whose type is checked."""
        try:
            found = self._function(image, picture)
        except ShadowmapError:
            raise
        except Exception as error:  # of a user's function
            what = " ".join(str(error).split()) or "no message"
            raise ShadowmapError(f"{self.name}: {type(error).__name__} in the function: {what:.300}") from error
        kind = type(found)
        if not dr.is_array_v(found) or not dr.is_float_v(found):
            raise ShadowmapError(
                f"{self.name} returns a {kind.__module__}.{kind.__qualname__}: return a float array of Dr.Jit's (mi.TensorXf), "
                "computed by functions of drjit; of PyTorch's functions drjit.wrap('drjit', 'torch') makes such ones."
            )
        if not dr.is_tensor_v(found):
            found = mi.TensorXf(found) if dr.depth_v(found) == 1 else mi.TensorXf(dr.ravel(found))
        if not found.array.state == dr.VarState.Invalid and len(found.array):
            return found
        raise ShadowmapError(f"{self.name} returns an array without entries.")

    def _attached(self, image: Image, picture: Image) -> tuple[TensorXf, TensorXf]:
        """(image, attached, and the function's value)."""
        given = device_tensor(mi.TensorXf, self._masked(image))
        dr.enable_grad(given)
        found = self._value(given, device_tensor(mi.TensorXf, picture))
        if not dr.grad_enabled(found):
            raise ShadowmapError(
                f"{self.name}: its result has no derivative by the image: it may detach the image, or take a way through "
                "NumPy; use functions of drjit."
            )
        return given, found

    def _plain(self, image: Image, picture: Image) -> Image:
        """The function's value as an array of NumPy's."""
        with dr.suspend_grad():
            return self._value(device_tensor(mi.TensorXf, self._masked(image)), device_tensor(mi.TensorXf, picture)).numpy()

    def _pulled(self, image: Image, adjoint: Image) -> Image:
        """Gradient by the image, from that by the function's value."""
        given, found = self._attached(image, self._picture)
        dr.set_grad(found, device_tensor(mi.TensorXf, adjoint.reshape(found.shape)))
        dr.enqueue(dr.ADMode.Backward, found)
        dr.traverse(dr.ADMode.Backward)
        gradient = dr.grad(given).numpy()
        return np.nan_to_num(self._masked(gradient), nan=0, posinf=0, neginf=0)

    def _check_finite(self, values: npt.NDArray[Any], what: str) -> None:
        if not np.isfinite(values).all():
            raise ShadowmapError(
                f"{self.name}: {what} is not finite: add a small number below fractions and roots, and in logarithms, to which "
                "black, or pixels without difference, come."
            )


class OwnResiduals(_OwnFunction):
    """Comparison by a user's residuals.

    They are divided by their root mean square between the picture and one that shows nothing, its mean colour: one is then as
    large as the picture, as with colours.

    Args:
        function: residuals of an image and a picture, Float (k,) or a tensor of any shape; rows and columns come first.
        seen: the picture.

    Attributes:
        weight: (rows, columns, 1): that of the picture's pixels, for residuals (H, W, ...); of others all count alike. Zero for
            residuals that see much of pixels that do not count.

    Raises:
        ShadowmapError: The function fails, returns something else, has no derivatives, or values that are not finite.
    """

    kind = "residuals"

    def __init__(self, function: OwnFunction, seen: Observation) -> None:
        super().__init__(function, seen)
        self._scale, self._shape = 1.0, (0, 0, 0)
        black = np.zeros_like(self._picture)
        pictures = {"of the picture": self._picture, "of a picture of one colour": self._flat, "of a black picture": black}
        values = {what: self._shaped(self._plain(one, self._picture)) for what, one in pictures.items()}
        self._shape = values["of the picture"].shape
        for what, value in values.items():
            self._check_shape(value.shape)
            self._check_finite(value, f"the value {what}")
        # Steps of all sizes in all directions, always the same ones.
        step = np.random.default_rng(0).normal(size=self._picture.shape).astype(np.float32)
        for what, one in pictures.items():
            self._check_finite(self.derivatives(one, [step])[0], f"the derivative {what}")
        own = self._shape[:2] == seen.weight.shape
        self.weight = self._own_share() * (seen.weight[..., None] if own else np.float32(1))
        for what in ("of a picture of one colour", "of a black picture"):
            square = np.average(np.square(values[what], dtype=np.float64), weights=np.broadcast_to(self.weight, self._shape))
            if square > 0:
                self._scale = float(np.sqrt(square))
                break
        else:
            raise ShadowmapError(f"{self.name}: all are zero, even between the picture and a black one: they tell nothing.")

    def _own_share(self) -> Image:
        """(rows, columns, 1): 0 for residuals that see more than a little of pixels that do not count, 1 for others.

        Differences at the border of a mask are those between the picture and black. If all residuals see such pixels, as after a
        Fourier transform, all count.
        """
        ones = np.ones((*self._shape[:2], 1), np.float32)
        if self._counts.all():
            return ones
        generator, seen, parts = np.random.default_rng(1), [], (self._counts, ~self._counts)
        with self._uncovered():
            for counts in parts:
                steps = generator.normal(size=(_TRIALS, *self._picture.shape)) * counts
                effects = self.derivatives(self._picture, [np.asarray(step, np.float32) for step in steps])
                seen.append(np.sqrt(np.square(effects).mean(0)))
        kept = (seen[1] <= _LITTLE * (seen[0] + seen[1])).all(2, keepdims=True)
        return np.asarray(kept, np.float32) if kept.any() else ones

    def residuals(self, image: Image) -> Image:
        return self._against(image, self._picture)

    def derivatives(self, image: Image, changes: Sequence[Image]) -> list[Image]:
        return [self._pushed(image, change) for change in changes]

    def adjoint(self, image: Image, adjoint: Image) -> Image:
        return np.asarray(self._pulled(image, adjoint) / self._scale, np.float32)

    def contents(self, image: Image) -> tuple[Image, Image]:
        return self._against(image, self._flat), self._against(self._flat, self._picture)

    def _against(self, image: Image, picture: Image) -> Image:
        found = self._shaped(self._plain(image, picture))
        self._check_shape(found.shape)
        return np.asarray(found / self._scale, np.float32)

    def _pushed(self, image: Image, change: Image) -> Image:
        given, found = self._attached(image, self._picture)
        dr.set_grad(given, device_tensor(mi.TensorXf, self._masked(change)))
        dr.enqueue(dr.ADMode.Forward, given)
        dr.traverse(dr.ADMode.Forward)
        derivative = self._shaped(dr.grad(found).numpy())
        return np.asarray(derivative / self._scale, np.float32)

    def _check_shape(self, shape: tuple[int, ...]) -> None:
        if shape != self._shape:
            raise ShadowmapError(
                f"{self.name} returns {shape} numbers for one image and {self._shape} for another of the same size: return the "
                "same shape for all."
            )

    def _shaped(self, values: npt.NDArray[Any]) -> Image:
        """Values as (rows, columns, channels)."""
        shape = values.shape if values.ndim > 1 else (1, *values.shape)
        return np.asarray(values, np.float32).reshape(*shape[:2], -1)


class OwnLoss(_OwnFunction):
    """A user's loss of an image and a picture: one number.

    Raises:
        ShadowmapError: The function fails, returns something else, has no derivatives, or values that are not finite.
    """

    kind = "loss"

    def __init__(self, function: OwnFunction, seen: Observation) -> None:
        super().__init__(function, seen)
        for what, one in (("of the picture", self._picture), ("of a picture of one colour", self._flat)):
            self._check_finite(np.array(self.value(one)), f"the value {what}")
            self.gradient(one)

    def value(self, image: Image) -> float:
        """The loss of an image (H, W, 3)."""
        found = self._plain(image, self._picture)
        if found.size != 1:
            raise ShadowmapError(f"{self.name} returns {found.size:,} numbers: return one, or give the function as residuals=.")
        return float(found.reshape(-1)[0])

    def gradient(self, image: Image) -> Image:
        """Gradient of the loss by the image (H, W, 3). Entries that are not finite are zero."""
        return self._pulled(image, np.ones(1, np.float32))


def is_image(shape: tuple[int, ...]) -> bool:
    """True if residuals (rows, columns, channels) have neighbours along both axes."""
    return min(shape[:2]) >= _SHORTEST
