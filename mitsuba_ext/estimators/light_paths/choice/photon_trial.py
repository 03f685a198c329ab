"""Decides whether photons render a scene with participating media."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ....images.box_filter import box_means
from ....images.coarse_film import CoarseFilm
from ....planning import verdicts
from ....planning.evidence import gain_of, trimmed_batches
from ....planning.pixel_estimates import relative_scale
from ....planning.prediction import Effect
from ....planning.prediction_check import PredictionCheck
from ....planning.trial import Rival, Trial
from ....rendering.camera import film_extent
from ....transport.estimator import CameraRays, Estimator, Sample
from ....transport.numbers import Numbers, schedule_state
from ....transport.walk import Walk
from ....util.arrays import add_own, channel_mean, to_host
from ....util.stored_arrays import StoredArrays
from ..path_tracer import camera_paths
from ..photons.photon_history import HiddenLight, HiddenLightProgram
from ..photons.photon_mapper import PhotonMapper
from .candidates import Candidate
from .light_paths import cost
from .path_moments import Counts
from .technique_observer import TechniqueObserver

#: The least number of samples of a render that has a trial, the camera samples of each of its
#: passes, and its passes of photons and of ``path``. (The trial takes about as long as half a
#: million samples of ``path``.)
_LEAST, _SAMPLES, _PHOTON_PASSES, _PATH_PASSES = 1 << 21, 1 << 13, 2, 16

#: The squared relative bias of photons after one sample of each pixel; it falls with the root of
#: the number of samples. (After 64, it was 0.012 in volume_caustic, and 0 to 0.001 in four others.)
_SQUARED_BIAS = 0.03

PHOTONS, NO_PHOTONS = Candidate(1.0, connections=0, merges=True), Candidate(0.0)


@dataclass(frozen=True)
class PhotonChoice:
    """
    Attributes:
        techniques: What a render uses: :data:`PHOTONS` or :data:`NO_PHOTONS`.
        trial: Compares both.
    """

    techniques: Candidate = NO_PHOTONS
    trial: PhotonTrial | None = None

    def estimator(self, walk: Walk, mapper: Callable[[], PhotonMapper]) -> Estimator:
        """The estimator of a stage: ``walk`` traces camera paths; ``mapper`` makes the estimator
        with photons."""
        if self.trial is not None:
            return self.trial.estimator(walk, mapper())
        return mapper() if self.techniques == PHOTONS else walk


class PhotonTrial(Trial):
    """Compares progressive photon mapping with camera paths, which have to find all light by
    themselves. Both take samples of a coarse film that are no part of the image.

    What is compared is variance times time, as in :class:`LightPathTrial`. Photons have two kinds
    of variance: the samples of a pass share photons, whose noise more samples in the pass do not
    reduce. Several passes, which have photons of their own, tell the two kinds apart.

    The sample variance of camera paths is far too small where they find light rarely. This is light
    that no connection reaches, for example from a lamp in glass: a camera path has to hit the lamp.
    But photons find this light (:class:`HiddenLight`). Let a photon bring f / p to a pixel, where a
    camera path of density q, which hits the lamp, brings f / q, about the lamp's radiance. The
    second moment of camera paths is the integral of f² / q, which (f / p) (f / q) estimates, as in
    :class:`PathMoments`. Light that no camera path finds is an error of the mean: it counts as the
    variance that makes an error of this size in the whole render.

    Parameters:
        film: The film of the sensor.
        spp: Samples per pixel of the render.

    Attributes:
        samples: A pixel for each sample of a pass.
        rival: What photons had to beat.
        variance, time: Variance and time of photons, relative to ``path``, once the choice has been
            made.
        check: Checks the choice of camera paths; ``None`` if photons were chosen, since there are
            no pilots after that.
    """

    can_be_guided = False

    def __init__(self, film: mi.Film, spp: int) -> None:
        width, height = film_extent(film)
        coarse = CoarseFilm.of(width, height, _SAMPLES)
        self._film, self._coarse, self._spp = film, coarse, spp
        pixels = coarse.width * coarse.height
        self._photons: _Samples | None = _Samples(pixels)
        self._path: _Samples | None = _Samples(pixels)
        self._choice = PhotonChoice()
        self._mapper: PhotonMapper | None = None
        self.samples, self.rival = coarse.samples, Rival()
        self.variance: float | None = None
        self.time: float | None = None
        self.check: PredictionCheck | None = None

    @classmethod
    def in_own_stage(cls, film: mi.Film, spp: int) -> PhotonTrial:
        """A trial, which always has a stage of its own."""
        return cls(film, spp)

    @staticmethod
    def is_possible(pixel_count: int, spp: int) -> bool:
        """Whether a trial is worth its time, for a render with ``spp`` samples in each of
        ``pixel_count`` pixels."""
        return _LEAST <= spp * pixel_count

    @property
    def chosen_variance(self) -> float:
        """The variance of what was chosen, relative to the variance of the samples before."""
        if self._choice.techniques != PHOTONS:
            return 1.0
        return self.variance if self.check is None else 1 / self.check.variance

    def estimator(self, walk: Walk, mapper: PhotonMapper) -> TrialPasses:
        """Takes the samples, for the whole film: ``walk`` takes the samples of camera paths,
        ``mapper`` the samples of photons."""
        self._mapper = mapper
        coarse = mapper.of_coarse_film(self._coarse.pixel_width)
        light_walk = replace(coarse.light_walk, program=HiddenLightProgram())
        coarse = replace(coarse, light_walk=light_walk, observer=self._photons)
        return TrialPasses(walk, coarse, self._path)

    @property
    def chosen_time(self) -> float:
        return self.time if self._choice.techniques == PHOTONS else 1.0

    def leaves_out(self, slot: str, finds_all_light: bool) -> bool:
        # Photons bring all light: nothing is connected to lights
        return finds_all_light or slot == "next_event"

    def first_choice(self) -> PhotonChoice:
        return PhotonChoice(PHOTONS, self)

    def choose(self, rival: Rival) -> PhotonChoice | None:
        self.rival = rival
        photons, path = np.array(self._photons.passes), np.concatenate(self._path.passes)
        image = photons.mean(axis=(0, 1)).reshape(-1, self._coarse.width)
        weight = relative_scale(image).ravel() ** 2
        of_photons = self._of_photons(photons) * weight + _SQUARED_BIAS * np.sqrt(self._spp)
        found = np.var(path, axis=0, ddof=1) * weight
        hidden = self._hidden() * weight
        self.variance = _ratio(of_photons, np.maximum(found, hidden))[0]
        self.time = (
            cost(PHOTONS, self._photons.counts) / photons.size
            / (cost(NO_PHOTONS, self._path.counts) / path.size)
        )  # fmt: skip
        # What was learned for camera paths seldom helps to hit a light
        ratio, error = _ratio(of_photons, np.maximum(found / rival.efficiency, hidden))
        pays = verdicts.is_worth(1 / (ratio * self.time), error, 1.0)
        self._choice = PhotonChoice(PHOTONS if pays else NO_PHOTONS)
        if not pays:
            # Pilots may hold none of the rare hits of hidden lights
            of_photons /= weight
            self.check = PredictionCheck(
                self._film, self._coarse, of_photons, self._hidden(), weight
            )
        # Frees what it holds
        self._mapper, self._photons, self._path = None, None, None
        return self._choice if pays else None

    def reconsider(self, rival: Rival, time: float, margin: float) -> PhotonChoice | None:
        """Photons, if they are better than camera paths with all that was learned for camera paths;
        otherwise ``None``."""
        if self.check is None or not self.check.failed(time / self.time, 1 / margin):
            return None
        self._choice = PhotonChoice(PHOTONS)
        return self._choice

    def _of_photons(self, values: np.ndarray) -> np.ndarray:
        """The variance of each pixel, for one sample of it."""
        samples = values.shape[1]
        own = values.var(axis=1, ddof=1).mean(axis=0)
        of_photons = values.mean(axis=1).var(axis=0, ddof=1) - own / samples
        mapper, film = self._mapper, self._coarse.pixel_count
        in_pass = min(self._spp, max(1, mapper.most_lanes // film))
        shared = max(
            radius.samples_per_vertex(mapper.light_paths, in_pass)
            for radius in (mapper.radius, mapper.ball) if radius is not None
        )  # fmt: skip
        return own + shared * of_photons

    def _hidden(self) -> np.ndarray:
        """The variance of camera paths, in each pixel, due to light that connections do not find.
        """
        moment, lost = np.mean(self._photons.hidden, axis=(0, 2))
        lost = box_means(lost.reshape(-1, self._coarse.width)).ravel()
        return moment + self._spp * lost**2

    def state(self) -> dict[str, np.ndarray]:
        return {"light_paths": np.array(astuple(self._choice.techniques), float)}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> PhotonChoice:
        is_kept = state.take("light_paths", "f", (3,), 0)[0] > 0
        self._choice = PhotonChoice(PHOTONS if is_kept else NO_PHOTONS)
        return self._choice

    @property
    def effect(self) -> Effect:
        about = {"rival": self.rival.efficiency} if self.variance is not None else {}
        about |= asdict(PHOTONS)
        if self._measured is not None:
            about["measured_variance"] = self._measured
        is_kept = self._choice.techniques == PHOTONS
        return Effect(is_kept, self.variance, self.time, about)

    def __str__(self) -> str:
        kept = "photons pay" if self._choice.techniques == PHOTONS else "photons do not pay"
        if self.variance is None:
            return kept
        measured = "" if self._measured is None else f", {self._measured:.2g} without them"
        return f"{kept} ({self.variance:.2g} of the variance{measured}, {self.time:.1f} x the time)"

    @property
    def _measured(self) -> float | None:
        """The variance of the pilots after the trial, relative to ``path``, if they had no photons.
        """
        if self.check is None or self.check.variance is None:
            return None
        return self.check.variance * self.variance


class _Samples(TechniqueObserver):
    """Remembers samples of a coarse film, and counts what takes time.

    Parameters:
        pixels: Pixels of the film.

    Attributes:
        passes: The values of each pass, [sample, pixel].
        hidden: For each pass, the second moments of camera paths that hit hidden lights, and the
            light that camera paths cannot find, [2, sample, pixel].
        counts: What takes time, in all of them.
    """

    def __init__(self, pixels: int) -> None:
        self._pixels, self.counts = pixels, Counts()
        self.passes: list[np.ndarray] = []
        self.hidden: list[list[np.ndarray]] = []

    def camera(self, rays: CameraRays) -> None:
        lanes = dr.width(rays.pixel)
        self._lane, self._importance = dr.arange(mi.UInt32, lanes), rays.importance
        self._looked = dr.zeros(mi.UInt32, lanes)
        # Second moment of camera paths, and what they do not find
        self._moment, self._lost = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)
        dr.eval(self._lane, self._importance, self._looked, self._moment, self._lost)

    def photon(
        self, value: mi.Spectrum, carried: mi.Spectrum, history: HiddenLight, active: mi.Bool
    ) -> None:
        brought = channel_mean(value * self._importance)
        hit = channel_mean(carried * self._importance) * history.radiance
        is_hidden = active & history.is_hidden & dr.isfinite(brought * hit)
        add_own(self._moment, brought * hit, self._lane, is_hidden)
        add_own(self._lost, brought, self._lane, is_hidden & (history.radiance == 0))

    def searched(self, count: mi.UInt32) -> None:
        add_own(self._looked, count, self._lane)

    def traced(self, camera: Sample, whole: Sample) -> None:
        values = channel_mean(camera.L * self._importance)
        dr.eval(camera, whole, values)
        values, moment, lost, *counts = to_host(
            values, self._moment, self._lost, self._looked, camera.scatter_count,
            camera.shadow_count, whole.scatter_count,
        )  # fmt: skip
        values, moment, lost = (
            x.reshape(-1, self._pixels).astype(np.float64) for x in (values, moment, lost)
        )
        self.passes.append(np.where(np.isfinite(values), values, 0))
        self.hidden.append([moment, lost])
        lanes = values.size
        looked, scattered, tested, all_scattered = (
            int(count.sum(dtype=np.uint64)) for count in counts
        )
        self.counts.add(
            lanes + scattered, tested, lanes + all_scattered - scattered, 0, looked
        )  # fmt: skip


@dataclass
class TrialPasses:
    """The passes of a :class:`PhotonTrial`, with the same camera rays. It is an
    :class:`Estimator`."""

    walk: Walk
    mapper: PhotonMapper
    path: _Samples

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        dr.eval(rays)
        for _ in range(_PHOTON_PASSES):
            self.mapper(scene, sampler, rays, active)
            schedule_state(sampler)
        for _ in range(_PATH_PASSES):
            self.path.camera(rays)
            sample = camera_paths(self.walk, scene, sampler, rays, active)
            schedule_state(sampler)
            self.path.traced(sample, sample)
        return sample


def _ratio(of_photons: np.ndarray, of_path: np.ndarray) -> tuple[float, float]:
    """The variance of photons divided by the variance of camera paths, and the standard error of
    the logarithm of this ratio. Both variances are given for each pixel."""
    less, error = gain_of(trimmed_batches(of_photons, of_path - of_photons))
    return max(1 - less, 1e-6), error
