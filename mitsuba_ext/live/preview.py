"""Images as a browser gets them: few enough pixels, as 16-bit floats."""

from __future__ import annotations

import math

import numpy as np

#: The most pixels of an image for the page.
_MOST_PIXELS = 1 << 21

#: The largest 16-bit float.
_LARGEST = 65504.0


def reduced(image: np.ndarray) -> np.ndarray:
    """An image, [height, width, channel] or [height, width], with at most about two million pixels:
    the means of squares of its pixels. A square with a pixel that is not finite is not finite."""
    height, width = image.shape[:2]
    step = math.ceil(math.sqrt(height * width / _MOST_PIXELS))
    if step <= 1:
        return image
    rows, columns = np.arange(0, height, step), np.arange(0, width, step)
    with np.errstate(invalid="ignore", over="ignore"):
        sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
        counts = np.diff([*rows, height])[:, None] * np.diff([*columns, width])
        return sums / counts.reshape(counts.shape + (1,) * (image.ndim - 2))


def half_floats(image: np.ndarray) -> bytes:
    """Little-endian 16-bit floats. Finite values stay finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        clipped = np.where(np.isfinite(image), np.clip(image, -_LARGEST, _LARGEST), image)
        return clipped.astype("<f2").tobytes()
