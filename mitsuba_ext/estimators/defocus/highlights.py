"""Highlights: small bright spots out of focus. Each is spread over its circle of confusion, because
gathering at points of the lens would miss it from most pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .images import Pyramid, Size, rgb
from .layers import Layer

#: The minimum brightness of a highlight, relative to the mean over the square that its circle of
#: confusion would fill, in the sum of all layers. The bright half of a pattern has a smaller ratio.
_MIN_CONTRAST = 3.0

#: The minimum radius of a highlight's circle of confusion, in pixels. Gathering at the points of
#: the lens handles smaller ones.
_MIN_RADIUS = 2.0

#: The maximum number of pixels that all highlights of a layer cover, per pixel of the image.
MAX_COVERED = 8

#: A function of the indices of pixels, their centres, and points of the lens that returns the
#: transmittance of layers.
Visibility = Callable[..., "mi.Float"]


@dataclass
class Highlights:
    """The pixels of a layer that are spread as highlights.

    Attributes:
        pixel: The indices of the pixels.
        blur: The signed radii of their circles of confusion in pixels, not 0.
        excess: The RGB excess over their surroundings.
    """

    pixel: mi.UInt32
    blur: mi.Float
    excess: mi.Color3f


def without_highlights(
    layer: Layer, around: Pyramid, size: Size, max_covered: float = MAX_COVERED
) -> tuple[mi.Float, Highlights | None]:
    """Divides a layer into its colours without highlights, and the highlights (``None`` if there
    are none). With gathering alone, the 48 lens points of one pixel would hit a bright pixel, and
    the points of the next pixel would miss it.

    Parameters:
        layer: The layer.
        around: The pyramid of the sum of all layers.
        size: The size of the image.
        max_covered: The maximum number of pixels that the highlights cover, per pixel of the image.
    """
    glow = layer.glow if layer.glow is not None else layer.blur
    found = dr.compress(_Pixels(layer, glow, around, size, size.pixels()[0]).is_bright())
    if len(found) == 0:
        return layer.color, None
    pixels = _Pixels(layer, glow, around, size, found)
    # The darkest of the squares around a highlight shows the brightness without it
    excess = rgb(pixels.color) * (1 - pixels.darkest() / pixels.bright)
    # Highlights that the previous layer also contains are removed here, but not spread twice
    is_shared = pixels.blur > dr.opaque(mi.Float, layer.shared)
    radius, blur = dr.select(is_shared, 0, pixels.radius), pixels.blur
    dr.eval(excess, radius, blur)
    spread_ones = _affordable(excess, radius, max_covered * size.count)
    is_gone = dr.select(is_shared, mi.Float(1), 0)
    if len(spread_ones) > 0:
        dr.scatter(is_gone, mi.Float(1), spread_ones)
    # A copy, because the pyramid uses the original array
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
    """Pixels of a layer, and the brightness of their surroundings."""

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
        """Whether the pixel is a highlight: much brighter than the square around it."""
        limit = dr.maximum(_MIN_CONTRAST * self._square(0, 0), 0)
        return (self.radius > _MIN_RADIUS) & (self.bright > limit)

    def darkest(self) -> mi.Float:
        """The brightness of the darkest of the nine squares at and around the pixel."""
        darkest = self._square(0, 0)
        for y in (-1, 0, 1):
            for x in (-1, 0, 1):
                darkest = dr.minimum(darkest, self._square(x, y))
        # Film filters can have negative lobes
        return dr.maximum(darkest, 0)

    def _square(self, x: int, y: int) -> mi.Float:
        color = self._view.at(self._middle + self._step * mi.Vector2f(x, y))
        # Colours are multiplied by coverage: scale the square's colour to the coverage of the pixel
        return self.color.w * _brightness(color) / dr.maximum(color.w, 1e-6)


def spread(picture: mi.Float, highlights: Highlights, size: Size, visibility: Visibility) -> None:
    """Adds highlights to an image, over their circles of confusion, attenuated by layers in front.

    Parameters:
        picture: The RGB of each pixel, row by row.
        highlights: The highlights of a layer.
        size: Size of the picture.
        visibility: The transmittance of the layers in front.
    """
    position = size.position(highlights.pixel)
    _spread(picture, position, highlights.blur, highlights.excess, size, visibility)
    dr.eval(picture)


def _affordable(excess: mi.Color3f, radius: mi.Float, limit: float) -> mi.UInt32:
    """The indices of the highlights to spread, out of the highlights with a radius above 0: if
    these would cover more than ``limit`` pixels, the ones with the largest brightness per pixel."""
    covered = math.pi * np.square(radius.numpy())
    order = np.flatnonzero(covered)
    if covered.sum() > limit:
        bright = dr.sum(excess).numpy()
        order = order[np.argsort(-bright[order] / covered[order], kind="stable")]
        order = order[np.cumsum(covered[order]) <= limit]
    return from_numpy(mi.UInt32, np.sort(order))


def _brightness(color: mi.Vector4f) -> mi.Float:
    return color.x + color.y + color.z


@dr.syntax
def _spread(picture, position, blur, excess, size, visibility):
    radius = dr.abs(blur)
    reach = mi.Int32(dr.ceil(radius + 0.5))
    side = 2 * reach + 1
    # Normalize by the sum over pixels, not by the disk's area, so that no light is lost
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
        # The point of the lens through which the pixel ``at`` sees the highlight
        point = -mi.Point2f(offset) / blur
        light = excess * (weight / total * visibility(index, mi.Point2f(at) + 0.5, point))
        for c in range(3):
            dr.scatter_add(picture, light[c], 3 * index + c, active)
        i += 1


def _coverage(offset: mi.Vector2i, radius: mi.Float) -> mi.Float:
    return dr.clip(radius + 0.5 - dr.norm(mi.Vector2f(offset)), 0, 1)
