"""The parameters of learned lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Slots, Technique
from ...rendering.camera import film_extent
from ...transport.tree_choice import tree_choice
from .learner import LightMapLearner

#: What the map of :class:`LearnedLights` can learn of each light, the default first.
TARGETS = ("contribution", "visibility")


class LearnedLights(Technique):
    """Chooses lights by what the pilots' samples found; without pilots, by a light tree. The
    attributes are the parameters of the plugin ``learned_lights``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "learned_lights", True
    slots = ("next_event",)
    words = {target: {"target": target} for target in reversed(TARGETS)}
    pilot_spp, tries, tells_visibility = 16, True, True

    def __init__(self, read: ParameterReader, target: str = "") -> None:
        self.target = target or read("target", TARGETS[0], choices=TARGETS)
        self.grid = read.optional_count("grid", 1024)
        self.max_memory = read("max_memory", 512.0, minimum=1e-3)

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and bool(scene.emitters()) and bool(scene.shapes())

    def decision(self, setting: Setting) -> Any | None:
        if self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return tree_choice(setting.scene)

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return LightMapLearner(
            self.target,
            self.grid,
            int(self.max_memory * 2**20),
            setting.pilot_samples,
            film_extent(setting.sensor.film()),
            setting.pixel_count * setting.spp,
        )

    def parameters(self, *slots: Slots) -> dict[str, Any]:
        return {**super().parameters(*slots), "grid": self.grid or "automatic"}


TECHNIQUES = (LearnedLights,)
