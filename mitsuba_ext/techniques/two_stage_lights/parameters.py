"""The parameters of two-stage sampling."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Technique
from ...rendering.camera import film_extent
from .environment_partition import MOST_SPLITS
from .learner import VisibilityLearner
from .two_stage import TwoStage

#: What two-stage sampling can learn about visibility, the default first; and the pilots' samples
#: per pixel for it.
VISIBILITIES = ("unknown", "primary", "world")
_PILOT_SPP = 4


class TwoStageLights(Technique):
    """Samples directions of the environment by the product of BSDF and light. The attributes are
    the parameters of the plugin ``two_stage_lights``; see there."""

    name, is_plugin = "two_stage_lights", True
    slots = ("next_event",)
    words = {"two_stage": {}, "triple_product": {"visibility": "primary"}}
    camera_paths_only = True
    sees_media = False

    def __init__(self, read: ParameterReader, visibility: str = "") -> None:
        self.splits = read("splits", 16, minimum=0, maximum=MOST_SPLITS)
        self.vertices = read("vertices", "first", choices=("first", "all"))
        self.visibility = visibility or read("visibility", "unknown", choices=VISIBILITIES)
        if self.learns:
            self.reallocated = read("reallocated", 0.9, minimum=0.0, maximum=0.99)
        read.refuse_without_effect({"reallocated": 'a "visibility" that is learned'})

    @property
    def learns(self) -> bool:
        """Whether it learns the visibility."""
        return self.visibility != "unknown"

    @property
    def pilot_spp(self) -> int:
        return _PILOT_SPP if self.learns else 0

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return self.learns and spp > 0 and scene.environment() is not None

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return VisibilityLearner(
            self.visibility, self.splits, self.vertices == "all", self.reallocated,
            *film_extent(setting.sensor.film()),
        )  # fmt: skip

    def decision(self, setting: Setting) -> Any | None:
        if setting.scene.environment() is None or setting.max_depth < 2:
            return None
        if self.can_learn(setting.scene, setting.pilot_spp):
            return None  # the learner makes the decisions of all stages
        return TwoStage(setting.scene, self.splits, self.vertices == "all")


TECHNIQUES = (TwoStageLights,)
