"""The slot ``roulette``: which paths Russian roulette continues."""

from __future__ import annotations

from collections.abc import Mapping

from ...planning.learner import Learner
from ...planning.technique import Setting, Technique
from .guided_roulette import RouletteLearner
from .learner import GuideLearner


class GuidedRoulette(Technique):
    """Russian roulette by the radiance that a path is expected to add to its pixel, where
    directions are guided by regions of surfaces; elsewhere the roulette of Mitsuba's ``path``."""

    name = "automatic"
    slots, finds_all_light = ("roulette",), True

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        guide = others.get("directions")
        # A guide by tiles of the film learns nothing about the position of a bounce
        if not isinstance(guide, GuideLearner) or not guide.wants_scout:
            return None
        if setting.rr_depth >= setting.max_depth:
            return None
        return RouletteLearner(guide, setting.rr_depth)
