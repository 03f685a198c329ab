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
from ....planning import verdicts
from ....planning.costs import (
    CONNECTED,
    CONNECTION,
    GRID,
    LIGHT_SEGMENT,
    LOOK,
    SEGMENT,
    SHADOW,
    SUMS,
)
from ....planning.learner import Learner, Pilot
from ....planning.prediction import Effect
from ....planning.prediction_check import PredictionCheck
from ....planning.technique import Setting, Slots, Technique
from ....planning.trial import Rival, Trial
from ....rendering.camera import film_extent, first_pixel
from ....scene.movers import movers
from ....util.stored_arrays import StoredArrays
from .candidates import MOST_TRIED, Candidate
from .path_moments import Counts, Estimate, PathMoments
from .photon_samples import PHOTONS, PhotonSamples
from .predicted_errors import PredictedErrors
from .technique_observer import TechniqueObserver

#: Number of samples from which the choice is made, unless the pilots have fewer.
_ENOUGH = 1 << 15


#: The largest and the least number of samples of a sparse trial, which has at least two samples of
#: each pixel of its film; and the largest share of all samples that it may have. A sample of a
#: trial takes seven to thirty times as long as one of ``path``. (4096 samples left merging out in
#: water_glass, where it matters; but they tell that light paths do not pay.)
_SPARSE, _LEAST_SPARSE, _MOST = 1 << 14, 1 << 12, 1 / 64

#: The largest share in media, where a sample merges at all vertices, and photons follow: a trial of
#: 16384 samples takes 1.3 s of CPU time in rooms in fog, and 0.25 s without merging and photons.
_MOST_IN_MEDIA = _MOST / 4

#: The least share of missing light that statistics report.
_MIN_REPORTED_MISSING = 1e-3

#: The most light paths for each camera path.
MOST_PATHS = 64.0


@dataclass(frozen=True)
class LightPathChoice:
    """
    Attributes:
        techniques: What a render uses of the techniques that it has.
        observer: Observes their contributions.
        pixel_width: The paths belong to a film with fewer pixels; this is the width of such a pixel
            in pixels of the real film.
        photons: Receives samples of photons beside these techniques; ``None`` for no such samples.
    """

    techniques: Candidate = Candidate(1.0, merges=True)
    observer: TechniqueObserver | None = None
    pixel_width: float = 1.0
    photons: PhotonSamples | None = None


class LightPathCount(Technique):
    """A number of light paths for each camera path. The attribute is the parameter."""

    slots, values = ("light_paths",), f"a number from 0 to {MOST_PATHS:g}"

    def __init__(self, count: float) -> None:
        self.count = count

    @classmethod
    def of_value(cls, plugin: str, slot: str, value: Any) -> LightPathCount | None:
        is_number = type(value) in (int, float)
        return cls(float(value)) if is_number and 0 <= value <= MOST_PATHS else None

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


class AutoLightPaths(Technique):
    """Chooses the number of light paths, and their techniques, by what a pilot finds to be worth
    the time."""

    name = "auto"
    slots, words = ("light_paths",), {"auto": {}}
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


TECHNIQUES = AutoLightPaths, LightPathCount


