"""Estimates the error of an image from the variance of its batches."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from ..images.metrics import RELATIVE_FLOOR

#: The width of the neighbourhood from which a pixel's brightness is estimated, in pixels.
_NEIGHBOURS = 3


def announced_error(mean: np.ndarray, variance: np.ndarray) -> float | None:
    """Estimates the relMSE of an image without a reference; ``None`` for a black one.

    The variance of a pixel is divided by the square of its brightness. The pixel's own value would
    be a bad estimate of its brightness: a firefly has a large variance, but also a large value, and
    would hardly raise the error. The brightness is therefore the median over the pixel's
    neighbourhood. Pixels that are not finite are omitted.

    Args:
        mean, variance: The image and the variance of this mean, [height, width, 3].
    """
    is_finite = (np.isfinite(mean) & np.isfinite(variance)).all(axis=2, keepdims=True)
    count = 3 * np.count_nonzero(is_finite)
    mean = np.where(is_finite, mean, 0).astype(np.float32)
    if not count or not mean.any():
        return None
    floor = RELATIVE_FLOOR * (mean.sum(dtype=np.float64) / count) ** 2
    brightness = median_filter(mean, (_NEIGHBOURS, _NEIGHBOURS, 1), mode="nearest")
    relative = np.where(is_finite, variance, 0) / (brightness**2 + floor)
    return float(relative.sum(dtype=np.float64) / count)
