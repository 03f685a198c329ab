"""The variance of photons in participating media, beside a trial of light paths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ....images.box_filter import box_means
from ....images.coarse_film import CoarseFilm
from ....transport.estimator import CameraRays, Estimator, Sample
from ....transport.numbers import Numbers, schedule_state
from ....transport.vertex import PathState
from ....util.arrays import add_own, channel_mean, to_host
from ..photons.photon_history import HiddenLight, HiddenLightProgram
from ..photons.photon_mapper import PhotonMapper
from .candidates import Candidate
from .path_moments import Counts
from .technique_observer import TechniqueObserver

#: The least number of samples of a render that tries photons, and the passes of photons in its
#: trial.
_LEAST, _PASSES = 1 << 21, 2

#: The squared relative bias of photons after one sample of each pixel; it falls with the root of
#: the number of samples. (After 64, it was 0.012 in volume_caustic, and 0 to 0.001 in four others.)
_SQUARED_BIAS = 0.03

#: The share of the pixels, the brightest ones, that do not tell how much light photons have found:
#: rare samples of other candidates may be in them.
_BRIGHTEST = 0.01

#: The candidate that :class:`PhotonMapper` renders.
PHOTONS = Candidate(1.0, connections=0, merges=True)


@dataclass(frozen=True)
class PhotonEstimate:
    """What the passes of photons have found for each pixel, [pixel] each.

    Attributes:
        mean: Radiance, without the noise of rare samples of other candidates.
        variance: The squared error of one sample of photons: of a render, times its number of
            samples.
        hidden: The least squared error of one sample of all other candidates: the part due to light
            that no connection finds.
        lost: The share of the light that only photons find.
        counts: What takes time, as in as many samples as the other candidates have had.
    """

    mean: np.ndarray
    variance: np.ndarray
    hidden: np.ndarray
    lost: float
    counts: Counts

    def beside(self, errors: list[np.ndarray]) -> list[np.ndarray]:
        """The squared errors of the other candidates, [pixel] each, and of photons."""
        return [*(np.maximum(x, self.hidden) for x in errors), self.variance]


class PhotonSamples(TechniqueObserver):
    """Compares photons with the other candidates of a trial, whose vertices are not merged in
    media. Photons take samples of the same film.

    Photons have two kinds of variance: the samples of a pass share photons, whose noise more
    samples in the pass do not reduce. Several passes, which have photons of their own, tell the two
    kinds apart.

    Some light is hidden from all connections, because no two neighbouring vertices of its paths can
    be connected: it enters smooth glass, scatters once in it, and leaves the glass elsewhere. A
    camera path has to hit the lamp, which it does too rarely for the samples of a trial. But
    photons find this light (:class:`HiddenLight`). Let a photon bring f / p to a pixel, where a
    camera path of density q, which hits the lamp, brings f / q, about the lamp's radiance. The
    second moment of camera paths is the integral of f² / q, which (f / p) (f / q) estimates, as in
    :class:`PathMoments`. Light that no camera path finds is an error of the mean: it counts as the
    variance that makes an error of this size in the whole render.

    Parameters:
        coarse: The film.
        spp: Samples per pixel of the render.

    Attributes:
        has_image: Whether the other candidates connect light paths to the sensor.
    """

    def __init__(self, coarse: CoarseFilm, spp: int) -> None:
        self._coarse, self._spp, self._counts = coarse, spp, Counts()
        self._pixels = coarse.width * coarse.height
        #: The values of each pass, [sample, pixel]; and for each pass, the second moments of camera
        #: paths that hit hidden lights, and the light that they cannot find, [2, sample, pixel]
        self._passes: list[np.ndarray] = []
        self._hidden: list[list[np.ndarray]] = []
        self._mapper: PhotonMapper | None = None
        self.has_image = True

    @staticmethod
    def is_possible(samples: int) -> bool:
        """Whether the passes are worth their time, in a render of ``samples`` samples."""
        return samples >= _LEAST

    def beside(self, estimator: Estimator, mapper: PhotonMapper, has_image: bool) -> WithPhotons:
        """An estimator of the trial: after the samples of ``estimator``, it takes samples of
        photons. ``mapper`` is for the whole film."""
        self._mapper, self.has_image = mapper, has_image
        coarse = mapper.of_coarse_film(self._coarse.pixel_width)
        light_walk = replace(coarse.light_walk, program=HiddenLightProgram())
        return WithPhotons(estimator, replace(coarse, light_walk=light_walk, observer=self))

    # ---- Observer ----

    def camera(self, rays: CameraRays) -> None:
        lanes = dr.width(rays.pixel)
        self._lane, self._importance = dr.arange(mi.UInt32, lanes), rays.importance
        self._looked = dr.zeros(mi.UInt32, lanes)
        # Second moment of camera paths, and what they do not find
        self._moment, self._lost = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)
        dr.eval(self._lane, self._importance, self._looked, self._moment, self._lost)

    def photon(
        self, value: mi.Spectrum, carried: mi.Spectrum, history: HiddenLight, path: PathState,
        active: mi.Bool,
    ) -> None:  # fmt: skip
        brought = channel_mean(value * self._importance)
        hit = channel_mean(carried * self._importance) * history.radiance
        # A connection from the camera path: the photon is at its next vertex
        is_first = path.depth == 0
        is_found = is_first if self.has_image else mi.Bool(False)
        is_found |= ~is_first & ~path.arrival.is_delta
        is_hidden = active & history.is_hidden & ~is_found & dr.isfinite(brought * hit)
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
        self._passes.append(np.where(np.isfinite(values), values, 0))
        self._hidden.append([moment, lost])
        lanes = values.size
        looked, scattered, tested, all_scattered = (
            int(count.sum(dtype=np.uint64)) for count in counts
        )
        self._counts.add(
            lanes + scattered, tested, lanes + all_scattered - scattered, 0, looked
        )  # fmt: skip

    # ---- After the passes ----

    def estimate(self, found: np.ndarray) -> PhotonEstimate:
        """The estimate from all passes. ``found``: the radiance of each pixel that the other
        candidates have found."""
        values = np.array(self._passes)
        passes, samples, _ = values.shape
        own = values.var(axis=1, ddof=1).mean(axis=0)
        of_photons = values.mean(axis=1).var(axis=0, ddof=1) - own / samples
        mean = values.mean(axis=(0, 1))
        # Few photons of a large light may reach what the camera sees. In all passes, less than one
        # photon is expected to bring the light that is missing. (Less than half of it: noise.)
        usual = np.minimum(found, np.quantile(found, 1 - _BRIGHTEST))
        missing = np.maximum(self._smooth(usual) - 2 * self._smooth(mean), 0)
        of_photons = np.maximum(of_photons, passes * missing**2)
        mean = mean + missing
        mapper = self._mapper
        in_pass = min(self._spp, max(1, mapper.most_lanes // self._coarse.pixel_count))
        shared = max(
            radius.samples_per_vertex(mapper.light_paths, in_pass)
            for radius in (mapper.radius, mapper.ball) if radius is not None
        )  # fmt: skip
        bias = _SQUARED_BIAS * np.sqrt(self._spp) * mean**2
        moment, lost = np.mean(self._hidden, axis=(0, 2))
        share = lost.sum() / max(mean.sum(), 1e-30)
        least = moment + self._spp * self._smooth(lost) ** 2
        counts = Counts()
        counts.add(*(x / passes for x in vars(self._counts).values()))
        return PhotonEstimate(mean, own + shared * of_photons + bias, least, share, counts)

    def _smooth(self, values: np.ndarray) -> np.ndarray:
        return box_means(values.reshape(-1, self._coarse.width)).ravel()


@dataclass
class WithPhotons:
    """Takes the samples of one estimator, and then samples of photons with the same camera rays. It
    is an :class:`Estimator`."""

    estimator: Estimator
    mapper: PhotonMapper

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        dr.eval(rays)
        sample = self.estimator(scene, sampler, rays, active)
        for _ in range(_PASSES):
            schedule_state(sampler)
            self.mapper(scene, sampler, rays, active)
        return sample
