"""Russian roulette on the shadow ray, by what a light map says of the chosen cell."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.path_decisions import ShadowTest
from ..learner import Learner
from ..next_event.light_map import LightMap
from ..next_event.light_map_learner import LightMapLearner
from .rejection_law import WORTHWHILE, RejectionLaw, rejected_share


class LightMapRoulette(ShadowTest):
    """Tests a connection with a probability that grows with the visibility of the chosen cell from
    the vertex's row. Lights at infinity have cells too.

    Parameters:
        light_map: What was learned. The next event decision must choose from its rows and cells.
        slope, floor, law: See :class:`.rejection_law.RejectionLaw`.

    Attributes:
        rejected_share (float): Share of the pilots' shadow rays that it would not trace.
    """

    def __init__(self, light_map: LightMap, slope: float, floor: float, law: str) -> None:
        self._count = dr.opaque(mi.UInt32, light_map.cells.count)
        self._p = RejectionLaw(law, slope, floor).probability(
            light_map.ratio, light_map.visibility
        )
        dr.eval(self._p)
        self.rejected_share = rejected_share(self._p, light_map.tests)

    def probability(self, state, choice, si, ds, active):
        entry = choice.row * self._count + choice.cell
        return dr.gather(mi.Float, self._p, entry, active), state


class LightMapRouletteLearner(Learner):
    """Makes a roulette of the light map that another learner fills.

    Parameters:
        lights: Who learns the map; comes before this learner.
        slope, floor, law: See :class:`LightMapRoulette`.
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
        # All of it is in the light map
        return {} if self._lights.map is None else {"law": np.array(self._law["law"])}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> ShadowTest | None:
        return self._make_roulette()

    def _make_roulette(self) -> ShadowTest | None:
        """The roulette by the map; ``None`` if it does not pay."""
        roulette = LightMapRoulette(self._lights.map, **self._law)
        pays = roulette.rejected_share >= WORTHWHILE
        verb = "rejects" if pays else "does not reject"
        self._summary = f"{verb} {roulette.rejected_share:.0%} of the shadow rays"
        return roulette if pays else None

    def __str__(self) -> str:
        return self._summary
