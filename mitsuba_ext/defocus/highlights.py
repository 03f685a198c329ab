"""Small bright things out of focus: what is spread over its circle of confusion, instead of being
looked for at points of the lens."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from .images import Pyramid, Size, rgb
from .layers import Layer

#: A highlight is so many times as bright as the square around it that its circle fills, whatever
#: layers that shows: more than the bright half of a pattern.
_BRIGHTER = 3.0

#: Circles of a smaller radius, in pixels, are found by the points of the lens.
_LEAST_RADIUS = 2.0

#: All highlights together cover so many pixels, at most, for each pixel of the picture.
_MOST_COVERED = 8

#: How much light gets through: called with the indices of pixels, their middles, and points of the
#: lens.
Visibility = Callable[..., "mi.Float"]


@dataclass
class Highlights:
    """Pixels of a layer that are spread, and by what these are brighter than what is around.

    Attributes:
        pixel: Their indices.
        blur: Signed radii in pixels, not 0.
        excess: RGB.
    """

    pixel: mi.UInt32
    blur: mi.Float
    excess: mi.Color3f


def without_highlights(
    layer: Layer, around: Pyramid, size: Size
) -> tuple[mi.Float, Highlights | None]:
    """The colours of a layer without what is brighter than its surroundings, and that: ``None`` if
    there is nothing. 48 points of the lens would meet a bright pixel from one pixel and miss it
    from the next.

    Parameters:
        around: The sum of all layers.
    """
    glow = layer.glow if layer.glow is not None else layer.blur
    found = dr.compress(_Pixels(layer, glow, around, size, size.pixels()[0]).is_bright())
    if len(found) == 0:
        return layer.color, None
    pixels = _Pixels(layer, glow, around, size, found)
    # The darkest square around has nothing of it
    excess = rgb(pixels.color) * (1 - pixels.darkest() / pixels.bright)
    # What the layer before shows is not shown twice
    is_shared = pixels.blur > dr.opaque(mi.Float, layer.shared)
    radius, blur = dr.select(is_shared, 0, pixels.radius), pixels.blur
    dr.eval(excess, radius, blur)
    spread_ones = _affordable(excess, radius, size)
    is_gone = dr.select(is_shared, mi.Float(1), 0)
    if len(spread_ones) > 0:
        dr.scatter(is_gone, mi.Float(1), spread_ones)
    # A new array: the pyramid has the other one
    rest = dr.copy(layer.color)
    for k, channel in enumerate(excess):
        dr.scatter_add(rest, -channel * is_gone, 4 * found + k)
    dr.eval(rest)
    if len(spread_ones) == 0:
        return rest, None
    return rest, Highlights(
        dr.gather(mi.UInt32, found, spread_ones), dr.gather(mi.Float, blur, spread_ones),
        mi.Color3f(*(dr.gather(mi.Float, channel, spread_ones) for channel in excess)),
    )  # fmt: skip


class _Pixels:
    """Pixels of a layer, and how bright it is around them."""

    def __init__(
        self, layer: Layer, glow: mi.Float, around: Pyramid, size: Size, index: mi.UInt32
    ) -> None:
        self.color = dr.gather(mi.Vector4f, layer.color, index)
        self.blur = dr.gather(mi.Float, glow, index)
        self.radius, self.bright = dr.abs(self.blur), _brightness(self.color)
        level = mi.UInt32(dr.round(dr.log2(2 * dr.maximum(self.radius, 1))))
        level = dr.minimum(level, around.level_count - 1)
        self._view, self._step = around.view(level), mi.Float(1 << level)
        self._middle = mi.Point2f(size.position(index)) + 0.5

    def is_bright(self) -> mi.Bool:
        """Brighter than the square around it?"""
        limit = dr.maximum(_BRIGHTER * self._square(0, 0), 0)
        return (self.radius > _LEAST_RADIUS) & (self.bright > limit)

    def darkest(self) -> mi.Float:
        """The brightness of the darkest of nine squares."""
        darkest = self._square(0, 0)
        for y in (-1, 0, 1):
            for x in (-1, 0, 1):
                darkest = dr.minimum(darkest, self._square(x, y))
        # Film filters can have negative lobes
        return dr.maximum(darkest, 0)

    def _square(self, x: int, y: int) -> mi.Float:
        color = self._view.at(self._middle + self._step * mi.Vector2f(x, y))
        # What covers a part of a pixel only is not brighter than something else that does
        return self.color.w * _brightness(color) / dr.maximum(color.w, 1e-6)


def spread(picture: mi.Float, highlights: Highlights, size: Size, visibility: Visibility) -> None:
    """Adds highlights to a picture: each to the disk of its blur, where the layers before it let it
    through.

    Parameters:
        picture: RGB of each pixel, row by row.
        visibility: How much of what is seen from these pixels through these points of the lens.
    """
    position = size.position(highlights.pixel)
    _spread(picture, position, highlights.blur, highlights.excess, size, visibility)
    dr.eval(picture)


def _affordable(excess: mi.Color3f, radius: mi.Float, size: Size) -> mi.UInt32:
    """The numbers of the highlights that may be spread: those that are brightest for the pixels
    that they cover, of those of a radius."""
    covered = math.pi * np.square(radius.numpy())
    order = np.flatnonzero(covered)
    if covered.sum() > _MOST_COVERED * size.count:
        bright = dr.sum(excess).numpy()
        order = order[np.argsort(-bright[order] / covered[order], kind="stable")]
        order = order[np.cumsum(covered[order]) <= _MOST_COVERED * size.count]
    return from_numpy(mi.UInt32, np.sort(order))


def _brightness(color: mi.Vector4f) -> mi.Float:
    return color.x + color.y + color.z


@dr.syntax
def _spread(picture, position, blur, excess, size, visibility):
    radius = dr.abs(blur)
    reach = mi.Int32(dr.ceil(radius + 0.5))
    side = 2 * reach + 1
    # By what a disk of pixels differs from one of the plane: all of the light arrives
    i, total = mi.Int32(0), mi.Float(0)
    while i < side * side:
        total += _coverage(mi.Vector2i(i % side, i // side) - reach, radius)
        i += 1
    i = mi.Int32(0)
    while i < side * side:
        offset = mi.Vector2i(i % side, i // side) - reach
        weight = _coverage(offset, radius)
        at = position + offset
        active = (weight > 0) & size.contains(at)
        index = size.index(at)
        # From there, the highlight is seen through this point
        point = -mi.Point2f(offset) / blur
        light = excess * (weight / total * visibility(index, mi.Point2f(at) + 0.5, point))
        for c in range(3):
            dr.scatter_add(picture, light[c], 3 * index + c, active)
        i += 1


def _coverage(offset: mi.Vector2i, radius: mi.Float) -> mi.Float:
    return dr.clip(radius + 0.5 - dr.norm(mi.Vector2f(offset)), 0, 1)
