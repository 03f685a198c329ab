"""Small bright things out of focus: what is spread over its circle of confusion, instead of being
looked for at points of the lens."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .images import Pyramid, Size, rgb
from .layers import Layer

#: A highlight is so many times as bright as the square around it that its circle fills, whatever
#: layers that shows; and as the darkest of the nine squares there, which has nothing of it.
_BRIGHTER, _BRIGHTER_THAN_DARKEST = 2.0, 4.0

#: Circles of a smaller radius, in pixels, are found by the points of the lens.
_LEAST_RADIUS = 2.0

#: All highlights together cover so many pixels, at most, for each pixel of the picture.
_MOST_COVERED = 8

#: What lets light through: called with pixels, and the points of the lens that are looked through.
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
    index, position = size.pixels()
    color = dr.gather(mi.Vector4f, layer.color, index)
    blur = layer.glow if layer.glow is not None else layer.blur
    radius = dr.abs(blur)
    level = mi.UInt32(dr.round(dr.log2(2 * dr.maximum(radius, 1))))
    view = around.view(dr.minimum(level, around.level_count - 1))
    middle, step = mi.Point2f(position) + 0.5, mi.Float(1 << level)
    # What covers a part of a pixel only is not brighter than something else that does
    mean = color.w * _relative(view.at(middle))
    darkest = mean
    for y in (-1, 0, 1):
        for x in (-1, 0, 1):
            near = color.w * _relative(view.at(middle + step * mi.Vector2f(x, y)))
            darkest = dr.minimum(darkest, near)
    bright = _brightness(color)
    is_bright = (radius > _LEAST_RADIUS) & (bright > _BRIGHTER * mean)
    is_bright &= bright > _BRIGHTER_THAN_DARKEST * darkest
    if not dr.any(is_bright):
        return layer.color, None
    # What the layer before shows is not shown twice
    is_shared = blur > dr.opaque(mi.Float, layer.shared)
    found = dr.compress(is_bright & ~is_shared)
    share = dr.select(is_bright, 1 - darkest / dr.select(is_bright, bright, 1), 0)
    excess = rgb(color) * share
    highlights, is_gone = None, dr.select(is_bright & is_shared, mi.Float(1), 0)
    dr.eval(excess, blur, radius, is_gone)
    if len(found) > 0:
        found = _affordable(found, excess, radius, size)
        dr.scatter(is_gone, mi.Float(1), found)
        highlights = Highlights(
            found, dr.gather(mi.Float, blur, found),
            mi.Color3f(*(dr.gather(mi.Float, channel, found) for channel in excess)),
        )  # fmt: skip
    # A new array: the pyramid has the other one
    rest = rgb(color) - excess * is_gone
    rest = dr.ravel(mi.Vector4f(rest.x, rest.y, rest.z, color.w))
    dr.eval(rest)
    return rest, highlights


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


def _affordable(
    found: mi.UInt32, excess: mi.Color3f, radius: mi.Float, size: Size
) -> mi.UInt32:
    """As many of the highlights as may be spread: those that are brightest for the pixels that they
    cover."""
    covered = math.pi * dr.square(dr.gather(mi.Float, radius, found)).numpy()
    if covered.sum() <= _MOST_COVERED * size.count:
        return found
    bright = dr.gather(mi.Float, dr.sum(excess), found).numpy()
    order = np.argsort(-bright / covered, kind="stable")
    chosen = order[np.cumsum(covered[order]) <= _MOST_COVERED * size.count]
    return mi.UInt32(found.numpy()[np.sort(chosen)])


def _brightness(color: mi.Vector4f) -> mi.Float:
    return color.x + color.y + color.z


def _relative(color: mi.Vector4f) -> mi.Float:
    """Brightness of what is there."""
    return _brightness(color) / dr.maximum(color.w, 1e-6)


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
        light = excess * (weight / total * visibility(index, mi.Point2f(at) + 0.5, point, active))
        for c in range(3):
            dr.scatter_add(picture, light[c], 3 * index + c, active)
        i += 1


def _coverage(offset: mi.Vector2i, radius: mi.Float) -> mi.Float:
    return dr.clip(radius + 0.5 - dr.norm(mi.Vector2f(offset)), 0, 1)
