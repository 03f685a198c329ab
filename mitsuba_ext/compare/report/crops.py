"""Chooses the image windows in which the integrators differ most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: The number of windows.
COUNT = 3

#: The side of a window, as a fraction of the image's width, and its bounds in pixels: large enough
#: to show something, and small enough to be enlarged on the page.
SHARE, SMALLEST, LARGEST = 1 / 8, 16, 96


class Window(NamedTuple):
    """A square part of an image, in pixels."""

    x: int
    y: int
    side: int

    def cut(self, pixels: np.ndarray) -> np.ndarray:
        """The window's part of an image."""
        return pixels[self.y : self.y + self.side, self.x : self.x + self.side]

    def distance(self, other: Window) -> int:
        """The distance of the corners, along the axis where it is larger. Windows at least ``side``
        apart do not overlap."""
        return max(abs(self.x - other.x), abs(self.y - other.y))


def choose_windows(errors: Sequence[np.ndarray], floor: float) -> list[Window]:
    """Windows that do not overlap, ordered by how much the integrators' errors differ.

    The score of a window is the variance, over the integrators, of the mean logarithm of the error
    in it. (Fireflies have little weight in the mean of the logarithms.) With a single integrator,
    the score is the mean logarithm itself.

    Args:
        errors: The error maps of the integrators, all of the same shape.
        floor: Smaller errors are raised to this value, because zero has no logarithm.
    """
    if not errors:
        return []
    height, width = errors[0].shape
    side = int(np.clip(round(width * SHARE), SMALLEST, LARGEST))
    if 2 * side > max(width, height) or side > min(width, height):
        return []  # a window would be most of the image
    logarithms = np.stack([np.log10(np.maximum(error, floor)) for error in errors])
    step = max(1, side // 4)
    rows = np.arange(0, height - side + 1, step)
    columns = np.arange(0, width - side + 1, step)
    means = np.stack([_window_means(one, side, rows, columns) for one in logarithms])
    scores = means.var(axis=0) if len(errors) > 1 else means[0]
    # Stable: equal scores stay in reading order, so the same images give the same windows
    order = np.argsort(-scores, axis=None, kind="stable")
    candidates = [
        Window(int(columns[index % len(columns)]), int(rows[index // len(columns)]), side)
        for index in order.tolist()
    ]
    chosen: list[Window] = []
    # Prefer separated windows, because three windows along one edge would show the same
    for distance in (2 * side, side):
        for window in candidates:
            if len(chosen) < COUNT and all(window.distance(one) >= distance for one in chosen):
                chosen.append(window)
    return chosen


def _window_means(
    values: np.ndarray, side: int, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """The means over the windows that begin at ``rows`` × ``columns``, from a summed-area table."""
    sums = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    sums[1:, 1:] = values.cumsum(axis=0).cumsum(axis=1)
    top, left = rows[:, None], columns[None, :]
    bottom, right = top + side, left + side
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    # Rounded, so that the table's cancellation error does not decide between equal windows
    return np.round(total / side**2, 9)
