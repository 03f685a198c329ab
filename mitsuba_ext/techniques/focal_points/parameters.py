"""The parameters of focal points."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Technique
from ...rendering.camera import film_extent
from .learner import FocalLearner


class FocalPoints(Technique):
    name = "focal_points"
    slots = ("scattering",)
    words = {"focal": {}}
    pilot_spp, tries, finds_all_light = 32, True, True

    def __init__(self, read: ParameterReader) -> None:
        self.bounces = 6

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp >= 3 and bool(scene.emitters())

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        bounces = min(self.bounces, setting.max_depth - 1)
        stride = max(1, setting.pilot_samples * bounces * 36 // (256 << 20))
        return FocalLearner(bounces, stride, film_extent(setting.sensor.film()))


TECHNIQUES = (FocalPoints,)
