"""Filters of a single picture, for comparisons. They have no data on hidden surfaces, and blur far
surfaces by their whole circle of confusion."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.estimators.defocus.filters import FILTERS, Capture
from mitsuba_ext.estimators.defocus.images import Pyramid, Size, rgb
from mitsuba_ext.estimators.defocus.layers import Limits, layers_from_sums
from mitsuba_ext.estimators.defocus.lens_points import LensPoints, ring_points

#: Points of the spiral of the filter of one pass.
_SPIRAL = 96


def gather_filter(color: mi.Color3f, blur: mi.Float, size: Size) -> mi.Color3f:
    """Blurs a picture: near surfaces over far ones, both gathered at 48 points.

    Surfaces nearer than the focus are gathered in a circle with the radius of the largest blur
    around; each counts if its own blur reaches the pixel. Farther ones are gathered in the circle
    of the pixel's own blur; sharper ones count only if their blur reaches the pixel. Behind a near
    pixel, the far surfaces around it are used.

    Source: J. J. Guo, PhD thesis, TU Delft, Table 5.1 (*gather*), which leaves the details open;
    these are those of J. Jimenez, *Next Generation Post Processing in Call of Duty*, SIGGRAPH
    course, 2014.

    Parameters:
        color, blur: Colour and blur of each pixel, row by row; blurs are signed radii in pixels.
        size: Size of the picture.
    """
    lens = LensPoints(ring_points())
    index, position = size.pixels()
    place = mi.Point2f(position) + 0.5
    picture = Pyramid(dr.ravel(mi.Vector4f(color.x, color.y, color.z, blur)), size)
    widest = _largest_around(dr.maximum(blur, 0), size)
    own = dr.gather(mi.Float, blur, index)
    near, opacity = _near(lens, picture.view(mi.UInt32(0)), place, widest)
    # Copies of lower resolution would mix the blurs of near and far surfaces
    far = _far(lens, picture.view(mi.UInt32(0)), place, own)
    return near * opacity + far * (1 - opacity)


@dr.syntax
def _near(lens, view, place, widest):
    i, total, weights, opacity = mi.UInt32(0), mi.Color3f(0), mi.Float(0), mi.Float(0)
    while i < lens.count:
        point = lens.at(i)
        found = view.at(place + widest * point)
        reaches = (found.w >= widest * dr.norm(point)) & (found.w > 0.5)
        # The weight is proportional to 1 / r², as a pixel of blur r is spread over r² π pixels
        weight = dr.select(reaches, dr.square(widest / dr.maximum(found.w, 0.5)), 0)
        total += weight * rgb(found)
        weights += weight
        i += 1
    opacity = dr.minimum(weights / mi.Float(lens.count), 1)
    return mi.Color3f(total / dr.maximum(weights, 1e-6)), opacity


@dr.syntax
def _far(lens, view, place, own):
    i, total, weights = mi.UInt32(0), mi.Color3f(0), mi.Float(0)
    centre = view.at(place)
    while i < lens.count:
        point = lens.at(i)
        found = view.at(place + own * point)
        reaches = (own > 0.5) | (-found.w >= dr.abs(own) * dr.norm(point) - 0.5)
        weight = dr.select((found.w <= 0.5) & reaches, mi.Float(1), 0)
        total += weight * rgb(found)
        weights += weight
        i += 1
    # Where nothing reaches the pixel, its colour is unchanged
    mean = total / dr.maximum(weights, 1e-6)
    return mi.Color3f(dr.select(weights > 0, mean, rgb(centre)))


def one_pass_filter(color: mi.Color3f, blur: mi.Float, size: Size) -> mi.Color3f:
    """Blurs a picture in one pass over a spiral around each pixel: a point of the spiral counts if
    its blur reaches the pixel, and is otherwise replaced by the mean so far. The blur of points
    farther than the pixel is limited to twice the pixel's own blur.

    Source: D. Gustafsson, *Bokeh depth of field in a single pass*, 2018; J. J. Guo, PhD thesis, TU
    Delft, Table 5.1 (*one pass*).

    Parameters:
        color, blur: Colour and blur of each pixel, row by row; blurs are signed radii in pixels.
        size: Size of the picture.
    """
    k = np.arange(_SPIRAL) + 0.5
    angle, radius = k * np.pi * (3 - np.sqrt(5)), np.sqrt(k / _SPIRAL)
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    lens = LensPoints(spiral)
    index, position = size.pixels()
    place = mi.Point2f(position) + 0.5
    widest = _largest_around(dr.abs(blur), size)
    picture = Pyramid(dr.ravel(mi.Vector4f(color.x, color.y, color.z, blur)), size)
    here = dr.gather(mi.Float, blur, index)
    start = dr.gather(mi.Color3f, dr.ravel(color), index)
    return _spiral(lens, lens.view(picture, widest), place, widest, here, start)


@dr.syntax
def _spiral(lens, view, place, widest, here, start):
    i, total, count = mi.UInt32(0), start, mi.Float(1)
    while i < lens.count:
        point = lens.at(i)
        found = view.at(place + widest * point)
        reach = dr.abs(found.w)
        # Points that are farther than this pixel
        limit = dr.select(found.w < here, 2 * dr.abs(here), dr.inf)
        reach = dr.minimum(reach, limit)
        share = dr.clip(reach - widest * dr.norm(point) + 0.5, 0, 1)
        total += share * rgb(found) + (1 - share) * total / count
        count += 1
        i += 1
    return mi.Color3f(total / count)


def _largest_around(radius: mi.Float, size: Size) -> mi.Float:
    """An upper bound of the radii that reach each pixel, computed for squares of 16 × 16 pixels:
    the largest radius within a distance of the largest of all."""
    tile = 16
    width, height = -(-size.width // tile), -(-size.height // tile)
    tiles = Size(width, height)
    index, position = size.pixels()
    place = position // tile
    at = mi.UInt32(place.y * width + place.x)
    largest = dr.zeros(mi.Float, tiles.count)
    dr.scatter_reduce(dr.ReduceOp.Max, largest, radius, at)
    steps = int(np.ceil(largest.numpy().max() / tile))
    _index, middle = tiles.pixels()
    found = dr.copy(largest)
    for _ in range(steps):
        dr.eval(found)
        around = dr.copy(found)
        for y in (-1, 0, 1):
            for x in (-1, 0, 1):
                near = dr.gather(mi.Float, found, tiles.index(middle + mi.Vector2i(x, y)))
                around = dr.maximum(around, dr.select(near > 0, near, 0))
        found = around
    del index
    return dr.gather(mi.Float, found, at)


class OfPicture:
    """A filter of what the camera sees first."""

    has_layers = False

    def __init__(self, function: Callable[[mi.Color3f, mi.Float, Size], mi.Color3f]) -> None:
        self._function = function

    def limits(self, blurs: np.ndarray) -> Limits:
        return Limits([])

    def picture(self, capture: Capture) -> mi.Color3f:
        (only,) = layers_from_sums(capture.sums, capture.size)
        color = dr.gather(mi.Vector4f, only.color, dr.arange(mi.UInt32, capture.size.count))
        return self._function(rgb(color), capture.blur, capture.size)


FILTERS["gather"] = lambda: OfPicture(gather_filter)
FILTERS["one_pass"] = lambda: OfPicture(one_pass_filter)
