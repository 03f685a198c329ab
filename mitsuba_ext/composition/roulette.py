"""The slot ``roulette``: which paths go on."""

from __future__ import annotations

from collections.abc import Mapping

from ..learning.directions.guide_learner import GuideLearner
from ..learning.directions.guided_roulette import RouletteLearner
from ..learning.learner import Learner
from .decision_parameters import DecisionParameters, Setting


class GuidedRoulette(DecisionParameters):
    """Roulette by what a path is expected to bring, where directions are guided by regions of
    surfaces; elsewhere that of Mitsuba's ``path``."""

    name = "automatic"
    slots = ("roulette",)

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        guide = others.get("directions")
        # Tiles know nothing of where a bounce is
        if not isinstance(guide, GuideLearner) or not guide.wants_scout:
            return None
        if setting.rr_depth >= setting.max_depth:
            return None
        return RouletteLearner(guide, setting.rr_depth)
