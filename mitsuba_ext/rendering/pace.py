"""Plans the pilots of a render with a timeout for as many samples as fit into its time.

A render with a timeout is asked for more samples than it will take. What pilots cost, and what is
worth trying, depends on the number of samples: planned for the number that was asked for, a render
of one second would spend all of it on learning. Therefore, such a render begins with a short stage
that learns nothing, and whose time tells how many samples fit. They are part of the image.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from .plan import Planned, RenderPlan
from .stages import Stage
from .statistics import RenderStatistics
from .time_budget import LEARNING_SHARE, TimeBudget

if TYPE_CHECKING:
    import mitsuba as mi

#: Seconds that learning takes besides its samples and kernels, about, in any scene: trees and
#: tables are made on one core of the CPU. (0.3 to 0.6 s in cornell_box, flint and colour_wheel.)
_FIXED = 0.4


class PacedJob(Protocol):
    """The attributes and methods of a render that :func:`plan_for_timeout` uses."""

    integrator: Planned
    scene: mi.Scene
    sensor: mi.Sensor
    plan: RenderPlan
    budget: TimeBudget
    statistics: RenderStatistics

    def run_pass(self, stage: Stage, spp: int) -> bool:
        """Takes samples, and returns whether kernels were compiled."""


def plan_for_timeout(job: PacedJob) -> RenderPlan:
    """The plan of a render, whose pilots are those of a render of as many samples as the time
    allows. Renders without a timeout or pilots, or whose passes must have the same length, keep
    their plan."""
    plan, budget, integrator = job.plan, job.budget, job.integrator
    if not budget.is_limited or len(plan.stages) == 1 or plan.structured or plan.set_size > 1:
        return plan
    stage = integrator.pace_stage(job.scene, job.sensor, plan.spp)
    if stage is None:
        return plan
    compiling, is_new = 0.0, True
    while is_new:
        begin, before = time.perf_counter(), _tracing(job)
        is_new = job.run_pass(stage, budget.short)
        # Long passes take no longer to trace than this one: their speed is that of the kernel
        tracing = _tracing(job) - before
        seconds = time.perf_counter() - begin - tracing
        compiling += tracing if is_new else 0.0
        if time.perf_counter() >= budget.end:
            break
    taken, left = job.statistics.spp, max(0.0, budget.end - time.perf_counter())
    fits = taken + int(left * budget.short / max(seconds, 1e-6))
    fits = min(plan.spp, max(taken + 1, fits))
    kernels = (LEARNING_SHARE * left - _FIXED) / max(compiling, 1e-6)
    learning = integrator.plan_learning(job.scene, job.sensor, fits - taken, kernels)
    budget.pilot_factor = 1.0
    stages = (*learning.pilots, fits - taken - sum(learning.pilots))
    return replace(plan, stages=stages, learning=learning)


def _tracing(job: PacedJob) -> float:
    """Seconds before kernels could run."""
    return job.statistics.compile_seconds + job.statistics.tracing_seconds
