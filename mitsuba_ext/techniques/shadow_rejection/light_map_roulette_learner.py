"""Makes a Russian roulette on shadow rays from a light map that another learner fills."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...planning.learner import Learner
from ...transport.path_decisions import ShadowTest
from ...util.stored_arrays import StoredArrays
from ..learned_lights.learner import LightMapLearner
from .light_map_roulette import LightMapRoulette
from .rejection_law import WORTHWHILE


class LightMapRouletteLearner(Learner):
    """Makes a Russian roulette on shadow rays from the light map that another learner fills.

    Parameters:
        lights: The learner of the map, which precedes this learner.
        slope, floor, law: See :class:`.LightMapRoulette`.
    """

    def __init__(self, lights: LightMapLearner, slope: float, floor: float, law: str) -> None:
        self._lights, self._law = lights, {"slope": slope, "floor": floor, "law": law}
        self._summary = ""
        lights.keep_map()

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> None:
        return None

    def learn(self, scene: mi.Scene, is_last: bool) -> ShadowTest | None:
        if not is_last or self._lights.map is None:
            return None
        return self._make_roulette()

    def state(self) -> dict[str, np.ndarray]:
        # Everything else is in the light map
        return {} if self._lights.map is None else {"law": np.array(self._law["law"])}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> ShadowTest | None:
        return self._make_roulette()

    def _make_roulette(self) -> ShadowTest | None:
        """The roulette from the map; ``None`` if it does not pay."""
        roulette = LightMapRoulette(self._lights.map, **self._law)
        pays = roulette.rejected_share >= WORTHWHILE
        verb = "rejects" if pays else "does not reject"
        self._summary = f"{verb} {roulette.rejected_share:.0%} of the shadow rays"
        return roulette if pays else None

    def __str__(self) -> str:
        return self._summary
