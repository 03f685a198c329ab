"""Sums and means over the neighbours of each pixel."""

from __future__ import annotations

import functools

import numpy as np

#: The default number of pixels on each side, along each axis, of the box around a pixel.
RADIUS = 4


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
