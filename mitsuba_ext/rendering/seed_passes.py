"""Rendering with Mitsuba's own integrators so that it can be stopped.

Their ``render()`` takes all samples at once, however long that lasts, and ignores Ctrl-C meanwhile.
Here, it is called for some samples at a time, each time with another seed. A film holds, for each
pixel, the weighted sum of its samples and the sum of their weights: what these renders leave there
adds up to what a single one of all samples would leave, for every reconstruction filter.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..garbage import garbage_left_alone
from ..movers import check_motion_is_seen
from ..nesting import with_nested
from .batches import sample_count
from .camera import film_extent
from .interrupts import deferred_interrupt
from .plan import check_extent
from .render import kernel_cache_misses

#: Samples of a pass, about: one or two seconds on two CPU cores. Their number must not depend on
#: the speed: the same seed gives the same image.
_PASS_SAMPLES = {dr.JitBackend.LLVM: 1 << 20, dr.JitBackend.CUDA: 1 << 24}

#: Samples per pixel and pass, at least. Rays of one pixel stay together, and so are faster than
#: those of different pixels. The samples of a structured sampler are stratified in a pass only:
#: with fewer, more would be lost than a shorter wait for Ctrl-C is worth.
_PASS_SPP, _STRUCTURED_PASS_SPP = 4, 64

#: Where passes of so many samples would be longer than this many lanes (minutes on two CPU cores),
#: they are shorter: batch systems kill 10 to 30 seconds after they ask.
_LONG_PASS, _LARGE_FILM_PASS_SPP = 1 << 25, 16

#: With a time to fill, passes are shorter by this factor: they are what it is filled with.
_TIMED_PASS_DIVISOR = 4

#: The first of the numbers by which passes get their seeds. Batches count from 0.
_STREAM = 1 << 31


def can_render(integrator: mi.Integrator) -> bool:
    """Is it one of Mitsuba's own, with only such in it? Others may learn, which passes would make
    them repeat. In scalar variants, Mitsuba's can be stopped as they are."""
    modules = {type(each).__module__.split(".")[0] for each in with_nested(integrator)}
    return dr.is_jit_v(mi.Float) and modules == {"mitsuba"}


def pass_length(sensor: mi.Sensor, is_timed: bool = False) -> int:
    """The samples per pixel of a pass; ``is_timed`` matters to independent samples only."""
    pixel_count = math.prod(film_extent(sensor.film()))
    limit = _PASS_SAMPLES[dr.backend_v(mi.Float)] // pixel_count
    if not is_independent(sensor):
        is_long = _STRUCTURED_PASS_SPP * pixel_count > _LONG_PASS
        limit = max(limit, _LARGE_FILM_PASS_SPP if is_long else _STRUCTURED_PASS_SPP)
    elif is_timed:
        limit = max(limit // _TIMED_PASS_DIVISOR, 1)
    else:
        limit = max(limit, _PASS_SPP)
    # Mitsuba finds the pixels of other numbers than powers of two by another kernel
    return sample_count(sensor, 1 << (limit.bit_length() - 1))


def is_independent(sensor: mi.Sensor) -> bool:
    """Do its samples depend on no other sample of the pixel?"""
    return sensor.sampler().class_name() == "IndependentSampler"


class SeedPasses:
    """A render with an integrator for which :func:`can_render` is true.

    Parameters:
        integrator, scene, sensor, seed: What to render.

    Attributes:
        passes: Passes whose samples are in the film.
        spp: Samples per pixel of these passes.
        interrupted: Did Ctrl-C or an error end the render before all samples were taken?

    Raises:
        NotImplementedError: Something moves, which such integrators do not see.
        ValueError: The film has more pixels than a wavefront can hold.
    """

    def __init__(
        self, integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int
    ) -> None:
        check_motion_is_seen(integrator, scene)
        check_extent(sensor.film())
        self._integrator, self._scene, self._sensor, self._seed = integrator, scene, sensor, seed
        self._film = sensor.film()
        self._sum: np.ndarray | float = 0.0
        self._has_weights = True
        self.passes = self.spp = 0
        self.interrupted = False

    def run(
        self,
        spp: int,
        seconds: float | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> None:
        """Renders, and leaves the image in the film: also after Ctrl-C, which ends it after a pass,
        and after an exception. A render of one pass is that of ``integrator.render``.

        Args:
            spp: Samples per pixel, which structured samplers may round up.
            seconds: Instead of ``spp``, with independent samples: as many passes as fit. Their
                number follows from the time of the first one that compiles nothing, and not from
                the clock: an image that ends when the clock says so prefers samples that are fast.
            progress: Called after each pass with the fraction done.
        """
        length = pass_length(self._sensor, seconds is not None)
        pass_count = -(-spp // length) if seconds is None else math.inf
        self.interrupted = True  # until all passes are there
        asked = self._sensor.sampler().sample_count()
        try:
            with deferred_interrupt() as interrupt:
                while self.interrupted and not interrupt.is_set():
                    rest = length if seconds is not None else spp - self.spp
                    elapsed, compiled = self._run_pass(min(length, rest))
                    if pass_count == math.inf and not compiled:
                        pass_count = max(self.passes, round(seconds / elapsed))
                    self.interrupted = self.passes < pass_count
                    progress(self.passes / pass_count)
        finally:
            self._sensor.sampler().set_sample_count(asked)  # Mitsuba's integrators change it
            if self.passes > 0:
                self._fill_film()

    def _run_pass(self, spp: int) -> tuple[float, bool]:
        """Adds a pass; how many seconds did it take, and did it compile a kernel?"""
        spp = sample_count(self._sensor, spp)
        begin, misses = time.perf_counter(), kernel_cache_misses()
        seed = self._seed if self.passes == 0 else self._scattered_seed()
        # Developed: "prb" refuses to do without
        with garbage_left_alone():
            self._integrator.render(self._scene, self._sensor, seed, spp)
        contents = np.array(self._film.develop(raw=True), dtype=np.float64)
        elapsed, compiled = time.perf_counter() - begin, kernel_cache_misses() > misses
        # Light tracing leaves an image, and no weights
        self._has_weights = bool(contents[..., self._weight_channel()].any())
        self._sum += contents if self._has_weights else contents * spp
        self.passes += 1
        self.spp += spp
        return elapsed, compiled

    def _fill_film(self) -> None:
        """Hands the sum to the film, which holds the last pass."""
        contents = self._sum if self._has_weights else self._sum / self.spp
        self._film.prepare(self._integrator.aov_names())
        tensor = mi.TensorXf(contents.astype(np.float32))
        self._film.put_block(mi.ImageBlock(tensor, offset=self._film.crop_offset()))

    def _scattered_seed(self) -> int:
        # Far from each other, and none of those that batches have (batch_seeds)
        stream = mi.UInt32(self.passes + _STREAM)
        return mi.sample_tea_32(mi.UInt32(self._seed), stream)[1][0]

    def _weight_channel(self) -> int:
        if mi.has_flag(self._film.flags(), mi.FilmFlags.Special):
            return self._film.base_channels_count()
        return 4 if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else 3
