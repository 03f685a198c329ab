"""The slot ``light_paths``: whether paths are traced from lights at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..bidirectional.path_moments import Estimate, PathMoments
from ..bidirectional.technique_observer import TechniqueObserver
from ..learning.benefit import gain_of, is_worth, trimmed_batches
from ..learning.learner import Learner
from ..learning.pixel_estimates import relative_scale
from ..rendering.camera import film_extent
from .decision_parameters import DecisionParameters, Setting

#: The time of a ray of a bidirectional sample, in units of that of a ray of ``path``: both ends of
#: a connection are evaluated, forth and back. ``benchmarks/bidirectional.py`` measures 1.5 in
#: door_ajar, 1.6 to 1.8 in seven other scenes, and 2.2 in caustic. A clock would make equal seeds
#: choose differently.
_TIME_OF_A_RAY = 1.5

#: Samples from which the choice is made, unless the pilots have less.
_ENOUGH = 1 << 16


@dataclass(frozen=True)
class LightPathChoice:
    """Whether light paths are traced, and who is told what they find."""

    are_traced: bool
    observer: TechniqueObserver | None = None


class LightPathsWhereTheyPay(DecisionParameters):
    """Light paths, unless the pilot finds that camera paths alone are more efficient."""

    name = "auto"
    slots = ("light_paths",)
    pilot_spp, pilot_paths = 8, _ENOUGH

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        # Beams that leave a surface are found by light paths only
        beam = int(mi.EmitterFlags.Surface) | int(mi.EmitterFlags.DeltaDirection)
        emitters = scene.emitters()
        return spp > 0 and bool(emitters) and all(int(e.flags()) & beam != beam for e in emitters)

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return LightPathTrial(setting.sensor.film())


class LightPathTrial(Learner):
    """Compares the variance of all techniques, times the time that they take, with that of camera
    paths alone. The time is estimated from the number of rays.

    Variance is relative to the square of what a pixel shows, its neighbours included.

    Parameters:
        film: Of the sensor.

    Attributes:
        estimate: Of the image and its variance, once the choice has been made.
        variance, cost: Of all techniques, in units of those of camera paths.
    """

    def __init__(self, film: mi.Film) -> None:
        self._width, height = film_extent(film)
        self._moments: PathMoments | None = PathMoments(film, self._width, height)
        self._choice = LightPathChoice(True, self._moments)
        self.estimate: Estimate | None = None
        self.variance = self.cost = float("nan")

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> LightPathChoice:
        return self._choice

    def learn(self, scene: mi.Scene, is_last: bool) -> LightPathChoice | None:
        moments = self._moments
        if moments is None or (moments.samples < _ENOUGH and not is_last):
            return None
        self.estimate = estimate = moments.estimate()
        image = estimate.mean.reshape(-1, self._width)
        weight = relative_scale(image).ravel() ** 2
        whole, by_camera = (
            variance * weight for variance in (estimate.bidirectional, estimate.by_camera)
        )
        # Pixels take the place of paths
        gain, error = gain_of(trimmed_batches(whole, by_camera - whole))
        self.cost = _TIME_OF_A_RAY * float(moments.rays[0] / max(moments.rays[1], 1))
        self.variance = 1 - gain
        if moments.unreachable > 0:
            self.variance, error = 0.0, 0.0
        self._moments = None
        efficiency = 1 / (max(self.variance, 1e-3) * self.cost)
        self._choice = LightPathChoice(is_worth(efficiency, error, 1.0))
        return self._choice

    def state(self) -> dict[str, np.ndarray]:
        return {"light_paths": np.array([self._choice.are_traced])}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> LightPathChoice:
        self._moments = None
        self._choice = LightPathChoice(bool(state["light_paths"][0]))
        return self._choice

    def __str__(self) -> str:
        kept = "light paths pay" if self._choice.are_traced else "light paths do not pay"
        if np.isnan(self.variance):
            return kept
        return f"{kept} ({self.variance:.2f} of the variance, {self.cost:.1f} x the time)"
