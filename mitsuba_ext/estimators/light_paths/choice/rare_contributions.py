"""Contributions that a render is too short to find.

A sampler that finds some light with contributions of value x, which are rare, has a variance of x
times that light: most of it is in a few pixels of a render, or in none. The other pixels lack the
light. A user sees what is missing, not the variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ....images.box_filter import squares_by_neighbours

#: Values of contributions are counted by powers of four, from 4⁻¹⁶ on; the last bin holds what is
#: never found.
BINS, _LEAST = 33, 16

#: Values are compared by their binary logarithm first, within these bounds.
_MOST_EXPONENT = 128


def bin_of(value: mi.Float) -> mi.UInt32:
    """The bin of contributions of a value."""
    return mi.UInt32(dr.clip(0.5 * dr.log2(value) + _LEAST, 0, BINS - 2))


class Rare(NamedTuple):
    """What rare contributions make of each pixel, [pixel] each.

    Attributes:
        light: Its radiance.
        moment: Its second moment, per sample.
        square: The square of that radiance. (The estimate is free of the noise of ``light``.)
    """

    light: np.ndarray
    moment: np.ndarray
    square: np.ndarray


def rare(
    found: np.ndarray, scale: np.ndarray, width: int, spp: float, shares: Sequence[float]
) -> list[Rare]:
    """For each of ``shares``: the brightest contributions, relative to their pixel. The number of
    them that a render is expected to find is at most this share of the number of pixels.

    Parameters:
        found: Light and second moment of each sample, for each bin of values, shape [pixel, bin,
            2].
        scale: 1 / radiance of each pixel.
        width: Pixels of a row.
        spp: Samples per pixel of the render.
        shares: Parts of the pixels.
    """
    index = np.flatnonzero(found[..., 0] != 0)  # several times as fast as ``nonzero``
    place, value_bin = np.divmod(index, BINS)
    light, moment = found.reshape(-1, 2)[index].T.astype(np.float64)
    # Values of 0 are products that are too small for a float
    value = np.where(value_bin == BINS - 1, np.inf, np.maximum(moment / light, 1e-30))
    # The expected number of contributions of a bin, in a pixel of the render
    number, relative = spp * light / value, value * scale[place]
    bright = _brightest(relative, number, max(shares) * len(found))
    place, light, moment = place[bright], light[bright], moment[bright]
    order = np.argsort(-relative[bright])
    number = np.cumsum(number[bright][order])
    result = []
    for share in shares:
        first = order[: np.searchsorted(number, share * len(found), side="right")]
        rare_light, rare_moment = (
            np.bincount(place[first], x[first], len(found)) for x in (light, moment)
        )
        squares = squares_by_neighbours(rare_light.reshape(-1, width)).ravel()
        result.append(Rare(rare_light, rare_moment, squares))
    return result


def _brightest(value: np.ndarray, number: np.ndarray, most: float) -> np.ndarray:
    """The places of the largest values, up to a total of ``most`` contributions, and of some more:
    sorting all values would take long."""
    exponent = np.clip(np.log2(value), -_MOST_EXPONENT, _MOST_EXPONENT)
    level = (_MOST_EXPONENT - exponent).astype(np.int64)
    last = np.searchsorted(np.cumsum(np.bincount(level, number)), most, side="right")
    return np.flatnonzero(level <= last)


def error_of_render(variance: np.ndarray, mean: np.ndarray, rare: Rare, spp: float) -> np.ndarray:
    """The expected squared error of each pixel of a render that lacks rare contributions, times the
    number of its samples.

    Parameters:
        variance, mean: Variance and mean of one sample of each pixel.
        rare: What the render lacks.
        spp: Samples per pixel of the render.
    """
    common = variance - rare.moment + mean**2 - (mean - rare.light) ** 2
    return common + spp * rare.square
