"""The picture that a lens makes of layers: for each point of the lens, what hides what."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .images import LevelView, Pyramid, Size, rgb
from .layers import Layer
from .lens_points import RINGS, LensPoints, ring_points

#: Neighbouring pixels turn the points by different angles, of which these are the ranks in a square
#: of 4 × 4 pixels (Bayer's matrix): what the 48 points leave out differs from pixel to pixel.
_TURNS = (0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5)


def lens_filter(layers: list[Layer], size: Size) -> mi.Color3f:
    """The picture that a thin lens makes of layers.

    From each of 48 points of the lens, each layer is seen at another place. A layer covers what is
    behind it for this point only. So what is near hides a part of the lens from what is far, which
    becomes sharper, and shifted. This is a mask of the visible part of the lens for each pixel,
    where the source has a radius and a shift.

    The place is found in two steps: that for the blur at the pixel, and then that for the blur of
    the layer there.

    Parameters:
        layers: The nearest first.
        size: Of the pictures.
    """
    lens = LensPoints(ring_points())
    index, position = size.pixels()
    place = mi.Point2f(position) + 0.5
    seen = [_LayerView.of(layer, lens, size, index) for layer in layers]
    color, covered = _sum(lens, place, _turn(position), size, seen)
    return color / dr.maximum(covered, 1e-6)


@dataclass
class _LayerView:
    """A layer as a pixel sees it: the pixel's own blur, the blurs of all, the colours."""

    blur: mi.Float
    blurs: mi.Float
    view: LevelView

    @staticmethod
    def of(layer: Layer, lens: LensPoints, size: Size, index: mi.UInt32) -> _LayerView:
        blur = dr.gather(mi.Float, layer.blur, index)
        pyramid = Pyramid(dr.ravel(layer.color), size)
        return _LayerView(blur, layer.blur, lens.view(pyramid, blur))


def _turn(position: mi.Vector2i) -> mi.Vector2f:
    """Sine and cosine of the angle by which a pixel turns the points."""
    ranks = mi.UInt32(np.array(_TURNS, dtype=np.uint32))
    rank = dr.gather(mi.UInt32, ranks, mi.UInt32((position.y & 3) * 4 + (position.x & 3)))
    # The rings repeat themselves after this angle
    whole = 2 * math.pi / math.gcd(*RINGS)
    return mi.Vector2f(*dr.sincos(mi.Float(rank) * (whole / len(_TURNS))))


@dr.syntax
def _sum(lens, place, turn, size, seen):
    i, total, covered = mi.UInt32(0), mi.Color3f(0), mi.Float(0)
    while i < lens.count:
        color, opacity = _through(place, _turned(lens.at(i), turn), size, seen)
        total += color
        covered += opacity
        i += 1
    return total, covered


def _turned(point: mi.Point2f, turn: mi.Vector2f) -> mi.Point2f:
    x, y = point.x * turn.y - point.y * turn.x, point.x * turn.x + point.y * turn.y
    return mi.Point2f(x, y)


def _through(
    place: mi.Point2f, point: mi.Point2f, size: Size, seen: list[_LayerView]
) -> tuple[mi.Color3f, mi.Float]:
    """Colour and opacity of all layers, seen from a point of the lens."""
    through, color = mi.Float(1), mi.Color3f(0)
    for layer in seen:
        about = mi.Vector2i(dr.floor(place + layer.blur * point))
        blur = dr.gather(mi.Float, layer.blurs, size.index(about))
        found = layer.view.at(place + blur * point)
        color += through * rgb(found)
        through *= 1 - found.w
    return color, 1 - through
