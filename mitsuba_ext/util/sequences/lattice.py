"""Rank-1 lattices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .scrambling import fraction, scrambled

#: Integers that generate the lattice; they are constructed for 2^10 to 2^20 points.
_GENERATING_VECTOR = (1, 182667, 469891, 498753, 110745, 446247, 250185, 118627)


class Lattice:
    """An extensible rank-1 lattice: multiples of a vector, modulo 1, in the order of the van der
    Corput sequence; each coordinate is shifted by a random number.

    Source: R. Cools, F. Y. Kuo, D. Nuyens, *Constructing Embedded Lattice Rules for Multivariate
    Integration*, SIAM J. Sci. Comput. 28(6), 2006, with their vector.

    Parameters:
        dimensions: Number of dimensions: 2, 4, 6 or 8.
    """

    def __init__(self, dimensions: int) -> None:
        self.pairs = dimensions // 2
        self._vector = mi.UInt32(_GENERATING_VECTOR[:dimensions])

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        # In aligned ranges of 2^k indices, these remain the points of a lattice
        bits = max(1, (count - 1).bit_length())
        return scrambled(index, seed) & ((1 << bits) - 1)

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        # Fixed-point arithmetic: 32-bit integers wrap around, which is the modulo 1
        return fraction(dr.brev(point) * dr.gather(mi.UInt32, self._vector, dimension) + seed)
