"""Adaptive sampling: a render that takes more samples of pixels with large errors."""

from __future__ import annotations

import threading
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..util.arrays import channel_mean
from ..util.discrete_sampling import first_above
from . import camera
from .pixel_moments import PixelMoments
from .render import Job
from .request import Request
from .sample_allocation import SampleAllocation
from .stages import Stage
from .statistics import PassTimer
from .turns import tell

#: By default, each pass takes all samples divided by this number.
_PASS_SHARE = 8

#: Number of sets of a stratified sampler in the first pass: their spread gives the variance.
_SETS = 4


class AdaptiveJob(Job):
    """One render of :class:`~mitsuba_ext.integrators.adaptive`, whose attributes ``threshold``,
    ``pass_spp`` and ``counts_samples`` it reads.

    The pilots of the nested integrator and the first pass take the same number of samples of every
    pixel. For later passes, :class:`SampleAllocation` computes the number of each pixel.
    """

    divides_stages = False  # moments are computed from whole passes

    def __init__(self, integrator, request: Request) -> None:
        if request.sensor.sampler().class_name() == "StratifiedSampler":
            raise NotImplementedError(
                f'"{integrator.name}": in sets of a few samples, the numbers of the sampler '
                f'"stratified" depend on each other, and the image would be biased: use '
                f'"multijitter" or "independent".'
            )
        super().__init__(integrator, request)
        spp, pilot_spp = self.plan.spp, sum(self.plan.stages[:-1])
        self._pass_spp = min(integrator.pass_spp or -(-spp // _PASS_SHARE), spp)
        self._set_size = 1
        if hasattr(self.sampler, "set_film"):
            # The spread of a pixel's sets gives the variance only if they are independent
            self.sampler.set_film(0)
        if self.plan.structured:
            # Each pass has its own sets and its own sampler
            self.sampler.set_sample_count(max(1, self._pass_spp // _SETS))
            self._set_size = self.sampler.sample_count()
            self.sampler.set_samples_per_wavefront(self._set_size)
            self.plan = replace(self.plan, structured=False)
        first = max(pilot_spp, self._pass_spp)
        self._rest_of_first = first - pilot_spp
        self._pixels = camera.film_extent(self.film)
        self.moments = PixelMoments(*self._pixels, self._set_size)
        self.allocation = SampleAllocation(
            self.moments, spp, first, integrator.threshold, self._set_size
        )
        self.limit.pilot_spp = first
        most = min(self.plan.limit * self.plan.pixel_count, self.plan.most_lanes)
        self._most_sets = max(1, most // self._set_size)

    def _run_stage(
        self, stage: Stage, samples: int, is_last: bool, interrupt: threading.Event
    ) -> None:
        if not is_last:
            super()._run_stage(stage, samples, False, interrupt)
            return
        if self._rest_of_first > 0:
            super()._run_stage(stage, self._rest_of_first, False, interrupt)
        total = self.plan.spp * self.plan.pixel_count
        while self.allocation.has_active and not self._stopped(interrupt):
            left = total - self.moments.total
            if left <= 0:
                break
            budget = left if (fits := self._samples_that_fit()) is None else min(left, fits)
            passes = max(1, round(budget / (self._pass_spp * self.plan.pixel_count)))
            sets, weight = self.allocation.next(budget / passes, passes == 1, 1 / passes)
            self._run_sets(stage, sets, weight)
            self._show()
            if self.request.progress is not None:
                is_done = passes == 1 or not self.allocation.has_active
                done = self.moments.total
                tell(self.request.progress, 1.0 if is_done else done / (done + left))
        self.statistics.interrupted = self._stopped(interrupt) and self.allocation.has_active

    def _samples_that_fit(self) -> float | None:
        """The number of samples that fit into the time left; ``None`` if there is no limit, or the
        speed is not known yet."""
        if not self.limit.is_limited or self.limit.seconds == 0:
            return None
        return max(1.0, self.limit.fits(self.limit.left) * self.plan.pixel_count)

    def run_pass(self, stage: Stage, spp: int) -> bool:
        """Renders ``spp`` samples of every pixel."""
        return self._run_sets(stage, *self.allocation.first(spp))

    def _run_sets(self, stage: Stage, sets: mi.UInt32, weight: mi.Float) -> bool:
        """Renders ``sets`` sets of each pixel into the block. Returns True if it compiled a
        kernel."""
        timer = PassTimer()
        ends = dr.cumsum(sets)
        dr.eval(ends)
        count = int(ends[len(ends) - 1])
        for start in range(0, count, self._most_sets):
            number = dr.arange(mi.UInt32, min(self._most_sets, count - start))
            pixels = _pixels(ends, number + dr.opaque(mi.UInt32, start))
            self._run_part_of_sets(stage, pixels, weight)
        seconds, compiled = timer.seconds, timer.has_new_kernels
        if timer.has_compiled:
            self.statistics.compile_seconds += seconds
        if not compiled and count:
            self.limit.measure(count * self._set_size / self.plan.pixel_count, seconds)
        self.statistics.spp = round(self.moments.total / self.plan.pixel_count)
        return compiled

    def _run_part_of_sets(self, stage: Stage, pixels: mi.UInt32, weight: mi.Float) -> None:
        size = len(pixels) * self._set_size
        sampler = self.sampler.clone()
        seed = self.request.seed
        if self.statistics.passes > 0:
            seed = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(self.statistics.passes))[0][0]
        sampler.seed(dr.opaque(mi.UInt32, seed), size)
        lane = dr.arange(mi.UInt32, size)
        in_set = lane // dr.opaque(mi.UInt32, self._set_size)
        pixel = dr.gather(mi.UInt32, pixels, in_set)
        lanes = camera.lanes_at(self.film, pixel, dr.zeros(mi.UInt32, size))
        rays = self._rays(stage, sampler, lanes)
        sample = self._sample(stage, sampler, rays, dr.gather(mi.Float, weight, pixel))
        brightness = channel_mean(sample.L * (rays.importance * rays.weight))
        brightness += dr.zeros(mi.Float, size)  # of one lane where all samples are equal
        self._evaluate(brightness)
        dr.sync_thread()
        self.moments.add(pixels, brightness)
        self.statistics.passes += 1
        self.statistics.rays["camera"] += size

    def fill_film(self) -> None:
        if self.integrator.counts_samples:
            self._put_counts()
        super().fill_film()

    def _put_counts(self) -> None:
        """Writes the sample counts to the last channel of the block, times the weights by which the
        film divides."""
        width, height = self._pixels
        tensor = self.block.tensor()
        rows, columns, channels = tensor.shape
        index = dr.arange(mi.UInt32, rows * columns)
        y, x = index // columns + (height - rows) // 2, index % columns + (width - columns) // 2
        count = mi.Float(dr.gather(mi.UInt32, self.moments.count, y * width + x))
        weights = 4 if mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha) else 3
        values = mi.Float(tensor.array)
        count *= dr.gather(mi.Float, values, index * channels + weights)
        dr.scatter(values, count, index * channels + (channels - 1))
        offset = self.block.offset()
        self.block = mi.ImageBlock(mi.TensorXf(values, tensor.shape), offset=offset)


def _pixels(ends: mi.UInt32, number: mi.UInt32) -> mi.UInt32:
    """The pixel of each set: the sets of pixel i end before number ``ends[i]``."""
    last = dr.opaque(mi.UInt32, len(ends))
    longest = 1 << 8 * -(-len(ends).bit_length() // 8)  # few different numbers of steps
    pixels = first_above(ends, mi.UInt32(0), last, number, mi.Bool(True), longest)
    dr.eval(pixels)
    return pixels
