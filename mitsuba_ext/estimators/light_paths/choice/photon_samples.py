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
from ....util.arrays import add_own, channel_mean, to_host
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
PHOTONS = Candidate(1.0, connections=0, merges=True, alone=True)


@dataclass(frozen=True)
class PhotonEstimate:
    """What the passes of photons have found for each pixel, [pixel] each.

    Attributes:
        mean: Radiance, without the noise of rare samples of other candidates.
        variance: The squared error of one sample of photons: of a render, times its number of
            samples.
        counts: What takes time, as in as many samples as the other candidates have had.
    """

    mean: np.ndarray
    variance: np.ndarray
    counts: Counts


class PhotonSamples(TechniqueObserver):
    """Compares photons with the other candidates of a trial. Photons take samples of the same film.

    Photons have two kinds of variance: the samples of a pass share photons, whose noise more
    samples in the pass do not reduce. Several passes, which have photons of their own, tell the two
    kinds apart.

    Parameters:
        coarse: The film.
        spp: Samples per pixel of the render.
    """

    def __init__(self, coarse: CoarseFilm, spp: int) -> None:
        self._coarse, self._spp, self._counts = coarse, spp, Counts()
        self._pixels = coarse.width * coarse.height
        #: The values of each pass, [sample, pixel]
        self._passes: list[np.ndarray] = []
        self._mapper: PhotonMapper | None = None

    @staticmethod
    def is_possible(samples: int) -> bool:
        """Whether the passes are worth their time, in a render of ``samples`` samples."""
        return samples >= _LEAST

    def beside(self, estimator: Estimator, mapper: PhotonMapper) -> WithPhotons:
        """An estimator of the trial: after the samples of ``estimator``, it takes samples of
        photons. ``mapper`` is for the whole film."""
        self._mapper = mapper
        coarse = mapper.of_coarse_film(self._coarse.pixel_width)
        return WithPhotons(estimator, replace(coarse, observer=self))

    # ---- Observer ----

    def camera(self, rays: CameraRays) -> None:
        lanes = dr.width(rays.pixel)
        self._lane, self._importance = dr.arange(mi.UInt32, lanes), rays.importance
        self._looked = dr.zeros(mi.UInt32, lanes)
        dr.eval(self._lane, self._importance, self._looked)

    def searched(self, count: mi.UInt32) -> None:
        add_own(self._looked, count, self._lane)

    def traced(self, camera: Sample, whole: Sample) -> None:
        values = channel_mean(camera.L * self._importance)
        dr.eval(camera, whole, values)
        values, *counts = to_host(
            values, self._looked, camera.scatter_count, camera.shadow_count, whole.scatter_count
        )
        values = values.reshape(-1, self._pixels).astype(np.float64)
        self._passes.append(np.where(np.isfinite(values), values, 0))
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
        counts = Counts()
        counts.add(*(x / passes for x in vars(self._counts).values()))
        return PhotonEstimate(mean, own + shared * of_photons + bias, counts)

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
