"""Takes the samples of a render again, and records the paths of a few pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..rendering.camera import film_extent, first_pixel
from ..rendering.render import Job
from ..rendering.request import Request
from ..rendering.staged import Staged
from ..rendering.stages import Stage
from ..transport.estimator import CameraRays, Estimator, Sample, Splats
from ..transport.observer import Observers
from ..transport.walk import Walk
from ..util.spectra import to_rgb
from .path_log import PathLog, Rows
from .paths import brightest_first


@dataclass(frozen=True)
class Recorded:
    """A sample that was recorded.

    Attributes:
        sample: The number of the sample in its pixel; ``None`` for a light path that reaches the
            sensor.
        stage: The stage that took it.
        rgb: Its radiance, times :attr:`weight`.
        weight: Its weight in the film; 0 for a light path.
        wavelengths: Its wavelengths.
        rows: The rows of its path.
    """

    sample: int | None
    stage: int
    rgb: np.ndarray
    weight: float
    wavelengths: np.ndarray
    rows: Rows | None


@dataclass
class PixelRecord:
    """What a render tells of one pixel.

    Attributes:
        index: The pixel, row by row in the film's extent.
        contributions: Radiance times weight of its samples, one array for each pass.
        splats: Radiance of the light paths that reach the sensor, one array for each pass; their
            sum over the number of samples is what they add to the pixel.
        weights: The sum of the weights of the samples.
        brightest: The brightest samples, the brightest first.
    """

    index: int
    contributions: list[np.ndarray] = field(default_factory=list)
    splats: list[np.ndarray] = field(default_factory=list)
    weights: float = 0.0
    brightest: list[Recorded] = field(default_factory=list)

    def keep(self, recorded: Sequence[Recorded], most: int) -> None:
        """Keeps the ``most`` brightest samples of those known and of ``recorded``."""
        self.brightest += recorded
        order = brightest_first(np.array([one.rgb for one in self.brightest]).reshape(-1, 3))
        self.brightest = [self.brightest[index] for index in order[:most]]


class ReplayJob(Job):
    """Takes the samples of the render that ``integrator`` makes for ``request``.

    A stage whose paths do not depend on each other is traced for the chosen pixels only: the
    sampler is seeded as for the whole pass, so that its lanes draw the same numbers. Where learners
    watch, or light paths are shared, all samples are taken.

    Parameters:
        pixels: The chosen pixels, row by row in the film's extent.
        top: The number of samples that are kept for each of them.
        capacities: See :class:`PathLog`.

    Attributes:
        records: What was recorded, one for each pixel.
        needed: The capacities that the passes need.
    """

    freezes_passes = False

    def __init__(
        self, integrator: Staged, request: Request, pixels: Sequence[int], top: int,
        capacities: Sequence[int],
    ) -> None:  # fmt: skip
        super().__init__(integrator, request)
        self._log, self._top, self.needed = PathLog(capacities), top, list(capacities)
        self.records = [PixelRecord(pixel) for pixel in pixels]
        self._pixels = [dr.opaque(mi.UInt32, pixel) for pixel in pixels]
        self._stage, self._stage_index, self._left_out = None, -1, 0

    def _sample(
        self, stage: Stage, sampler: mi.Sampler, rays: CameraRays, count: mi.Float | float = 1.0
    ) -> Sample:
        self._begin_stage(stage)
        chosen = mi.Bool(False)
        for pixel in self._pixels:
            chosen |= rays.pixel == pixel
        is_alone = isinstance(stage.estimator, Walk) and not (stage.observer or stage.images)
        lanes = dr.compress(chosen)
        if is_alone and len(lanes) == 0:
            return Sample(mi.Spectrum(0), mi.Bool(False))
        self._log.choose(chosen, rays)
        estimator = observed(stage.estimator, self._log)
        if is_alone:
            sample = estimator(self.scene, sampler, rays, chosen)
        else:
            sample = super()._sample(replace(stage, estimator=estimator), sampler, rays, count)
        self._record(sample, rays, chosen, lanes, stage.weight)
        return sample

    def fill_film(self) -> None:
        """Leaves the film empty: most of its pixels have no samples."""

    def _begin_stage(self, stage: Stage) -> None:
        if stage is not self._stage:
            self._stage, self._stage_index = stage, self._stage_index + 1
        if self._left_out != self.forgotten:
            self._left_out = self.forgotten
            for index, record in enumerate(self.records):
                self.records[index] = PixelRecord(record.index)

    def _record(
        self, sample: Sample, rays: CameraRays, chosen: mi.Bool, lanes: mi.UInt32, weight: float
    ) -> None:
        # Only the chosen lanes are written to memory: there may be hundreds of millions of others
        place, wavelengths = dr.prefix_sum(dr.select(chosen, mi.UInt32(1), 0)), rays.ray.wavelengths
        rgb, nm = dr.zeros(mi.Color3f, len(lanes)), dr.zeros(type(wavelengths), len(lanes))
        value = to_rgb(sample.L * rays.importance * rays.weight, wavelengths)
        dr.scatter(rgb, mi.Color3f(value), place, chosen)
        if mi.is_spectral:
            dr.scatter(nm, wavelengths, place, chosen)
        dr.eval(rgb, nm, self.block.tensor(), self.tally, self._log.arrays)
        self.needed = [max(pair) for pair in zip(self.needed, self._log.needed)]
        rows = self._log.rows()
        pixel = dr.gather(mi.UInt32, rays.pixel, lanes).numpy()
        values = weight * rgb.numpy().T.astype(np.float64)
        nm = nm.numpy().T.astype(np.float64) if mi.is_spectral else np.zeros((len(lanes), 0))
        lanes = lanes.numpy()
        for record in self.records:
            (own,) = np.nonzero(pixel == record.index)
            record.contributions.append(values[own])
            record.weights += weight * len(own)
            # The samples of a pixel are in neighbouring lanes, in the order of their numbers
            record.keep([
                Recorded(
                    self.statistics.spp + int(n), self._stage_index, values[own[n]], weight,
                    nm[own[n]], rows.of_lane(lanes[own[n]]),
                )
                for n in brightest_first(values[own])[: self._top]
            ], self._top)  # fmt: skip
        for splats in sample.splats:
            self._record_splats(splats, weight)

    def _record_splats(self, splats: Splats, weight: float) -> None:
        width, _height = film_extent(self.film)
        column = mi.Int32(dr.floor(splats.position.x)) - first_pixel(self.film)[0]
        row = mi.Int32(dr.floor(splats.position.y)) - first_pixel(self.film)[1]
        inside = splats.active & (column >= 0) & (column < width) & (row >= 0)
        pixel = mi.UInt32(row * width + column)
        for record, wanted in zip(self.records, self._pixels):
            found = dr.compress(inside & (pixel == wanted))
            if len(found) == 0:
                continue
            value = dr.gather(type(splats.value), splats.value, found)
            nm = splats.wavelengths
            if mi.is_spectral:
                nm = dr.gather(type(nm), nm, found)
            values = mi.Color3f(to_rgb(value, nm)).numpy().T.astype(np.float64)
            nm = nm.numpy().T if mi.is_spectral else np.zeros((len(values), 0))
            record.splats.append(weight * values)
            record.keep([
                Recorded(None, self._stage_index, values[n], 0.0, nm[n], None)
                for n in brightest_first(values)[: self._top]
            ], self._top)  # fmt: skip


def observed(estimator: Estimator, log: PathLog) -> Estimator:
    """The estimator, which tells the log of its camera paths, and of the light paths with which it
    connects and merges them. Light that it does not tell of is no error: the radiance of samples
    is known."""
    if isinstance(estimator, Walk):
        return replace(estimator, observer=Observers([estimator.observer, log]))
    if not is_dataclass(estimator):
        return estimator
    if getattr(estimator, "observer", log) is None:
        found: dict[str, Any] = {"observer": log}
        if not hasattr(estimator, "light_walk"):
            return replace(estimator, **found)
    else:
        found = {}
    for name in ("walk", "directly"):
        if isinstance(walk := getattr(estimator, name, None), Walk):
            found[name] = observed(walk, log)
    return replace(estimator, **found)
