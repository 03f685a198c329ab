"""A path tracer that remembers what it has learned, for the renders of an optimization.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import functools
import math
import time
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..planning.planner import LearningPlan, Planner
from ..planning.technique import Setting, decisions_of
from ..rendering.request import Request
from ..rendering.stages import OneStage, ReportedSchedule
from ..rendering.statistics import RenderStatistics
from ..scene.mark import SceneMark
from ..scene.movers import movers
from ..startup.registry import variant_bound
from ..transport.decisions import Decisions
from ..transport.heroes import disperses
from ..transport.walk import Walk
from .slots import SLOTS, read_slot
from .staged_integrator import NO_LIMIT
from .walk_integrator import WalkIntegrator

#: The decisions that a scene can replace: those that do not change camera rays.
_SLOTS = ("directions", "next_event", "roulette", "flights", "connections", "mis", "shadow_test")

#: The least time for an image after learning, in seconds.
_LEAST_TIME = 1e-3

#: Decisions whose weights are not radiance / density.
_NOT_DETACHED = {"next_event": ("resampled_lights", "two_stage_lights"), "directions": ("swarm",)}


class _Remembered:
    """What a render has learned. (Neither a tuple nor a dataclass: Dr.Jit does not look for arrays
    in it, as it does in the attributes of a scene's own integrator.)

    Attributes:
        scene: The scene that was rendered.
        decisions: The decisions of the last stage.
        said: ``learned`` and ``effects`` of the statistics.
    """

    def __init__(
        self, scene: SceneMark, decisions: Decisions, said: tuple[str, dict[str, Any]]
    ) -> None:
        self.scene, self.decisions, self.said = scene, decisions, said


@variant_bound
class RememberingPath(WalkIntegrator):
    """The primal renders of :class:`composed_prb`. Before the first render of a scene, it learns
    from samples that are not part of an image; the renders use what it has learned."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        # As in `prb`: from a vertex later than in `path`
        self.rr_depth = min(self.rr_depth + 1, NO_LIMIT)
        self.fill(props, **{slot: read_slot(self.name, props, slot) for slot in _SLOTS})
        for slot, refused in _NOT_DETACHED.items():
            if slot in self.slots and self.slots[slot].name in refused:
                raise ValueError(
                    f'"{self.name}": there are no gradients with the "{self.slots[slot].name}" of '
                    f'the parameter "{slot}": choose another one'
                )
        has = {
            "aovs": self.aovs, "checkpoint": self.checkpoint,
            "keep_learned": self.learned_state.keep,
        }  # fmt: skip
        for key, value in has.items():
            if value:
                raise ValueError(f'"{self.name}" has no parameter "{key}": leave it out')
        self.learn_every = 0
        if self.can_learn:
            self.learn_every = self.parameter(props, "learn_every", 128, minimum=0)
        self._remembered: _Remembered | None = None
        self._renders, self._interval = 0, self.learn_every
        self._learned_from: SceneMark | None = None

    def parameters(self) -> dict[str, Any]:
        words = {slot: next(iter(SLOTS[slot])) for slot in _SLOTS}
        return {**words, **super().parameters()}

    def common_parameters(self) -> dict[str, Any]:
        known = super().common_parameters()
        del known["aovs"]
        return {**known, "rr_depth": self.rr_depth - 1}

    def forget(self) -> None:
        """Learns in the next render, whatever ``learn_every`` is."""
        self._remembered = None

    def remembered(self, scene: mi.Scene, sensor: mi.Sensor) -> Walk:
        """The walk of the last stage of the last render of ``scene``. If there was none, decisions
        that learn fall back to their defaults. ``sensor`` sees the scene; it need not be the
        scene's own."""
        if self._knows(scene):
            return self.walk(self._remembered.decisions)
        setting = Setting(scene, sensor, 0, self.max_depth, self.rr_depth, 1, plugin=self.name)
        return self.walk(decisions_of(self.slots, setting, Decisions(query=self.query(scene))))

    def _knows(self, scene: mi.Scene) -> bool:
        # Decisions that do not learn are made again: what they depend on may have changed
        return self.can_learn and bool(self._remembered) and self._remembered.scene.is_of(scene)

    def refuse_recording(self, what: str) -> None:
        """
        Raises:
            NotImplementedError: A user records a whole step, and ``what`` needs to read arrays.
        """
        if dr.flag(dr.JitFlag.FreezingScope):
            raise NotImplementedError(
                f'"{self.name}": dr.freeze cannot record a step with {what}: do not freeze it '
                f"(this integrator records its own kernels)"
            )

    @property
    def learned(self) -> object:
        """What the renders have learned: another object once they have learned again, ``None`` if
        no decision learns."""
        return self._remembered if self.can_learn else None

    @property
    def is_due(self) -> bool:
        """Whether what it has learned is too old."""
        return self.learns_within(1)

    def learns_within(self, renders: int) -> bool:
        """Whether what it has learned is too old for one of the next ``renders``."""
        return 0 < self._interval < self._renders + renders

    def render_once(self, request):
        if self.can_learn:
            self.refuse_recording("learned decisions")
        if self.can_learn and not self.learned_state.loads(request):
            if self.is_due or not self._knows(request.scene):
                begin = time.perf_counter()
                self.learn(request)
                if request.is_timed:
                    left = request.timeout - (time.perf_counter() - begin)
                    request = replace(request, timeout=max(left, _LEAST_TIME))
        return super().render_once(request)

    def learn(self, request: Request) -> None:
        """Learns, whatever it knows. Samples are at most a quarter of the samples of the renders
        that will use what it learns.

        Parameters:
            request: One of these renders. Learning takes at most half of its time.
        """
        self.forget()
        spp = request.spp or request.sensor.sampler().sample_count()
        is_again = self._learned_from is not None and self._learned_from.is_of(request.scene)
        self._interval = 2 * self._interval if is_again else self.learn_every
        self._learned_from = SceneMark(request.scene)
        # Pilots are three quarters of the samples
        samples = min(4 * self._pilot_spp // 3 + 1, spp * (self._interval or 128) // 4)
        # Not the random numbers of the render that uses what is learned
        seed = int((mi.UInt32(request.seed) + 0x9E3779B9)[0])
        of_pilots = replace(
            request, seed=seed, spp=max(4, samples), timeout=request.timeout / 2, develop=False,
            progress=None, watch=None,
        )  # fmt: skip
        if self.plan_learning(of_pilots, of_pilots.spp).pilots:
            with dr.suspend_grad():
                super().render_once(of_pilots)
        self._renders = 0

    def plan_learning(self, request, spp, kernels=math.inf):
        if self._knows(request.scene):
            return LearningPlan()
        return super().plan_learning(request, 3 * spp, kernels)

    def most_pilot_samples(self, pixel_count, spp):
        # Many renders use what this one learns: pilots have up to three quarters of its samples
        return spp // 4

    def pace_stage(self, request, spp):
        # Its pilots are worth their time in later renders
        return None

    def schedule(self, request, samples, learning):
        self._renders += 1
        if self._knows(request.scene):
            stage = OneStage(self.walk(self._remembered.decisions))
            return ReportedSchedule(stage, self._report_known)
        self._renders = 1
        planner = self.planner(
            request, samples, learning, self.estimators(request, sum(samples), learning)
        )
        return ReportedSchedule(
            planner, functools.partial(self._remember, request.scene, planner)
        )

    def _remember(
        self, scene: mi.Scene, planner: Planner, statistics: RenderStatistics
    ) -> None:
        if not statistics.interrupted:
            said = statistics.learned, statistics.effects
            self._remembered = _Remembered(SceneMark(scene), planner.decisions, said)

    def _report_known(self, statistics: RenderStatistics) -> None:
        statistics.learned, statistics.effects = self._remembered.said

    def query(self, scene):
        if movers(scene):
            raise NotImplementedError(
                f'"{self.name}": there are no gradients of scenes with moving shapes or cameras'
            )
        if mi.is_spectral and disperses(scene.shapes()):
            raise NotImplementedError(
                f'"{self.name}": there are no gradients of scenes with dispersion'
            )
        return super().query(scene)
