"""Images as flat arrays with four numbers per pixel, and their pyramids."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

T = TypeVar("T")


@dataclass
class Size:
    """The width and height of an image in pixels. Kernels do not depend on them."""

    width: int
    height: int

    def __post_init__(self) -> None:
        self.count = self.width * self.height
        self._width = dr.opaque(mi.UInt32, self.width)
        self._last = dr.opaque(mi.Vector2i, [self.width - 1, self.height - 1])

    def contains(self, position: mi.Vector2i) -> mi.Bool:
        """Whether there is a pixel at a position."""
        return dr.all((position >= 0) & (position <= self._last))

    def pixels(self) -> tuple[mi.UInt32, mi.Vector2i]:
        """The index and the position of each pixel."""
        index = dr.arange(mi.UInt32, self.count)
        return index, self.position(index)

    def position(self, index: mi.UInt32) -> mi.Vector2i:
        """The position of the pixel with this index."""
        y = index // self._width
        return mi.Vector2i(mi.Int32(index - y * self._width), mi.Int32(y))

    def index(self, position: mi.Vector2i) -> mi.UInt32:
        """The index of the pixel at a position, or of the nearest pixel at the border."""
        position = dr.clip(position, 0, self._last)
        return mi.UInt32(position.y) * self._width + mi.UInt32(position.x)

    def half(self) -> Size:
        return Size((self.width + 1) // 2, (self.height + 1) // 2)


class Pyramid:
    """An image, with copies of half, a quarter, … of its size: means of 2 × 2 pixels.

    Parameters:
        data: The image: 4 numbers for each pixel, row by row.
        size: The size of the image.
        most_levels: The maximum number of levels, including the image.
    """

    def __init__(self, data: mi.Float, size: Size, most_levels: int = 12) -> None:
        self.size = size
        sizes = [size]
        while len(sizes) < most_levels and sizes[-1].count > 1:
            sizes.append(sizes[-1].half())
        starts = [0]
        for level in sizes:
            starts.append(starts[-1] + level.count)
        self.level_count = len(sizes)
        # Levels are separate arrays first: Dr.Jit would copy an array that is read and written
        copies = [data]
        for level in sizes[:-1]:
            copies.append(dr.ravel(halved(mi.Vector4f, copies[-1], level)))
            dr.eval(copies[-1])
        self._data = dr.concat(copies)
        self._starts = mi.UInt32(starts[:-1])
        self._widths = mi.Int32([level.width for level in sizes])
        self._heights = mi.Int32([level.height for level in sizes])
        dr.make_opaque(self._starts, self._widths, self._heights)

    def plus(self, other: Pyramid) -> Pyramid:
        """The sum of two images of the same size."""
        result = copy(self)
        result._data = self._data + other._data
        dr.eval(result._data)
        return result

    def view(self, level: mi.UInt32) -> LevelView:
        """A view of a level, which can differ between lanes."""
        return LevelView(
            self._data, dr.gather(mi.UInt32, self._starts, level),
            dr.gather(mi.Int32, self._widths, level), dr.gather(mi.Int32, self._heights, level),
            dr.rcp(mi.Float(1 << level)),
        )  # fmt: skip


@dataclass
class LevelView:
    """One level of a pyramid in each lane."""

    data: mi.Float
    start: mi.UInt32
    width: mi.Int32
    height: mi.Int32
    scale: mi.Float

    def at(self, place: mi.Point2f) -> mi.Vector4f:
        """The pixel at a place, given in pixels of the full-size image from its corner; beyond the
        border, the nearest pixel."""
        column = dr.clip(mi.Int32(dr.floor(place.x * self.scale)), 0, self.width - 1)
        row = dr.clip(mi.Int32(dr.floor(place.y * self.scale)), 0, self.height - 1)
        return dr.gather(mi.Vector4f, self.data, self.start + mi.UInt32(row * self.width + column))


def halved(kind: type[T], flat: mi.Float, size: Size) -> T:
    """Means of 2 × 2 pixels of an image."""
    _index, position = size.half().pixels()
    total = kind(0)
    for at in _four(size, 2 * position):
        total += dr.gather(kind, flat, at)
    return 0.25 * total


def bilinear(kind: type[T], flat: mi.Float, size: Size, place: mi.Point2f) -> T:
    """Interpolates an image between the centres of its pixels.

    Parameters:
        place: The position, in pixels from the corner of the image.
    """
    corner = mi.Vector2i(dr.floor(place - 0.5))
    right = place - 0.5 - mi.Point2f(corner)
    left = 1 - right
    weights = [left.x * left.y, right.x * left.y, left.x * right.y, right.x * right.y]
    total = kind(0)
    for weight, at in zip(weights, _four(size, corner)):
        total += weight * dr.gather(kind, flat, at)
    return total


def filled(kind: type, values: mi.Float, weight: mi.Float, size: Size) -> mi.Float:
    """Fills the holes of an image: where ``weight`` is below 1, means of surrounding pixels are
    added with the missing weight (Gortler et al., *The Lumigraph*, SIGGRAPH 1996: pull and push).

    Parameters:
        kind: The type of a pixel: ``mi.Float`` or ``mi.Vector4f``.
        values: The numbers of each pixel, row by row, already multiplied by its ``weight``.
        weight: The known fraction of each pixel, in [0, 1].
        size: Size of the image.

    Returns:
        The values; 0 if no pixel is known.
    """
    dr.eval(values, weight)
    levels = [(values, weight, size)]
    while levels[-1][2].count > 1:
        flat, weight, size = levels[-1]
        _index, position = size.half().pixels()
        total, known = kind(0), mi.Float(0)
        for at in _four(size, 2 * position):
            # Beyond the border, the border pixel is reused
            total += dr.gather(kind, flat, at)
            known += dr.gather(mi.Float, weight, at)
        # The weight of the four together is at most 1
        scale = dr.rcp(dr.maximum(known, 1))
        total, known = dr.ravel(total * scale), known * scale
        dr.eval(total, known)
        levels.append((total, known, size.half()))
    total, known, _size = levels.pop()
    found = dr.select(known > 0, total / dr.maximum(known, 1e-20), 0)
    dr.eval(found)
    while levels:
        flat, weight, size = levels.pop()
        index, position = size.pixels()
        place = (mi.Point2f(position) + 0.5) * 0.5
        around = bilinear(kind, found, size.half(), place)
        found = dr.ravel(dr.gather(kind, flat, index) + (1 - weight) * around)
        dr.eval(found)
    return found


def _four(size: Size, corner: mi.Vector2i) -> list[mi.UInt32]:
    return [size.index(corner + mi.Vector2i(x, y)) for y in range(2) for x in range(2)]


def rgb(values: mi.Vector4f) -> mi.Color3f:
    """The first three of four numbers."""
    return mi.Color3f(values.x, values.y, values.z)
