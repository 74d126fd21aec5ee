"""Options of a fit: what varies, how images are compared, how long the search is."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from ..errors import ShadowmapError, shortened
from ..io.options import option
from ..io.ranges import check_ranges
from .losses import Loss, LossKind
from .own import Own
from .vary import Vary


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    Attributes:
        vary: entries of the list of things that vary.
        exposure, white_balance, vignetting: factors of each picture that are fitted.
        starts: number of starts; the first is the scene as it is.
        tries: most rounds of starts; another one follows, from wider ranges, while the scene does not explain the pictures.
        seed: of the other starts.
        resolution: pixels along the longer side of the last stage, at most the picture's.
        spp: samples per pixel.
        loss, delta: see :class:`~shadowmap_dr.fitting.losses.Loss`.
        steps: steps of Adam for vertices and textures.
        correct: correct the last images by images of the scene's own integrator, Mitsuba's: for light that bounces, and all else
            that shadow maps only approximate.
    """

    vary: tuple[Vary | Own, ...] = option(
        (),
        metavar="NAME[:KIND]",
        parse=Vary.parse,
        help="Object or value that varies, for instance bunny:pose, sun:direction, wall.bsdf.reflectance; repeatable. Further: "
        "bunny:translation:xz, and after commas min, max, prior and spread, for instance sun:direction,spread=60.",
    )
    exposure: bool = option(False, help="Fit the exposure of each picture.")
    white_balance: bool = option(False, help="Fit an exposure of each colour, of each picture.")
    vignetting: bool = option(False, help="Fit the darkening of each picture towards its corners.")
    starts: int = option(8, allowed=(1, 1024), help="Starts; the first is the scene as it is.")
    tries: int = option(3, allowed=(1, 100), help="Most rounds of starts; another one follows while nothing is found.")
    seed: int = option(0, allowed=(0, 2**32 - 1), help="Seed of the other starts.")
    resolution: int = option(
        256, allowed=(8, 2048), help="Pixels along the longer side of the last images, at most the picture's."
    )
    spp: int = option(4, allowed=(1, 64), help="Samples per pixel.")
    loss: LossKind = option("huber", help="Loss of the differences.")
    delta: float = option(0.1, help="Difference, as a share of the picture's brightness, above which huber grows slower.")
    steps: int = option(200, allowed=(1, 100_000), help="Steps for vertices and textures.")
    correct: bool = option(True, help="Correct the last images by those of the scene's own integrator.")

    def __post_init__(self) -> None:
        check_ranges(self)
        Loss(self.loss, self.delta)
        if self.exposure and self.white_balance:
            raise ShadowmapError("exposure and white_balance: leave exposure out; white balance has an exposure of each colour.")
        for label, count in Counter(vary.label for vary in self.vary).items():
            if count > 1:
                raise ShadowmapError(f"vary {shortened(label)} is given twice: give it once.")
