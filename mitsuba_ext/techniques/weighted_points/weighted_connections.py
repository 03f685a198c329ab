"""Connecting a vertex to many points of lights, from a weighted set.

Source: Guo, PhD thesis, section 4.5.2.4.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import ConnectionCount, LightNumbers
from .weighted_sets import WeightedSets

#: The golden ratio: its multiples, modulo one, are evenly spread.
_GOLDEN = 0.6180339887


class WeightedConnections(ConnectionCount):
    """Each vertex draws a whole set of numbers for its connections, and shifts it on the torus at
    random. MIS weighs the one BSDF sample of the vertex against this number of connections.

    A set chooses points on lights. Where the light is chosen by numbers of its own, these come from
    a lattice, which has a random shift of its own.

    Parameters:
        sets: Sets of two dimensions.
        everywhere: At all vertices, not only at the first of a path?
    """

    def __init__(self, sets: WeightedSets, everywhere: bool) -> None:
        self.first, self.later = sets.count, sets.count if everywhere else 1
        self._sets = sets
        self._inverse_count = dr.opaque(mi.Float, 1 / sets.count)

    def begin(self, sampler, choice_dimension):
        number = self._sets.choose(sampler.next_1d())
        shift = sampler.next_2d()
        return number, shift, sampler.next_2d() if choice_dimension > 0 else None

    def numbers(self, chosen, index, choice_dimension, active):
        number, shift, choice_shift = chosen
        point, weight = self._sets.draw(number, shift, index, active)
        if choice_dimension == 0:
            return LightNumbers(point), weight
        i = mi.Float(index)
        choice = choice_shift + mi.Point2f(i * self._inverse_count, i * _GOLDEN)
        choice -= dr.floor(choice)
        # Rounding must not reach the upper end
        choice = dr.minimum(choice, dr.one_minus_epsilon(mi.Float))
        return LightNumbers(point, choice.x if choice_dimension == 1 else choice), weight


class NoFirstConnections(ConnectionCount):
    """Light is found by BSDF samples only, at a path's first vertex or at all.

    Parameters:
        everywhere: At all vertices?
    """

    def __init__(self, everywhere: bool) -> None:
        self.first, self.later = 0, 0 if everywhere else 1
