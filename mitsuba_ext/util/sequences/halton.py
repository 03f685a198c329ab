"""The Halton sequence and the Hammersley set."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .scrambling import fraction, mixed

#: The bases of the dimensions.
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19)

#: The maximum number of intervals that digits distinguish: the numbers have 24 bits, and the next
#: power of the largest base still fits into 32 bits.
_MAX_INTERVALS = 1 << 24


class Halton:
    """The Halton sequence: each dimension is the radical inverse of the index in a different prime
    base.

    Digits are permuted by nested cyclic shifts: each digit is shifted by a hash of the digits
    before it. This is Owen scrambling, restricted to cyclic permutations.

    Source: J. H. Halton, *On the Efficiency of Certain Quasi-random Sequences of Points in
    Evaluating Multi-dimensional Integrals*, 1960.

    Parameters:
        dimensions: Number of dimensions: 2, 4, 6 or 8.
    """

    def __init__(self, dimensions: int) -> None:
        self.pairs = dimensions // 2
        self._bases = mi.UInt32(_PRIMES[:dimensions])

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        return mi.permute_kensler(index, count, seed)

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        # Lanes that a loop has left gather 0, which must not be a divisor
        base = dr.maximum(dr.gather(mi.UInt32, self._bases, dimension), 2)
        return radical_inverse(point, count, base, seed)


class Hammersley(Halton):
    """The Hammersley set: the first dimension is the index plus a random number in [0, 1), divided
    by the number of points; the others are the dimensions of the Halton sequence.

    Source: J. M. Hammersley, *Monte Carlo Methods for Solving Multivariable Problems*, 1960.
    """

    def coordinate(self, point, count, dimension, seed) -> mi.Float:
        inverse = super().coordinate(point, count, dr.maximum(dimension, 1) - 1, seed)
        regular = (mi.Float(point) + fraction(seed + mixed(point))) / count
        # Rounding may reach 1
        return dr.select(dimension == 0, dr.minimum(regular, 1 - 2.0**-24), inverse)


def radical_inverse(
    index: mi.UInt32, count: int, base: mi.UInt32, seed: mi.UInt32
) -> mi.Float:
    """The radical inverse of an index below ``count``: its digits, randomly shifted, behind the
    radix point, followed by the digits of a random number."""
    count = dr.opaque(mi.UInt32, min(count, _MAX_INTERVALS))
    # ``power`` is the number of intervals that the digits so far distinguish
    power, digits, rest, word = mi.UInt32(1), mi.UInt32(0), mi.UInt32(index), mixed(seed)

    def step(power, digits, rest, word):
        digit = rest % base
        shifted = (digit + word % base) % base
        return power * base, digits * base + shifted, rest // base, mixed(word + digit + 1)

    power, digits, rest, word = dr.while_loop(
        (power, digits, rest, word), lambda power, *_: power < count, step, label="digits"
    )
    # Points that share an interval differ in the remaining digits, which give them different random
    # numbers
    value = (mi.Float(digits) + fraction(word + mixed(rest))) / mi.Float(power)
    return dr.minimum(value, 1 - 2.0**-24)
