"""The order in which the pixels of a film take points of one sequence, so that the errors of
neighbouring pixels cancel.

A sequence of which each aligned range of points is well distributed is cut into ranges, one for
each pixel. The pixels are put in Z-order: each square of 2^k x 2^k pixels then has an aligned range
of points, too, so that its mean has less error than that of independent pixels. The four quarters
of each square are in random order, so that no pattern repeats itself.

Source: A. G. M. Ahmed, P. Wonka, *Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error
via Hierarchical Ordering of Pixels*, ACM Transactions on Graphics 39(6), 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import drjit as dr
import mitsuba as mi

from .scrambling import mixed

#: Squares of 2^7 x 2^7 pixels have sequences of their own: a point's number has 32 bits, and errors
#: that vary so slowly over the film are small already.
_MOST_LEVELS = 7


def level_count(count: int) -> int:
    """How often squares of pixels are divided into quarters that share a sequence, if each pixel
    takes ``count`` points: their numbers must be below 2^32."""
    return min(_MOST_LEVELS, (32 - (count - 1).bit_length()) // 2)


@dataclass
class PixelOrder:
    """Where pixels stand in Z-order.

    Attributes:
        tile: A number of the square of 2^levels x 2^levels pixels that the pixel is in.
        place: The pixel's number in this square.
    """

    tile: mi.UInt32
    place: mi.UInt32


def z_order(pixel: mi.UInt32, width: mi.UInt32, levels: int) -> PixelOrder:
    """The places of pixels that are numbered row by row, ``width`` in each row."""
    y = pixel // width
    x = pixel - y * width
    place = mi.UInt32(0)
    for bit in range(levels):
        place |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return PixelOrder(mixed(y >> levels) + (x >> levels), place)


def shuffled(place: mi.UInt32, levels: int, seed: mi.UInt32) -> mi.UInt32:
    """Places with the quarters of each square in one of the 24 orders, chosen by a hash of the
    square and of the seed."""
    # Two bits for each of the four quarters
    table = mi.UInt32([sum(new << (2 * old) for old, new in enumerate(order))
                       for order in permutations(range(4))])  # fmt: skip
    result = mi.UInt32(0)
    for level in range(levels):
        quarter = (place >> (2 * level)) & 3
        # Squares of all sizes get different words: a one stands before the bits of the square
        square = (place >> (2 * level + 2)) | (1 << (2 * (levels - level - 1)))
        word = mixed(seed ^ mixed(square))
        order = dr.gather(mi.UInt32, table, ((word >> 16) * 24) >> 16)
        result |= ((order >> (2 * quarter)) & 3) << (2 * level)
    return result
