"""Learns a visibility map, and makes a Russian roulette on shadow rays from it.

Source: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, sections 3.3.1 and
4.1 (= Guo's thesis, sections 3.3.3.1 and 3.4.1).
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...planning.costs import REJECTION
from ...planning.learner import Learner, Pilot
from ...transport.path_decisions import ShadowTest
from ...transport.rejection_law import RejectionLaw
from ...util.stored_arrays import StoredArrays
from .visibility_map import VisibilityMap
from .visibility_roulette import VisibilityRoulette


class VisibilityRouletteLearner(Learner):
    """Learns a visibility map in the pilots, and rejects shadow rays with it in the last stage.

    Parameters:
        grid, max_memory, refine: See the integrator ``neepp``.
        law: The probability of a test.
    """

    def __init__(
        self, grid: int, max_memory: float, refine: int, law: RejectionLaw
    ) -> None:
        self._grid, self._max_memory, self._refine = grid, int(max_memory * 2**20), refine
        self._law = law
        self._summary = ""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> None:
        self._map = VisibilityMap(scene, self._grid, self._max_memory)

    def connection(self, choice, vertex, ds, contribution, value, pdf, visible, tested) -> None:
        self._map.shadow_ray(vertex.si.p, ds.p, visible, tested)

    def segment(self, p: mi.Point3f, q: mi.Point3f, active: mi.Bool) -> None:
        self._map.segment(p, q, active)

    def learn(self, pilot: Pilot) -> ShadowTest | None:
        if not pilot.is_last:
            return None
        self._map.refine(pilot.scene, self._refine)
        return self._make_roulette()

    def _make_roulette(self) -> ShadowTest | None:
        """The roulette from the map; ``None`` if it does not pay."""
        self._summary = str(self._map)
        roulette = None
        if len(self._map.light_voxels()) > 0:
            roulette = VisibilityRoulette(self._map, self._law)
            if roulette.rejected_share < REJECTION:
                self._summary += f"; not used, it would reject only {roulette.rejected_share:.0%}"
                roulette = None
        return roulette

    def state(self) -> dict[str, np.ndarray]:
        return self._map.state()

    def restore(self, scene: mi.Scene, state: StoredArrays) -> ShadowTest | None:
        self._map = VisibilityMap(scene, self._grid, self._max_memory)
        self._map.restore(state)
        return self._make_roulette()

    def finish(self) -> None:
        del self._map  # the counters: the last stage needs the roulette's table only

    def __str__(self) -> str:
        return self._summary
