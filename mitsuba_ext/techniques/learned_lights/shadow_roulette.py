"""Russian roulette on the shadow ray, by the visibility of the chosen cell in a light map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import ShadowTest
from ...transport.rejection_law import RejectionLaw, rejected_share
from .light_map import LightMap


class LightMapRoulette(ShadowTest):
    """Tests a connection with a probability that grows with the visibility of the chosen cell from
    the vertex's row. Lights at infinity have cells too.

    Parameters:
        light_map: The learned map. The next event decision must choose from its rows and cells.
        law: The probability of a test.

    Attributes:
        rejected_share (float): Share of the pilots' shadow rays that the roulette would not trace.
    """

    def __init__(self, light_map: LightMap, law: RejectionLaw) -> None:
        self._count = dr.opaque(mi.UInt32, light_map.cells.count)
        self._p = law.probability(
            light_map.ratio, light_map.visibility
        )
        dr.eval(self._p)
        self.rejected_share = rejected_share(self._p, light_map.tests)

    def probability(self, state, choice, si, ds, active):
        entry = choice.row * self._count + choice.cell
        return dr.gather(mi.Float, self._p, entry, active), state
