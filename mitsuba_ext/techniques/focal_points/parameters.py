"""The parameters of focal points."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Technique
from ...rendering.camera import film_extent
from .learner import FocalLearner

#: The fewest pilot samples that a region should have.
_REGION_SAMPLES = 64

#: The bounces of a path that are recorded.
_BOUNCES = 6


class FocalPoints(Technique):
    """Mixes directions to focal points with BSDF samples. The attributes are the parameters of the
    plugin ``focal_points``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name = "focal_points"
    slots, words, is_plugin = ("scattering",), {"focal": {}}, True
    pilot_spp, tries, finds_all_light = 32, True, True

    def __init__(self, read: ParameterReader) -> None:
        self.boxes = read("boxes", 32, minimum=1, maximum=256)
        self.always_use = read("always_use", False)

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        # Boxes are found in the first pilot and tried in the second; the third one draws from
        # better ones
        return spp >= 3 and bool(scene.emitters())

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        width, height = film_extent(setting.sensor.film())
        samples = setting.pilot_samples
        # The scout has one path in each pixel
        least = max(1.0, _REGION_SAMPLES * width * height / samples)
        bounces = min(_BOUNCES, setting.max_depth - 1)
        rival = others.get("directions")
        if self.always_use or rival is None or not rival.can_be_replaced:
            rival = None
        return FocalLearner(
            self.boxes, bounces, least, samples, (width, height), rival, self.always_use
        )


TECHNIQUES = (FocalPoints,)
