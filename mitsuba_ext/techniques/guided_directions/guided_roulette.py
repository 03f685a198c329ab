"""The Russian roulette that path guiding learns, as a learner of its own."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...planning.learner import Learner, Pilot
from ...transport.path_decisions import Roulette
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .decisions import AdjointRoulette
from .learner import GuideLearner


class RouletteLearner(Learner):
    """Takes the roulette from a learner of directions, which precedes this one. Both decisions are
    judged by the same pilots, since guiding pays only if roulette does not end the guided paths.

    Parameters:
        guide: The learner of directions, by regions of surfaces.
        rr_depth: Depth at which roulette begins.
    """

    def __init__(self, guide: GuideLearner, rr_depth: int) -> None:
        self._guide = guide
        guide.learn_roulette(rr_depth)

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Roulette:
        return self._guide.roulette

    def learn(self, pilot: Pilot) -> Roulette:
        return self._guide.roulette

    def state(self) -> dict[str, np.ndarray]:
        roulette = self._guide.roulette
        return roulette.state() if isinstance(roulette, AdjointRoulette) else {}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> Roulette:
        regions = self._guide.guide.regions
        radiance = state.take("radiance", "f", (regions.tree_count,), -1)
        scale = state.take("scale", "f", (self._guide.pixel_count,), 0)
        self._guide.roulette = AdjointRoulette(
            regions, from_numpy(mi.Float, radiance), from_numpy(mi.Float, scale)
        )
        return self._guide.roulette

    def __str__(self) -> str:
        return ""
