"""Sums and means over the neighbours of each pixel."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

#: The default number of pixels on each side, along each axis, of the box around a pixel.
RADIUS = 4

#: The number of rows that a lane of :func:`exact_box_sums` filters.
_STRIP = 64


def box_means(image: np.ndarray, radius: int = RADIUS) -> np.ndarray:
    """The mean over each pixel of an image and its neighbours, shape [y, x]."""
    return box_sums(image, radius) / _counts(image.shape, radius)


def box_sums(image: np.ndarray, radius: int = RADIUS) -> np.ndarray:
    """The sum over each pixel and its neighbours, shape [y, x]."""
    for axis in range(2):
        size = image.shape[axis]
        sums = np.cumsum(image, axis)
        sums = np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis)
        index = np.arange(size)
        end = np.minimum(index + radius + 1, size)
        image = sums.take(end, axis) - sums.take(np.maximum(index - radius, 0), axis)
    return image


def squares_by_neighbours(image: np.ndarray) -> np.ndarray:
    """The product of each pixel of an image with the mean of its neighbours, shape [y, x]: an
    estimate of its squared mean that is free of the pixel's noise."""
    neighbours = np.maximum(_counts(image.shape, 1) - 1, 1)
    return image * (box_sums(image, 1) - image) / neighbours


@functools.lru_cache(maxsize=8)
def _counts(shape: tuple[int, int], radius: int) -> np.ndarray:
    """The number of neighbours of each pixel, including the pixel itself, shape [y, x]."""
    return box_sums(np.ones(shape), radius)


def exact_box_sums(running: mi.UInt64, width: int, height: int) -> mi.UInt64:
    """:func:`box_sums` with the default radius, of images of integers on the device.

    Parameters:
        running: The running sums (``dr.cumsum``) of images that follow one another, row by row.
            Differences of integers are exact, however large the pixels in front of a box are.
        width, height: Size of an image.
    """
    result = dr.empty(mi.UInt64, len(running))
    strips = -(-height // _STRIP)
    # Opaque: images of all sizes share the kernel
    size = [dr.opaque(mi.Int32, x) for x in (width, height, strips)]
    _filter(result, running, *size, len(running) // height * strips)
    dr.eval(result)
    return result


@dr.syntax
def _filter(result, running, width, height, strips, lanes):
    """Each lane moves the box down a strip of a column: one row enters it, another leaves."""
    lane = dr.arange(mi.Int32, lanes)
    part = lane // width
    x, image = lane - part * width, part // strips
    first = (part - image * strips) * _STRIP
    last = dr.minimum(first + _STRIP, height)
    left, right = dr.maximum(x - RADIUS, 0), dr.minimum(x + RADIUS + 1, width)

    def row(y: mi.Int32, active: mi.Bool) -> mi.UInt64:
        """The sum over a row of the box; 0 outside of the image."""
        active = active & (y >= 0) & (y < height)
        begin = (image * height + y) * width + left
        end = begin + (right - left)
        before = dr.gather(mi.UInt64, running, mi.UInt32(begin - 1), active & (begin > 0))
        return dr.gather(mi.UInt64, running, mi.UInt32(end - 1), active) - before

    total, entering = mi.UInt64(0), first - RADIUS
    while entering < last + RADIUS:
        total += row(entering, mi.Bool(True))
        y = entering - RADIUS
        is_whole = y >= first
        dr.scatter(result, total, mi.UInt32((image * height + y) * width + x), is_whole)
        total -= row(y - RADIUS, is_whole)
        entering += 1
