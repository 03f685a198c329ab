"""Latin hypercube samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .scrambling import fraction, mixed


class LatinHypercube:
    """Latin hypercube samples: each dimension is divided into as many intervals as there are
    points, and each interval has one point, in a random order that differs between dimensions.

    Source: M. D. McKay, R. J. Beckman, W. J. Conover, *A Comparison of Three Methods for Selecting
    Values of Input Variables in the Analysis of Output from a Computer Code*, Technometrics 21(2),
    1979.
    """

    pairs = 1

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        return index

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        interval = mi.permute_kensler(point, count, seed)
        place = (mi.Float(interval) + fraction(mixed(mixed(seed) + point))) / count
        # Rounding may reach 1
        return dr.minimum(place, 1 - 2.0**-24)