class LightPathTrial(Trial):
    """Chooses the candidate with the least squared error of a render of this length
    (:class:`PredictedErrors`), times its time. The time is estimated from the number of rays.

    Parameters:
        film: The film of the sensor.
        spp: Samples per pixel of the render.
        most: About the number of :attr:`samples` of a sparse trial: a stage of its own, whose image
            is not kept. 0 for pilots of all pixels.
        has_photons: Whether photons (:class:`PhotonSamples`) are a candidate. They are tried only
            if the render is long enough.

    Attributes:
        samples: The pixel of each sample of the trial.
        rival: What light paths had to beat.
        estimate: Estimate of the image and its variance, once the choice has been made.
        candidates: What was compared, once the choice has been made.
        predicted, costs: Errors and time of each candidate, relative to ``path``.
        check: Checks what was chosen; ``None`` if that is ``path``.
    """

    def __init__(
        self, film: mi.Film, spp: int, most: int = 0, has_photons: bool = False
    ) -> None:
        extent = film_extent(film)
        coarse = CoarseFilm.of(*extent, most) if most else CoarseFilm.whole(*extent)
        self._film, self._coarse, self._has_photons = film, coarse, has_photons
        corner, self._width = first_pixel(film), coarse.width
        self._moments: PathMoments | None = PathMoments(coarse, corner, extent[0], spp)
        is_tried = has_photons and PhotonSamples.is_possible(coarse.pixel_count * spp)
        self._choice = LightPathChoice(
            observer=self._moments, pixel_width=coarse.pixel_width,
            photons=PhotonSamples(coarse, spp) if is_tried else None,
        )  # fmt: skip
        self.samples, self._spp, self._pixel_count = coarse.samples, spp, coarse.pixel_count
        #: The number of samples of a trial that follows this one
        self._more = 0
        self.rival = Rival()
        self.estimate: Estimate | None = None
        self.candidates: list[Candidate] = []
        self.predicted: PredictedErrors | None = None
        self.costs = np.zeros(0)
        self.check: PredictionCheck | None = None
        self.discards_pilots: bool | None = None

    @property
    def chosen_time(self) -> float:
        """The time of a sample of what was chosen, relative to ``path``."""
        return float(self.costs[self._best])

    @property
    def path_variance(self) -> tuple[float, float] | None:
        return None if self.predicted is None else self.predicted.of_image

    @property
    def can_be_guided(self) -> bool:
        # Beside merging, it was not tried
        return not self._choice.techniques.merges

    def leaves_out(self, slot: str, finds_all_light: bool) -> bool:
        # Photons bring all light: nothing is connected to lights
        return finds_all_light or (self._choice.techniques.alone and slot == "next_event")

    @classmethod
    def in_own_stage(cls, film: mi.Film, has_photons: bool, spp: int) -> LightPathTrial:
        """A sparse trial. Where photons are no candidate, it is a small one at first."""
        share = _MOST_IN_MEDIA if has_photons else _MOST
        most = _trial_samples(math.prod(film_extent(film)) * spp * share)
        if has_photons or most <= _LEAST_SPARSE:
            return cls(film, spp, most, has_photons)
        trial = cls(film, spp, _LEAST_SPARSE)
        trial._more = most
        return trial

    @staticmethod
    def is_possible(pixel_count: int, spp: int) -> bool:
        """Whether a sparse trial is worth its time, for a render with ``spp`` samples in each of
        ``pixel_count`` pixels."""
        return _LEAST_SPARSE <= spp * pixel_count * _MOST

    def first_choice(self) -> LightPathChoice:
        return self._choice

    def learn(self, pilot: Pilot) -> LightPathChoice:
        moments = self._moments
        if moments is not None and (moments.samples >= _ENOUGH or pilot.is_last):
            self.choose(Rival())
        return self._choice

    def larger(self, rival: Rival) -> LightPathTrial | None:
        if self._more == 0:
            return None
        self._compare(rival)
        if verdicts.is_beaten(*self._compared):
            return None
        larger = LightPathTrial(self._film, self._spp, self._more)
        # Pilots decide whether there is a larger trial: it must not decide about them
        larger.discards_pilots = self.discards_pilots
        return larger

    def choose(self, rival: Rival) -> LightPathChoice | None:
        if self._moments is not None:
            self._compare(rival)
        self._best, self._best_with_light_paths = verdicts.best(*self._compared)
        self._choice = LightPathChoice(self.candidates[self._best])
        if self._best == 0:
            return None
        self.check = PredictionCheck(self._film, self._coarse, self.predicted.of_path)
        return self._choice

    def _compare(self, rival: Rival) -> None:
        """Predicts errors and time of each candidate."""
        moments, self._moments, self.rival = self._moments, None, rival
        self.candidates, self.estimate = list(moments.candidates), moments.estimate()
        photons = self._choice.photons and self._choice.photons.estimate(self.estimate.mean)
        self.predicted = predicted = PredictedErrors.of(
            self.estimate, self._width, self._spp, self._pixel_count, photons
        )
        times = [cost(candidate, moments.counts) for candidate in self.candidates]
        if photons is not None:
            self.candidates.append(PHOTONS)
            times.append(cost(PHOTONS, photons.counts))
        self.costs = np.divide(times, times[0])
        efficiencies, nothing = 1 / (predicted.variances * self.costs), np.ones(len(times))
        if self.discards_pilots is None:
            alone, _ = verdicts.best(efficiencies, predicted.uncertainty, 1.0, nothing)
            # Where ``path`` cannot find some of the light, this is 0
            self.discards_pilots = bool(predicted.long_run[alone] < verdicts.FAR_LESS)
        guided = np.array([self._of_guides(candidate) for candidate in self.candidates])
        if self._has_photons:
            # Many candidates merge, or are photons, and leave out guides that others keep
            efficiencies[1:] *= guided[1:]
            guided[:] = 1
            if photons is not None:
                efficiencies[-1] /= verdicts.PHOTONS_ALONE
        self._compared = efficiencies, predicted.uncertainty, rival.efficiency, guided

    def reconsider(self, rival: Rival) -> LightPathChoice | None:
        """``path``, if light paths have more variance than predicted, and less efficiency."""
        self.rival = rival
        least = rival.efficiency / self._of_guides(self._choice.techniques)
        if self.check is None or not self.check.failed(self.chosen_time, least):
            return None
        self._choice = LightPathChoice(Candidate(0.0))
        return self._choice

    def _of_guides(self, techniques: Candidate) -> float:
        """The efficiency that guided directions are expected to have beside light paths; 1 with
        merging, which has no guided directions."""
        return 1.0 if techniques.merges else verdicts.beside_light_paths(self.rival.guides)

    def state(self) -> dict[str, np.ndarray]:
        return {"light_paths": np.array(astuple(self._choice.techniques), float)}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> LightPathChoice:
        self._moments = None
        count, connections, *flags = state.take("light_paths", "f", (4,), 0, MOST_TRIED)
        techniques = Candidate(float(count), int(connections), *map(bool, flags))
        state.require(self._has_photons or not techniques.alone, "photons are no candidate here")
        self._choice = LightPathChoice(techniques)
        return self._choice

    @property
    def effect(self) -> Effect:
        techniques = self._choice.techniques
        is_kept = techniques.light_paths > 0
        if self.estimate is None:
            return Effect(is_kept, about=asdict(techniques))
        index, predicted = self._shown, self.predicted
        variance = expected = predicted.variances[index]
        about = {
            "rival": self.rival.efficiency, **asdict(self.candidates[index]),
            "missed": predicted.missed[index], "missed_by_path": predicted.missed[0],
            "predicted_variance": expected,
        }  # fmt: skip
        if self._measured is not None:
            about["measured_variance"] = variance = self._measured
        figures = {"trimmed_variance": predicted.trimmed, "long_run_variance": predicted.long_run}
        about |= {name: x[index] * variance / expected for name, x in figures.items()}
        return Effect(is_kept, float(variance), float(self.costs[index]), about)

    @property
    def _measured(self) -> float | None:
        return self.check.variance if self.check else None

    @property
    def _shown(self) -> int:
        """What was chosen; if that is ``path``, the best of the others."""
        return self._best or self._best_with_light_paths

    def __str__(self) -> str:
        techniques = self._choice.techniques
        pays = techniques.light_paths > 0
        kept = "light paths do not pay"
        if pays:
            kept = f"light paths pay: {techniques}"
        if self.estimate is None:
            return kept
        # In units of ``path``
        predicted, index = self.predicted, self._shown
        measured = "" if self._measured is None else f", {self._measured:.2f} measured"
        text = (
            f"{kept} ({predicted.variances[index]:.2f} of the variance{measured}, "
            f"{self.costs[index]:.1f} x the time)"
        )
        # After going back to ``path``, the light that ``path`` misses
        missed = predicted.missed[self._best if pays else 0]
        is_told = missed >= _MIN_REPORTED_MISSING
        return f"{text}; {missed:.1%} of the light is missing" if is_told else text


def _trial_samples(most: float) -> int:
    """The number of samples of a sparse trial that may have ``most``."""
    count = _SPARSE
    while count > max(_LEAST_SPARSE, most):
        count //= 2
    return count


def cost(techniques: Candidate, counts: Counts) -> float:
    """The time that the samples of a pilot would take with only these techniques, in the units of
    :data:`SEGMENT`. ``counts`` holds the counts of all techniques, with one light path for each
    camera path."""
    time = SEGMENT * counts.camera_rays + SHADOW * counts.tested
    if techniques.light_paths == 0:
        return time
    time += SUMS * counts.camera_rays + techniques.light_paths * LIGHT_SEGMENT * counts.light_rays
    of_connection = CONNECTION * counts.camera_rays + CONNECTED * counts.connected
    time += techniques.connections * of_connection
    if techniques.merges:
        time += GRID * techniques.light_paths * counts.light_rays + LOOK * counts.looked
    return time
