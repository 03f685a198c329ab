"""Computes how many samples fit into the time of a render.

The number of samples of a stage is computed from the times of its first passes, before the others
are rendered. The clock never ends a stage: stopping by the clock would be biased towards samples
that are fast. Each stage begins with a short pass that measures the speed; it is repeated until one
compiles nothing.

A render with a timeout is asked for more samples than it will take. What pilots cost, and what is
worth trying, depends on the number of samples: planned for the number that was asked for, a render
of one second would spend all of it on learning. Therefore, such a render begins with a short stage
that learns nothing, and whose time tells how many samples fit. They are part of the image.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Protocol

from .plan import RenderPlan
from .request import Request
from .staged import Staged
from .stages import Stage
from .statistics import RenderStatistics

#: Approximate number of samples of a short pass; fewer would take as long.
_SHORT_PASS = 1 << 16

#: Largest share of all samples for pilot passes. Their samples have the most variance, and learning
#: from them takes additional time.
_PILOT_SHARE = 0.25

#: Fraction of the time left that the second pass of the last stage takes. It measures the speed
#: more precisely than the short pass.
_SECOND_SHARE = 0.25

#: Largest share of the time that is left for pilots, for compiling their kernels, and for learning
#: from them.
_LEARNING_SHARE = 1 / 3

#: Seconds that learning takes besides its samples and kernels, about, in any scene: trees and
#: tables are made on one core of the CPU. (0.3 to 0.6 s in cornell_box, flint and colour_wheel.)
_FIXED = 0.4

#: The clock may measure 0 seconds, which must not divide.
_LEAST_SECONDS = 1e-6


class Pace:
    """The speed of a render, from its last pass that compiled nothing.

    Attributes:
        seconds: The time of one sample per pixel (or of what else is counted); 0 until it is known.
    """

    seconds = 0.0

    def measure(self, samples: float, seconds: float) -> None:
        """Records that ``samples`` samples per pixel took ``seconds``, and compiled nothing."""
        self.seconds = max(seconds, _LEAST_SECONDS) / samples

    def fits(self, left: float) -> float:
        """How many samples per pixel fit into ``left`` seconds."""
        return max(0.0, left) / self.seconds


class TimeLimit(Pace):
    """The time of one render.

    Parameters:
        timeout: Seconds; 0 or less for no limit.
        start: Start of the render, by ``time.perf_counter``.
        pixel_count: Number of pixels of the film.
        pilot_spp: Samples per pixel of all pilot passes without a limit.

    Attributes:
        is_limited: Whether there is a limit.
        short: Samples per pixel of a short pass.
        pilot_factor: Fraction of the pilots' samples that are taken; ``None`` until the speed is
            known.
    """

    def __init__(self, timeout: float, start: float, pixel_count: int, pilot_spp: int = 0) -> None:
        self.is_limited = timeout > 0
        self._end = start + timeout
        self._learning_end = start + _LEARNING_SHARE * timeout
        self.short = max(1, _SHORT_PASS // pixel_count)
        self.pilot_spp = pilot_spp
        self.pilot_factor: float | None = None

    @property
    def left(self) -> float:
        """The seconds that are left."""
        return max(0.0, self._end - time.perf_counter())

    def ends_learning(self, samples: int) -> bool:
        """Whether learning has taken its share of the time, or would with another pilot of
        ``samples`` samples per pixel."""
        expected = time.perf_counter() + samples * self.seconds
        return self.is_limited and expected > self._learning_end


class StageSamples:
    """The samples of a stage, as far as they are known.

    Parameters:
        limit: The time of the render.
        wanted: Samples per pixel of the stage without a limit.
        before: Samples per pixel of the stages before. The last stage does not need it.
        is_last: Whether it is the last stage. The others are pilots.

    Attributes:
        samples: Samples per pixel to take.
        longest: Largest number of samples per pixel in the next pass.
        is_open: Whether the number of samples can still change.
    """

    def __init__(
        self, limit: TimeLimit, wanted: int, before: int = 0, is_last: bool = True
    ) -> None:
        self._limit, self._wanted, self._before, self._is_last = limit, wanted, before, is_last
        self._measured, self.is_open = 0, limit.is_limited
        self.samples, self.longest = wanted, limit.short if self.is_open else wanted
        if self.is_open and not is_last and limit.pilot_factor is not None:
            self._close_pilot(limit.pilot_factor)

    def passed(self, spp: int, done: int, seconds: float) -> None:
        """Records that a pass of ``spp`` samples per pixel, which compiled nothing, took
        ``seconds``; the stage has taken ``done`` samples per pixel so far."""
        self._limit.measure(spp, seconds)
        if not self.is_open:
            return
        fits = self._limit.fits(self._limit.left)
        if not self._is_last:
            # The speed of the first pass decides the fraction of all pilots
            most = _PILOT_SHARE * (self._before + done + fits)
            self._limit.pilot_factor = min(1.0, most / self._limit.pilot_spp)
            self._close_pilot(self._limit.pilot_factor)
            return
        # A short pass, a pass of a quarter of the time left, and the rest
        self.samples = min(self._wanted, done + round(fits))
        self._measured += 1
        self.is_open = self._measured < 2 and round(fits) > 0
        self.longest = max(1, int(_SECOND_SHARE * round(fits))) if self.is_open else self._wanted

    def _close_pilot(self, factor: float) -> None:
        self.is_open = False
        self.samples = self.longest = max(1, int(factor * self._wanted))


class PacedJob(Protocol):
    """The attributes and methods of a render that :func:`plan_for_timeout` uses."""

    integrator: Staged
    request: Request
    plan: RenderPlan
    limit: TimeLimit
    statistics: RenderStatistics

    def run_pass(self, stage: Stage, spp: int) -> bool:
        """Takes samples, and returns whether kernels were compiled."""


def plan_for_timeout(job: PacedJob) -> RenderPlan:
    """The plan of a render with the pilots of a render of as many samples as the time
    allows. Renders without a timeout or pilots, of fewer samples than a short pass, or whose passes
    must have the same length, keep their plan."""
    plan, limit, integrator = job.plan, job.limit, job.integrator
    if not limit.is_limited or len(plan.stages) == 1 or plan.structured or plan.set_size > 1:
        return plan
    stage = integrator.pace_stage(job.request, plan.spp) if limit.short < plan.spp else None
    if stage is None:
        return plan
    compiling, is_new = 0.0, True
    while is_new and job.statistics.spp + limit.short < plan.spp:
        begin, before = time.perf_counter(), _tracing(job)
        is_new = job.run_pass(stage, limit.short)
        # Long passes take no longer to trace than this one: their speed is the speed of the kernel
        tracing = _tracing(job) - before
        limit.measure(limit.short, time.perf_counter() - begin - tracing)
        compiling += tracing if is_new else 0.0
        if limit.left == 0:
            break
    taken, left = job.statistics.spp, limit.left
    fits = min(plan.spp, taken + max(1, int(limit.fits(left))))
    kernels = (_LEARNING_SHARE * left - _FIXED) / max(compiling, _LEAST_SECONDS)
    learning = integrator.plan_learning(job.request, fits - taken, kernels)
    limit.pilot_factor = 1.0
    stages = (*learning.pilots, fits - taken - sum(learning.pilots))
    return replace(plan, stages=stages, learning=learning)


def _tracing(job: PacedJob) -> float:
    """Seconds before kernels could run."""
    return job.statistics.compile_seconds + job.statistics.tracing_seconds
