"""The Faure sequence."""

from __future__ import annotations

from math import comb

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from .scrambling import fraction, mixed

#: For each number of dimensions, the smallest prime that is at least as large.
_BASES = {2: 2, 4: 5, 6: 7, 8: 11}


class Faure:
    """The Faure sequence: a (0, s)-sequence in a prime base, by powers of Pascal's matrix.

    Digits are permuted by nested cyclic shifts, as in ``halton.py``.

    Source: H. Faure, *Discrépance de suites associées à un système de numération (en dimension s)*,
    1982.

    Parameters:
        dimensions: Number of dimensions: 2, 4, 6 or 8.
    """

    def __init__(self, dimensions: int) -> None:
        self.pairs = dimensions // 2
        self._base = base = _BASES[dimensions]
        self._size = next(n for n in range(1, 33) if base**n >= 2**32)
        # The factor with which each digit of an index is added to each digit of a coordinate
        matrices = np.zeros((dimensions, self._size, self._size), dtype=np.uint32)
        for dimension in range(dimensions):
            for row in range(self._size):
                for column in range(row, self._size):
                    power = pow(dimension, column - row, base)
                    matrices[dimension, row, column] = comb(column, row) * power % base
        self._matrices = from_numpy(mi.UInt32, matrices)

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        return mi.permute_kensler(index, count, seed)

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        base = self._base
        length = next(n for n in range(1, 33) if base**n >= count)
        digits = []
        for _ in range(length):
            digits.append(point % base)
            point = point // base
        value, word = mi.UInt32(0), mixed(seed)
        at = dimension * self._size**2
        for row in range(length):
            digit = mi.UInt32(0)
            for column in range(row, length):
                entry = at + (row * self._size + column)
                digit += digits[column] * dr.gather(mi.UInt32, self._matrices, entry)
            digit = digit % base
            value = value * base + (digit + word % base) % base
            word = mixed(word + digit + 1)
        return dr.minimum((mi.Float(value) + fraction(word)) / float(base**length), 1 - 2.0**-24)
