"""The Sobol' sequence."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from .scrambling import fraction, mixed, scrambled

#: For each dimension except the first: the inner coefficients of the primitive polynomial, as bits,
#: and the first direction numbers (Joe and Kuo).
JOE_KUO = [
    (0, [1]), (1, [1, 3]), (1, [1, 3, 1]), (2, [1, 1, 1]), (1, [1, 1, 3, 3]), (4, [1, 3, 5, 13]),
    (2, [1, 1, 5, 5, 17]),
]  # fmt: skip

#: The number of bits of an index for which one table entry is read.
_BITS = 6


class Sobol:
    """The Sobol' sequence with nested uniform scrambling of its coordinates and of its order.

    Source: I. M. Sobol', *On the Distribution of Points in a Cube and the Approximate Evaluation of
    Integrals*, 1967; direction numbers of S. Joe and F. Y. Kuo, *Constructing Sobol Sequences with
    Better Two-dimensional Projections*, SIAM J. Sci. Comput. 30(5), 2008; scrambling and shuffling
    by hashes: B. Burley, *Practical Hash-based Owen Scrambling*, JCGT 9(4), 2020.

    Parameters:
        dimensions: Number of dimensions: 2, 4, 6 or 8.
    """

    def __init__(self, dimensions: int) -> None:
        self.pairs = dimensions // 2
        # For each dimension, group of bits, and value of these bits: the exclusive or of the
        # columns of all bits that are set
        columns = _direction_numbers(dimensions)
        groups = -(-32 // _BITS)
        self._group_words = 1 << _BITS
        self._dimension_words = groups * self._group_words
        table = np.zeros((dimensions, groups, self._group_words), dtype=np.uint32)
        for bit in range(32):
            group, place = divmod(bit, _BITS)
            has_bit = (np.arange(self._group_words) >> place) & 1 == 1
            table[:, group, has_bit] ^= columns[:, bit, None]
        self._table = from_numpy(mi.UInt32, table)

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        # The upper bits are the same for all samples. They would only flip bits of the coordinates,
        # which scrambling does anyway
        return scrambled(index, seed) & ((1 << _index_bits(count)) - 1)

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        x, at = mi.UInt32(0), dimension * self._dimension_words
        for group in range(-(-_index_bits(count) // _BITS)):
            bits = (point >> (group * _BITS)) & (self._group_words - 1)
            word = dr.gather(mi.UInt32, self._table, at + (group * self._group_words + bits))
            x = x ^ word
        return fraction(scrambled(x, mixed(seed)))


def _index_bits(count: int) -> int:
    """The number of bits of the integers below ``count``."""
    return max(1, (count - 1).bit_length())


def _direction_numbers(dimensions: int) -> np.ndarray:
    """The bits of a coordinate that each bit of an index flips: [dimension, bit]."""
    columns = np.zeros((dimensions, 32), dtype=np.uint64)
    columns[0] = 1 << np.arange(31, -1, -1, dtype=np.uint64)
    for row, (polynomial, first) in zip(columns[1:], JOE_KUO):
        degree = len(first)
        for bit in range(32):
            if bit < degree:
                row[bit] = first[bit] << (31 - bit)
                continue
            row[bit] = row[bit - degree] ^ (row[bit - degree] >> np.uint64(degree))
            for k in range(1, degree):
                if polynomial >> (degree - 1 - k) & 1:
                    row[bit] ^= row[bit - k]
    return columns.astype(np.uint32)
