"""Weights that spread chains evenly over the film."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ...rendering.camera import film_extent
from .target import Found

#: The approximate number of samples that estimate the luminance of a tile.
_SAMPLES = 64

#: The minimum luminance of a tile, as a fraction of the mean luminance, which bounds the weights.
_FLOOR = 0.05


class EvenTiles:
    """Weights of the target function, inversely proportional to the luminance of the film's tiles,
    which is estimated from samples. Dark parts of the image then get about as many visits as bright
    ones. The expected image does not depend on the weights.

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997, section 5.3 (two-stage
    MLT).

    Parameters:
        film: The film, whose crop window is divided into tiles.
        samples: The number of samples of the whole film that :meth:`take` will receive. The chains
            must start at other samples.
    """

    def __init__(self, film: mi.Film, samples: int) -> None:
        width, height = film_extent(film)
        self._offset = mi.ScalarPoint2f(film.crop_offset())
        tiles = max(1.0, samples / _SAMPLES)
        self._side = max(1.0, math.sqrt(width * height / tiles))
        self._columns = math.ceil(width / self._side)
        self._rows = math.ceil(height / self._side)
        self._sums = dr.zeros(mi.Float, self._columns * self._rows)
        self._inverse = dr.full(mi.Float, 1, dr.width(self._sums))

    def take(self, found: Found) -> None:
        """Adds samples to the estimate, and updates the weights."""
        for part in found.parts:
            tile = self._tile(part.position)
            dr.scatter_add(self._sums, part.target, tile, part.target > 0)
        dr.eval(self._sums)
        mean = dr.mean(self._sums)
        relative = dr.select(mean > 0, self._sums / mean, 1)
        self._inverse = dr.rcp(dr.maximum(relative, _FLOOR))
        dr.eval(self._inverse)

    def at(self, position: mi.Point2f) -> mi.Float:
        """The weight of a film position."""
        return dr.gather(mi.Float, self._inverse, self._tile(position))

    def _tile(self, position: mi.Point2f) -> mi.UInt32:
        place = (position - self._offset) / self._side
        column = dr.clip(mi.Int32(place.x), 0, self._columns - 1)
        row = dr.clip(mi.Int32(place.y), 0, self._rows - 1)
        return mi.UInt32(row * self._columns + column)
