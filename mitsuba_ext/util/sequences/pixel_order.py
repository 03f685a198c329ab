"""The order in which pixels take the points of one sequence, chosen such that the errors of
neighbouring pixels cancel.

A sequence whose aligned ranges of points are well distributed is cut into ranges, one for each
pixel. The pixels are in Z-order, so each square of 2^k x 2^k pixels also has an aligned range of
points, and its mean has less error than with independent pixels. The random order of the four
quarters of each square avoids repeating patterns.

Source: A. G. M. Ahmed, P. Wonka, *Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error
via Hierarchical Ordering of Pixels*, ACM Transactions on Graphics 39(6), 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import drjit as dr
import mitsuba as mi

from .scrambling import mixed

#: The maximum number of levels. Each square of 2^7 x 2^7 pixels has a separate sequence: a point's
#: index has only 32 bits, and errors of lower frequency are already small.
_MAX_LEVELS = 7


def level_count(count: int) -> int:
    """The number of levels k if squares of 2^k x 2^k pixels share a sequence, and each pixel takes
    ``count`` points. All indices of points must be below 2^32."""
    return min(_MAX_LEVELS, (32 - (count - 1).bit_length()) // 2)


@dataclass
class PixelOrder:
    """The positions of pixels in Z-order.

    Attributes:
        tile: A number that identifies the pixel's square of 2^levels x 2^levels pixels.
        place: The pixel's index in this square.
    """

    tile: mi.UInt32
    place: mi.UInt32


def z_order(pixel: mi.UInt32, width: mi.UInt32, levels: int) -> PixelOrder:
    """The positions of pixels, which are given as indices row by row, ``width`` in each row."""
    y = pixel // width
    x = pixel - y * width
    place = mi.UInt32(0)
    for bit in range(levels):
        place |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return PixelOrder(mixed(y >> levels) + (x >> levels), place)


def shuffled(place: mi.UInt32, levels: int, seed: mi.UInt32) -> mi.UInt32:
    """The places after the quarters of each square have been permuted: by one of the 24
    permutations, which a hash of the square and the seed chooses."""
    # Two bits for each of the four quarters
    table = mi.UInt32([sum(new << (2 * old) for old, new in enumerate(order))
                       for order in permutations(range(4))])  # fmt: skip
    result = mi.UInt32(0)
    for level in range(levels):
        quarter = (place >> (2 * level)) & 3
        # A leading 1 before the bits of the square: squares of different sizes get different hashes
        square = (place >> (2 * level + 2)) | (1 << (2 * (levels - level - 1)))
        word = mixed(seed ^ mixed(square))
        order = dr.gather(mi.UInt32, table, ((word >> 16) * 24) >> 16)
        result |= ((order >> (2 * quarter)) & 3) << (2 * level)
    return result
