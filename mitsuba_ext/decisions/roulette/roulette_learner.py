"""The roulette that path guiding learns, as the decision of its own slot."""

from __future__ import annotations

import mitsuba as mi

from ...transport.path_decisions import Roulette
from ..directions.guide_learner import GuideLearner
from ..learner import Learner


class RouletteLearner(Learner):
    """Takes the roulette from a learner of directions, which comes before this one: both judge the
    same pilots, since guiding pays only as far as roulette does not end the guided paths.

    Parameters:
        guide: The learner of directions, by regions of surfaces.
        rr_depth, film_width: See :meth:`GuideLearner.learn_roulette`.
    """

    def __init__(self, guide: GuideLearner, rr_depth: int, film_width: int) -> None:
        self._guide = guide
        guide.learn_roulette(rr_depth, film_width)

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> None:
        return None

    def learn(self, scene: mi.Scene, is_last: bool) -> Roulette:
        return self._guide.roulette

    def __str__(self) -> str:
        return ""
