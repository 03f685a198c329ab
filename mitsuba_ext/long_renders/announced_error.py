"""The error of an image that its own batches announce."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from ..images.metrics import RELATIVE_FLOOR

#: Width of the neighbourhood, in pixels, that tells how bright a pixel is.
_NEIGHBOURS = 3


def announced_error(mean: np.ndarray, variance: np.ndarray) -> float | None:
    """The relMSE of an image whose truth is not known; ``None`` for a black one.

    The variance of a pixel is divided by the square of its brightness. The pixel itself would be a
    bad judge of that: one that holds a bright spot has a large variance, and would be forgiven it
    because it is bright. So the median over its neighbourhood is taken. Pixels that are not finite
    do not count.

    Args:
        mean, variance: Of the image, and of this mean: [height, width, 3].
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
