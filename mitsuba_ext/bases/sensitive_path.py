"""A path tracer that learns for the gradients of some of a scene's lights.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi

from ..planning.planner import Estimators, LearningPlan
from ..rendering.request import Request
from ..scene.gradients import Optimized
from ..scene.mark import SceneMark
from ..startup.registry import variant_bound
from ..transport.decisions import Decisions
from ..transport.estimator import Estimator
from ..transport.observer import Observer
from ..transport.sensitivity import Sensitivity
from .remembering_path import RememberingPath


@variant_bound
class SensitivePath(RememberingPath):
    """Learns from paths that are weighted by how many optimized things they meet
    (:class:`Sensitivity`): which light, and which direction, is best for the gradients.

    It learns only where some of the lights are optimized, but not all. Otherwise that is about what
    is best for the image (docs/results/gradients.md).
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.learned_state.save = ""
        self._requested: tuple[SceneMark, frozenset[str]] | None = None
        self._optimized: Optimized | None = None

    def prepare(
        self, scene: mi.Scene, keys: frozenset[str], sensor: mi.Sensor, seed: Any, spp: int
    ) -> bool:
        """Learns, if it is time. Returns whether it knows more than what is best for the image.

        Parameters:
            keys: The names of the parameters that have gradients.
            scene, sensor, seed, spp: Those of a pass for gradients.
        """
        if not self.can_learn or self.learned_state.load:
            return False
        is_known = self._has_requested(scene, keys) and not self.is_due
        self._renders += 1
        if not is_known:
            self.forget()
            self._requested, self._optimized = (SceneMark(scene), keys), Optimized(scene)
            if self._optimized.lights_differ:
                seed = int(mi.UInt32(seed)[0])
                self.learn(Request(scene, sensor, seed, spp, timeout=self.timeout))
            self._renders = 1
        return self._knows(scene)

    def _has_requested(self, scene: mi.Scene, keys: frozenset[str]) -> bool:
        if self._requested is None:
            return False
        mark, known = self._requested
        return known == keys and mark.is_of(scene)

    def estimators(self, request: Request, spp: int, learning: LearningPlan) -> Estimators:
        def sensitive(decisions: Decisions, observer: Observer | None = None) -> Estimator:
            walk = self.walk(decisions, observer)
            return replace(walk, program=Sensitivity(self._optimized))

        return sensitive
