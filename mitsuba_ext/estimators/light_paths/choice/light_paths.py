"""The slot ``light_paths``: how many paths are traced from lights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from types import MappingProxyType
from typing import Any

import mitsuba as mi
import numpy as np

from ....images.coarse_film import CoarseFilm
from ....planning.benefit import SEGMENT, SHADOW, expected_gain
from ....planning.decision_parameters import DecisionParameters, Setting, Slots
from ....planning.effect import Effect
from ....planning.learner import Learner
from ....planning.promise import Promise
from ....rendering.camera import film_extent, first_pixel
from ....scene.movers import movers
from ....util.stored_arrays import StoredArrays
from .candidates import MOST_TRIED, Candidate
from .path_moments import Counts, Estimate, PathMoments
from .predicted_errors import PredictedErrors
from .technique_observer import TechniqueObserver

#: The time of what a sample does, in the units of :data:`SEGMENT`: partial sums along a segment of
#: a camera path; a segment of a light path. A connection of each vertex, and its shadow ray. With
#: merging: a vertex that is put into the grid; vertices and cells that are looked at. They are
#: constants, because with measured times two renders of the same seed could choose differently. (A
#: fit to seven sets of techniques without merging in 14 scenes, and to three, two of them with
#: merging, in seven: 0.91 of the times within 1.2. spotlights takes 1.1 to 1.6 times as long.)
_SUMS, _LIGHT_SEGMENT, _CONNECTION, _CONNECTED, _GRID, _LOOK = 0.17, 3.1, 0.3, 1.3, 0.7, 0.1

#: Number of samples from which the choice is made, unless the pilots have fewer.
_ENOUGH = 1 << 15


#: Most and least samples of a sparse trial, which has at least two of each pixel of its film, and
#: the largest share of all samples that it may have: one takes about seven times as long as one of
#: ``path``. (Trials of all sizes kept the same techniques in twelve scenes.)
_SPARSE, _LEAST_SPARSE, _MOST = 1 << 14, 1 << 12, 1 / 64

#: Guided directions are expected to keep this power of their efficiency beside light paths. (The
#: first pilots with both have guides of few samples, and show less.)
_KEPT = 0.5

#: Where light paths pay, what was learned for these slots is left out: it is for camera paths that
#: find all light alone. (Guides are learned again.)
OF_CAMERA_PATHS = ("directions", "roulette", "time", "aperture", "wavelength", "distance")

#: The least share of missing light of which a render tells.
_WORTH_A_WORD = 1e-3

#: The most light paths for each camera path.
MOST_PATHS = 64.0


@dataclass(frozen=True)
class LightPathChoice:
    """
    Attributes:
        techniques: What a render uses of the techniques that it has.
        observer: Observes their contributions.
        pixel_width: The paths are those of a film with fewer pixels, each as wide as so many of the
            film's.
    """

    techniques: Candidate = Candidate(1.0, merges=True)
    observer: TechniqueObserver | None = None
    pixel_width: float = 1.0


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
        return LightPathChoice(Candidate(self.count, merges=True))

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
    """As many light paths, and those of their techniques, as a pilot finds to be worth the time."""

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
        return LightPathTrial(setting.sensor.film(), setting.spp)


class LightPathTrial(Learner):
    """Chooses the candidate with the least squared error of a render of this length
    (:class:`PredictedErrors`), times its time. The time is estimated from the number of rays.

    Parameters:
        film: The film of the sensor.
        spp: Samples per pixel of the render.
        is_sparse: Is one stage of :attr:`samples` enough, whose image is not kept? If not, there
            are pilots of all pixels.

    Attributes:
        samples: A pixel for each sample, of these only.
        rival: The efficiency of ``path`` with what else was learned for it, relative to ``path``.
        guide_efficiency: That of guided directions, of which :attr:`rival` is a multiple.
        estimate: Estimate of the image and its variance, once the choice has been made.
        candidates: What was compared, once the choice has been made.
        predicted, costs: Errors and time of each candidate, relative to ``path``.
        leaves_out: If light paths pay, these slots decide as ``path``.
        promise: Tests what was chosen; ``None`` if that is ``path``.
    """

    leaves_out = OF_CAMERA_PATHS

    def __init__(self, film: mi.Film, spp: int, is_sparse: bool = False) -> None:
        extent = film_extent(film)
        if is_sparse:
            coarse = CoarseFilm.of(*extent, _trial_samples(extent[0] * extent[1] * spp))
        else:
            coarse = CoarseFilm.whole(*extent)
        self._film, self._coarse = film, coarse
        corner, self._width = first_pixel(film), coarse.width
        self._moments: PathMoments | None = PathMoments(coarse, corner, extent[0], spp)
        self._choice = LightPathChoice(
            observer=self._moments, pixel_width=coarse.pixel_width
        )
        self.samples, self._spp, self._pixel_count = coarse.samples, spp, coarse.pixel_count
        self.rival = self.guide_efficiency = 1.0
        self.estimate: Estimate | None = None
        self.candidates: list[Candidate] = []
        self.predicted: PredictedErrors | None = None
        self.costs = np.zeros(0)
        self.promise: Promise | None = None

    @property
    def chosen_variance(self) -> float:
        """The variance of what was chosen, relative to ``path``; 0 if this cannot find some of the
        light."""
        return float(self.predicted.long_run[self._best])

    @property
    def chosen_cost(self) -> float:
        """The time of a sample of what was chosen, relative to ``path``."""
        return float(self.costs[self._best])

    @property
    def can_be_guided(self) -> bool:
        """Are camera paths guided beside what was chosen? (Beside merging, it was not tried.)"""
        return not self._choice.techniques.merges

    @staticmethod
    def is_possible(pixel_count: int, spp: int) -> bool:
        """Is a sparse trial worth its time, for a render of so many samples?"""
        return _LEAST_SPARSE <= spp * pixel_count * _MOST

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> LightPathChoice:
        return self._choice

    def learn(self, scene: mi.Scene, is_last: bool) -> LightPathChoice | None:
        moments = self._moments
        if moments is None or (moments.samples < _ENOUGH and not is_last):
            return None
        self._moments, self.candidates = None, moments.candidates
        self.estimate = estimate = moments.estimate()
        self.predicted = predicted = PredictedErrors.of(
            estimate, self._width, self._spp, self._pixel_count
        )
        costs = np.array([cost(c, moments.counts) for c in moments.candidates])
        self.costs = costs / costs[0]
        # Prior: the efficiency is that of all techniques
        efficiencies = 1 / (predicted.variances * self.costs)
        efficiencies /= efficiencies[1]
        efficiencies[0] *= self.rival
        gains = [expected_gain(*x) for x in zip(efficiencies, predicted.uncertainty)]
        best = self._best_with_light_paths = 1 + int(np.argmax(gains[1:]))
        gains[best] += math.log(self._of_guide(moments.candidates[best]))
        self._best = best if gains[best] > gains[0] else 0
        self._choice = LightPathChoice(moments.candidates[self._best])
        if self._best > 0:
            self.promise = Promise(self._film, self._coarse, predicted.of_path)
        return self._choice

    def reconsider(self, time: float, margin: float) -> LightPathChoice | None:
        """What is chosen instead of light paths if these have not kept their promise: ``path``, for
        which :attr:`rival` says what matters, and which needs no margin. See :class:`PhotonTrial`.
        """
        rival = self.rival / self._of_guide(self._choice.techniques)
        if self.promise is None or not self.promise.is_broken(self.chosen_cost, rival):
            return None
        self._choice = LightPathChoice(Candidate(0.0))
        return self._choice

    def _of_guide(self, techniques: Candidate) -> float:
        """The efficiency that guided directions are expected to have beside light paths; 1 with
        merging, where there are none."""
        return 1.0 if techniques.merges else self.guide_efficiency**_KEPT

    def state(self) -> dict[str, np.ndarray]:
        return {"light_paths": np.array(astuple(self._choice.techniques), float)}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> LightPathChoice:
        self._moments = None
        count, connections, merges = state.take("light_paths", "f", (3,), 0, MOST_TRIED)
        self._choice = LightPathChoice(Candidate(float(count), int(connections), bool(merges)))
        return self._choice

    @property
    def effect(self) -> Effect:
        techniques = self._choice.techniques
        is_kept = techniques.light_paths > 0
        if self.estimate is None:
            return Effect(is_kept, about=asdict(techniques))
        index, predicted = self._shown, self.predicted
        variance = promised = predicted.variances[index]
        about = {
            "rival": self.rival, **asdict(self.candidates[index]),
            "missed": predicted.missed[index], "missed_by_path": predicted.missed[0],
            "predicted_variance": promised,
        }  # fmt: skip
        if self._measured is not None:
            about["measured_variance"] = variance = self._measured
        figures = {"trimmed_variance": predicted.trimmed, "long_run_variance": predicted.long_run}
        about |= {name: x[index] * variance / promised for name, x in figures.items()}
        return Effect(is_kept, float(variance), float(self.costs[index]), about)

    @property
    def _measured(self) -> float | None:
        return self.promise.variance if self.promise else None

    @property
    def _shown(self) -> int:
        """What was chosen; if that is ``path``, the best of the others."""
        return self._best or self._best_with_light_paths

    def __str__(self) -> str:
        techniques = self._choice.techniques
        pays = techniques.light_paths > 0
        kept = f"light paths pay: {techniques}" if pays else "light paths do not pay"
        if self.estimate is None:
            return kept
        # In units of ``path``
        predicted, index = self.predicted, self._shown
        measured = "" if self._measured is None else f", {self._measured:.2f} measured"
        text = (
            f"{kept} ({predicted.variances[index]:.2f} of the variance{measured}, "
            f"{self.costs[index]:.1f} x the time)"
        )
        # After going back, that of ``path``
        missed = predicted.missed[self._best if pays else 0]
        return text if missed < _WORTH_A_WORD else f"{text}; {missed:.1%} of the light is missing"


def _trial_samples(samples: int) -> int:
    """The samples of a sparse trial in a render of so many. There are few sizes, as kernels contain
    that of the coarse film."""
    count = _SPARSE
    while count > max(_LEAST_SPARSE, samples * _MOST):
        count //= 2
    return count


def cost(techniques: Candidate, counts: Counts) -> float:
    """The time of the samples of a pilot, had they only these techniques, in the units of
    :data:`SEGMENT`. ``counts`` are those of all techniques, with one light path for each camera
    path."""
    time = SEGMENT * counts.camera_rays + SHADOW * counts.tested
    if techniques.light_paths == 0:
        return time
    time += _SUMS * counts.camera_rays + techniques.light_paths * _LIGHT_SEGMENT * counts.light_rays
    of_connection = _CONNECTION * counts.camera_rays + _CONNECTED * counts.connected
    time += techniques.connections * of_connection
    if techniques.merges:
        time += _GRID * techniques.light_paths * counts.light_rays + _LOOK * counts.looked
    return time
