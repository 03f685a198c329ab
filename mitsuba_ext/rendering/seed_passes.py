"""Renders with Mitsuba's own integrators in passes, so that the render can be stopped.

Their ``render()`` takes all samples at once, however long that lasts, and ignores Ctrl-C meanwhile.
Here, each pass calls it for some of the samples, with a seed of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..scene.nesting import with_nested
from ..scene.unseen import check_all_is_seen
from ..startup.garbage import garbage_left_alone
from .batches import sample_count
from .camera import film_extent, film_told
from .film_sums import FilmSums
from .interrupts import deferred_interrupt
from .pace import Pace
from .plan import check_extent, is_independent
from .request import Watch
from .statistics import PassTimer

#: Approximate number of samples of a pass: one or two seconds on two CPU cores. It must not depend
#: on the speed, so that the same seed gives the same image.
_PASS_SAMPLES = {dr.JitBackend.LLVM: 1 << 20, dr.JitBackend.CUDA: 1 << 24}

#: Fewest samples per pixel in a pass, with independent and with structured samplers. Rays of one
#: pixel are more coherent, and faster, than rays of different pixels. Structured samplers stratify
#: the samples of one pass only, so shorter passes would cost efficiency.
_PASS_SPP, _STRUCTURED_PASS_SPP = 4, 64

#: If passes with a structured sampler would have more samples than this (minutes on two CPU cores),
#: they get fewer per pixel, this number: batch systems kill a process 10 to 30 seconds after the
#: first signal.
_LONG_PASS, _LARGE_FILM_PASS_SPP = 1 << 25, 16

#: With a time budget, passes are shorter by this factor, so that a whole number of them comes
#: closer to the time.
_TIMED_PASS_DIVISOR = 4

#: Offset of the stream numbers from which passes derive their seeds. Those of batches start at 0.
_STREAM = 1 << 31


def can_render(integrator: mi.Integrator) -> bool:
    """Whether the variant is a JIT variant, and the integrator and all integrators nested in it are
    Mitsuba's own. Others may learn, and would learn again in each pass. In scalar variants,
    Mitsuba's integrators can be stopped without passes."""
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
    # A power of two: for other counts, Mitsuba computes the pixel of a sample by another kernel
    return sample_count(sensor, 1 << (limit.bit_length() - 1))


def pass_seed(seed: int, index: int) -> int:
    """The seed of pass ``index`` of a render with this seed."""
    if index == 0:
        return seed
    # A hash, and different from the seeds of batches (see batch_seeds)
    stream = mi.UInt32(index + _STREAM)
    return mi.sample_tea_32(mi.UInt32(seed), stream)[1][0]


class SeedPasses:
    """A render with an integrator for which :func:`can_render` is true.

    Parameters:
        integrator, scene, sensor, seed: What to render.

    Attributes:
        passes: Passes whose samples are in the film.
        spp: Samples per pixel of these passes.
        interrupted: Whether Ctrl-C or an error ended the render before all samples were taken.

    Raises:
        NotImplementedError: The scene has moving shapes, which such integrators do not support.
        ValueError: The film has more pixels than a wavefront can hold.
    """

    def __init__(
        self, integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int
    ) -> None:
        check_all_is_seen(integrator, scene)
        check_extent(sensor.film())
        self._integrator, self._scene, self._sensor, self._seed = integrator, scene, sensor, seed
        self._film = sensor.film()
        self._sums = FilmSums()
        self.passes = 0
        self.interrupted = False

    @property
    def spp(self) -> int:
        return self._sums.spp

    def run(
        self,
        spp: int,
        seconds: float | None = None,
        progress: Callable[[float], None] = lambda done: None,
        watch: Watch | None = None,
    ) -> None:
        """Renders, and leaves the image of the finished passes in the film, also after an exception
        and after Ctrl-C, which ends the render after the running pass. With a single pass, the
        image is the one of ``integrator.render``.

        Args:
            spp: Samples per pixel, which structured samplers may round up.
            seconds: Instead of ``spp``, with independent samples: take as many passes as fit. Their
                number is computed from the time of the first pass that compiles nothing. It does
                not depend on the times of later passes: stopping by the clock would be biased
                towards samples that are fast.
            progress: Called after each pass with the fraction done.
            watch: Is shown the unfinished image; ``None`` if nobody watches.
        """
        length = pass_length(self._sensor, seconds is not None)
        pass_count = -(-spp // length) if seconds is None else math.inf
        pace = Pace()  # of passes, not of samples
        self.interrupted = True  # until all passes are finished
        asked = self._sensor.sampler().sample_count()
        try:
            with deferred_interrupt() as interrupt, film_told(self._sensor):
                while self.interrupted and not interrupt.is_set():
                    rest = length if seconds is not None else spp - self.spp
                    elapsed, compiled = self._run_pass(min(length, rest))
                    if pass_count == math.inf and not compiled:
                        pace.measure(1, elapsed)
                        pass_count = max(self.passes, round(pace.fits(seconds)))
                    self.interrupted = self.passes < pass_count
                    if watch is not None and watch.is_due():
                        self._fill()
                        watch.show(self._film, self.spp, None)
                    progress(self.passes / pass_count)
        finally:
            self._sensor.sampler().set_sample_count(asked)  # Mitsuba's integrators change it
            if self.passes > 0:
                self._fill()

    def _fill(self) -> None:
        self._sums.fill(self._film, self._integrator.aov_names())

    def _run_pass(self, spp: int) -> tuple[float, bool]:
        """Adds a pass; returns its seconds, and whether it compiled a kernel."""
        spp = sample_count(self._sensor, spp)
        timer = PassTimer()
        seed = pass_seed(self._seed, self.passes)
        # render() develops the film, because "prb" refuses develop=False
        with garbage_left_alone():
            self._integrator.render(self._scene, self._sensor, seed, spp)
        self._sums.add(self._film, spp)
        elapsed, is_new = timer.seconds, timer.has_new_kernels
        self.passes += 1
        return elapsed, is_new
