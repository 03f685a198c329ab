"""Dividing a film into parts whose pixels are evenly spread."""

from __future__ import annotations

import numpy as np


def dithered_parts(width: int, height: int, count: int) -> list[np.ndarray]:
    """Divides the pixels of a film, counted row by row, into parts. The second part is as large as
    the first, and each later one as large as all before. The pixels of a part form a lattice.

    Parameters:
        width, height: Size of the film.
        count: Number of parts, at least 2.
    """
    period = 1 << (count - 1)
    # The shift between rows: close to the golden section of the period, and odd
    shift = round(0.382 * period) | 1
    y, x = np.mgrid[0:height, 0:width]
    phase = ((x + shift * y) % period).ravel()
    parts, step = [np.flatnonzero(phase == 0)], period
    while step > 1:
        parts.append(np.flatnonzero(phase % step == step // 2))
        step //= 2
    return [part.astype(np.uint32) for part in parts]
