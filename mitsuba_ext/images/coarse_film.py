"""A film with fewer pixels, for samples that only need to be representative."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class CoarseFilm:
    """Divides the pixels of a film into rectangles of about equal size.

    Attributes:
        width, height: Number of rectangles along each axis.
        pixel_count: Number of pixels of the film.
        of_pixel: The rectangle of each pixel, row by row; ``None`` if each pixel is a rectangle.
        samples: The pixel of each sample; all rectangles have the same number of samples.
    """

    width: int
    height: int
    pixel_count: int
    of_pixel: np.ndarray | None
    samples: np.ndarray

    @classmethod
    def whole(cls, width: int, height: int) -> CoarseFilm:
        """A film in which each pixel is a rectangle with one sample."""
        pixels = np.arange(width * height, dtype=np.uint32)
        return cls(width, height, width * height, None, pixels)

    @classmethod
    def of(cls, width: int, height: int, count: int) -> CoarseFilm:
        """A film with about ``count`` samples, two or more per rectangle for their variance."""
        pixels, scale = width * height, np.sqrt(count / (2 * width * height))
        if scale >= 1:
            film = cls.whole(width, height)
            return cls(width, height, pixels, None, np.tile(film.samples, -(-count // pixels)))
        columns, rows = (max(1, round(scale * size)) for size in (width, height))
        column = place(np.arange(width), width, columns)
        row = place(np.arange(height), height, rows)
        of_pixel = (row[:, None] * columns + column).ravel().astype(np.uint32)
        x, y = _centres(width, columns), _centres(height, rows)
        samples = (y[:, None] * width + x).ravel().astype(np.uint32)
        return cls(columns, rows, pixels, of_pixel, np.tile(samples, 2))

    @property
    def pixel_width(self) -> float:
        """The mean width of a rectangle, in pixels."""
        return float(np.sqrt(self.pixel_count / (self.width * self.height)))


def place(index: Any, size: Any, parts: Any) -> Any:
    """The part of a row or column to which its pixel ``index`` belongs. Arguments are integers, or
    arrays of NumPy or Dr.Jit."""
    return (2 * index + 1) * parts // (2 * size)


def _centres(size: int, parts: int) -> np.ndarray:
    return (2 * np.arange(parts) + 1) * size // (2 * parts)
