"""The slot ``light_paths``: how many paths are traced from lights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import mitsuba as mi
import numpy as np

from ..bidirectional.path_moments import Estimate, PathMoments
from ..bidirectional.technique_observer import TechniqueObserver
from ..learning.benefit import gain_of, is_worth, trimmed_batches
from ..learning.learner import Learner
from ..learning.pixel_estimates import relative_scale
from ..rendering.camera import film_extent
from ..scene.movers import movers
from .decision_parameters import DecisionParameters, Setting, Slots

#: The time of a ray of a bidirectional sample, in units of that of a ray of ``path``: BSDFs are
#: evaluated at both ends of a connection, and densities in both directions.
#: ``benchmarks/bidirectional.py`` measures 1.5 in door_ajar, 1.6 to 1.8 in seven other scenes, and
#: 2.2 in caustic. It is a constant, because with measured times two renders of the same seed could
#: choose differently.
_TIME_OF_A_RAY = 1.5

#: Number of samples from which the choice is made, unless the pilots have fewer.
_ENOUGH = 1 << 16


#: The most light paths for each camera path.
MOST_PATHS = 64.0


@dataclass(frozen=True)
class LightPathChoice:
    """
    Attributes:
        count: Number of light paths for each camera path; with 0, none are traced.
        observer: Observes their contributions.
    """

    count: float = 1.0
    observer: TechniqueObserver | None = None


class LightPathCount(DecisionParameters):
    """So many light paths for each camera path. The attribute is the parameter."""

    slots = ("light_paths",)

    def __init__(self, count: float) -> None:
        self.count = count

    @staticmethod
    def accepts(count: Any) -> bool:
        """Can a scene ask for so many?"""
        return type(count) in (int, float) and 0 <= count <= MOST_PATHS

    def decision(self, setting: Setting) -> LightPathChoice:
        return LightPathChoice(self.count)

    @property
    def sample_cost(self) -> int:
        return max(1, math.ceil(self.count))

    def describe(self, slots: Slots = MappingProxyType({})) -> str:
        return f"{self.count:g}"


def check_shared_rays(plugin: str, scene: mi.Scene, count: float) -> None:
    """
    Raises:
        NotImplementedError: Each camera path needs a light path of its wavelengths and time, and
            there would not be one for each.
    """
    if count not in (0, 1) and (mi.is_spectral or movers(scene)):
        why = "in spectral variants" if mi.is_spectral else "with moving shapes"
        raise NotImplementedError(
            f'"{plugin}": the parameter "light_paths" is {count:g}; {why}, each camera path needs '
            f"one light path: leave the parameter out"
        )


class LightPathsWhereTheyPay(DecisionParameters):
    """Light paths, unless the pilot finds that camera paths alone are more efficient."""

    name = "auto"
    slots = ("light_paths",)
    pilot_spp, pilot_paths = 8, _ENOUGH

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        # Only light paths find the light of beams that a surface emits in one direction
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

    The variance of a pixel is divided by the square of the mean radiance of the pixel and its
    neighbours.

    Parameters:
        film: The film of the sensor.

    Attributes:
        estimate: Estimate of the image and its variance, once the choice has been made.
        variance, cost: Variance and time of all techniques, relative to those of camera paths.
    """

    def __init__(self, film: mi.Film) -> None:
        self._width, height = film_extent(film)
        self._moments: PathMoments | None = PathMoments(film, self._width, height)
        self._choice = LightPathChoice(1.0, self._moments)
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
        # Here the batches are of pixels, not of paths
        gain, error = gain_of(trimmed_batches(whole, by_camera - whole))
        self.cost = _TIME_OF_A_RAY * float(moments.rays[0] / max(moments.rays[1], 1))
        self.variance = 1 - gain
        if moments.unreachable > 0:
            self.variance, error = 0.0, 0.0
        self._moments = None
        efficiency = 1 / (max(self.variance, 1e-3) * self.cost)
        self._choice = LightPathChoice(float(is_worth(efficiency, error, 1.0)))
        return self._choice

    def state(self) -> dict[str, np.ndarray]:
        return {"light_paths": np.array([self._choice.count])}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> LightPathChoice:
        self._moments = None
        self._choice = LightPathChoice(float(state["light_paths"][0]))
        return self._choice

    def __str__(self) -> str:
        kept = "light paths pay" if self._choice.count > 0 else "light paths do not pay"
        if np.isnan(self.variance):
            return kept
        return f"{kept} ({self.variance:.2f} of the variance, {self.cost:.1f} x the time)"
