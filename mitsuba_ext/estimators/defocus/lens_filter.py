"""The image of layers through a lens, with visibility computed for each point of the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .highlights import MAX_COVERED, Highlights, Visibility, spread, without_highlights
from .images import LevelView, Pyramid, Size, rgb
from .layers import Layer
from .lens_points import RINGS, LensPoints, ring_points

#: The ranks of the angles by which the pixels of a 4 × 4 square rotate the points (Bayer matrix),
#: so that the errors of the 48 points differ between neighbouring pixels.
_TURNS = (0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5)

#: Pairs of a radius, in pixels, and the numbers of points per ring that are enough if no layer that
#: a pixel sees is blurred by more than the radius. Above the last radius, all ``RINGS`` are used. A
#: circle within the pixel needs one point.
_FEW_POINTS = ((0.5, (1,)), (2.0, (4, 8)))

#: The maximum number of passes that search for highlights.
_ROUNDS = 2

#: The maximum difference, in pixels, between blurs of a layer that count as equal.
_EQUAL_BLURS = 0.5

#: The minimum coverage of a layer that hides everything behind it.
_OPAQUE = 0.9999

#: The number of pixels that a pixel may see beyond the circle of its own blur.
_MARGIN = 2.0


def lens_filter(layers: list[Layer], size: Size, max_covered: float = MAX_COVERED) -> mi.Color3f:
    """The image of layers through a thin lens.

    Each of 48 points of the lens sees each layer shifted. For each point separately, a layer covers
    the layers behind it. Near objects therefore hide a part of the lens from far ones, which become
    sharper and shifted. Each pixel has a mask of the visible part of the lens, which Guo's thesis
    (``effective.py``) approximates by a radius and a shift.

    The shifted position is found in two steps: first with the blur at the pixel, then with the
    layer's blur at the position from the first step.

    Parameters:
        layers: The layers, nearest first.
        size: The size of the images.
        max_covered: The maximum number of pixels that the highlights of a layer cover, per pixel.
    """
    return _LensFilter(layers, size, max_covered).picture()


class _LensFilter:
    def __init__(self, layers: list[Layer], size: Size, max_covered: float) -> None:
        self._size, self._layers = size, list(layers)
        self._lens = LensPoints(ring_points())
        self._few = [_Points(rings) for _radius, rings in _FEW_POINTS] + [_Points(RINGS)]
        self._pyramids = [Pyramid(layer.color, size) for layer in layers]
        self._highlights: list[tuple[int, Highlights]] = []
        self._take_highlights(max_covered)
        dr.eval([layer.blur for layer in layers])
        self._is_flat = [_range(layer.blur) <= _EQUAL_BLURS for layer in layers]

    def _take_highlights(self, max_covered: float) -> None:
        """Moves highlights from the layers to ``_highlights``. Once the brightest ones are gone,
        their edges stand out, and are found in a second pass."""
        layers = self._layers
        for _ in range(_ROUNDS):
            around, before = reduce(Pyramid.plus, self._pyramids), len(self._highlights)
            for k, layer in enumerate(layers):
                color, highlights = without_highlights(layer, around, self._size, max_covered)
                if color is not layer.color:
                    layers[k] = replace(layer, color=color)
                    self._pyramids[k] = Pyramid(color, self._size)
                if highlights is not None:
                    self._highlights.append((k, highlights))
            if len(self._highlights) == before:
                return

    def picture(self) -> mi.Color3f:
        """Computes the image, jointly for all pixels that see the same layers through the same
        number of points."""
        index, position = self._size.pixels()
        place = mi.Point2f(position) + 0.5
        group = self._group(place)
        dr.eval(group)
        count = len(self._layers)
        sizes = dr.zeros(mi.UInt32, len(self._few) << count)
        dr.scatter_add(sizes, mi.UInt32(1), group)
        picture = dr.zeros(mi.Float, 3 * self._size.count)
        for number in np.flatnonzero(sizes.numpy()):
            chosen = dr.compress(group == dr.opaque(mi.UInt32, int(number)))
            where = self._size.position(chosen)
            points = self._few[number >> count]
            seen = [self._view(k, chosen) for k in range(count) if number >> k & 1]
            color, covered = _sum(
                points.table, mi.Point2f(where) + 0.5, points.turn(where), self._size, seen
            )
            dr.scatter(picture, color / dr.maximum(covered, 1e-6), chosen)
            dr.eval(picture)
        for k, highlights in self._highlights:
            spread(picture, highlights, self._size, self._before(k))
        return dr.gather(mi.Color3f, picture, index)

    def _before(self, count: int) -> Visibility:
        """A function that returns the transmittance of the first ``count`` layers."""

        def visibility(pixel: mi.UInt32, place: mi.Point2f, point: mi.Point2f) -> mi.Float:
            seen = [self._view(k, pixel) for k in range(count)]
            return 1 - _through(place, point, self._size, seen)[1] if seen else mi.Float(1)

        return visibility

    def _group(self, place: mi.Point2f) -> mi.UInt32:
        """For each pixel, one bit for each layer that it may see, and above these bits an index
        into ``_few``. The last layer can be seen everywhere except behind opaque ones."""
        bits, largest, is_open = mi.UInt32(0), mi.Float(0), mi.Bool(True)
        for k, (layer, pyramid) in enumerate(zip(self._layers, self._pyramids)):
            # Four pixels of a level coarse enough for them to cover the circle
            reach = dr.abs(layer.blur) + _MARGIN
            level = mi.UInt32(dr.ceil(dr.log2(2 * reach)))
            view = pyramid.view(dr.minimum(level, pyramid.level_count - 1))
            coverage = mi.Float(0)
            for x in (-1, 1):
                for y in (-1, 1):
                    coverage += view.at(place + reach * mi.Vector2f(x, y)).w
            is_seen = is_open & (coverage > 0) if k < len(self._layers) - 1 else is_open
            bits |= dr.select(is_seen, mi.UInt32(1 << k), 0)
            largest = dr.maximum(largest, dr.select(is_seen, dr.abs(layer.blur), 0))
            is_open &= coverage < _OPAQUE * 4
        for radius, _rings in _FEW_POINTS:
            bits += dr.select(largest > radius, mi.UInt32(1 << len(self._layers)), 0)
        return bits

    def _view(self, k: int, index: mi.UInt32) -> _LayerView:
        layer = self._layers[k]
        blur = dr.gather(mi.Float, layer.blur, index)
        blurs = None if self._is_flat[k] else layer.blur
        return _LayerView(blur, blurs, self._lens.view(self._pyramids[k], blur))


@dataclass
class _LayerView:
    """A layer as seen by a pixel: the layer's blur at the pixel, its blurs at all pixels (``None``
    if they are equal), and its colours."""

    blur: mi.Float
    blurs: mi.Float | None
    view: LevelView


class _Points:
    """Points of the lens, rotated by different angles in different pixels."""

    def __init__(self, rings: tuple[int, ...]) -> None:
        points = ring_points(rings) if sum(rings) > 1 else np.zeros((1, 2))
        self.table = LensPoints(points)
        # The rings are symmetric under rotations by 2π / gcd
        self._step = dr.opaque(mi.Float, 2 * math.pi / math.gcd(*rings) / len(_TURNS))

    def turn(self, position: mi.Vector2i) -> mi.Vector2f:
        """The sine and cosine of the angle by which a pixel rotates the points."""
        ranks = from_numpy(mi.UInt32, _TURNS)
        rank = dr.gather(mi.UInt32, ranks, mi.UInt32((position.y & 3) * 4 + (position.x & 3)))
        return mi.Vector2f(*dr.sincos(mi.Float(rank) * self._step))


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
    """The colour and opacity of all layers, seen from a point of the lens."""
    through, color = mi.Float(1), mi.Color3f(0)
    for layer in seen:
        at = place + layer.blur * point
        if layer.blurs is not None:
            about = size.index(mi.Vector2i(dr.floor(at)))
            at = place + dr.gather(mi.Float, layer.blurs, about) * point
        found = layer.view.at(at)
        color += through * rgb(found)
        through *= 1 - found.w
    return color, 1 - through


def _range(values: mi.Float) -> float:
    least, most = dr.min(values), dr.max(values)
    return float(dr.slice(most - least))
