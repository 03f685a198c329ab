"""Makes a Russian roulette on shadow rays from a light map that another learner fills."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi
import numpy as np

from ...planning.costs import REJECTION
from ...planning.learner import Learner, Pilot
from ...transport.path_decisions import ShadowTest
from ...transport.rejection_law import RejectionLaw
from ...util.stored_arrays import StoredArrays
from .light_map import LightMap
from .shadow_roulette import LightMapRoulette


class LearnsMap(Protocol):
    """A learner of a light map.

    Attributes:
        map: What has been learned so far; ``None`` if there is no map.
    """

    map: LightMap | None

    def keep_map(self) -> None:
        """Keeps the map even where it does not pay for the choice of lights."""


class LightMapRouletteLearner(Learner):
    """Makes a Russian roulette on shadow rays from the light map that another learner fills.

    Parameters:
        lights: The learner of the map, which precedes this learner.
        law: The probability of a test.
    """

    def __init__(self, lights: LearnsMap, law: RejectionLaw) -> None:
        self._lights, self._law = lights, law
        self._summary = ""
        lights.keep_map()

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> None:
        return None

    def learn(self, pilot: Pilot) -> ShadowTest | None:
        if not pilot.is_last or self._lights.map is None:
            return None
        return self._make_roulette()

    def state(self) -> dict[str, np.ndarray]:
        # Everything else is in the light map
        return {} if self._lights.map is None else {"law": np.array(self._law.law)}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> ShadowTest | None:
        return self._make_roulette()

    def _make_roulette(self) -> ShadowTest | None:
        """The roulette from the map; ``None`` if it does not pay."""
        roulette = LightMapRoulette(self._lights.map, self._law)
        pays = roulette.rejected_share >= REJECTION
        verb = "rejects" if pays else "does not reject"
        self._summary = f"{verb} {roulette.rejected_share:.0%} of the shadow rays"
        return roulette if pays else None

    def __str__(self) -> str:
        return self._summary
