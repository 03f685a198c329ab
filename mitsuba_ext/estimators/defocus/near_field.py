"""Blurs the near layer with a separable filter of its colour, coverage and blur, and of the
direction towards its objects."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .images import Size, bilinear, halved
from .layers import Layer

#: The maximum number of pixels of the window on each side. Larger windows are applied to a copy of
#: the image at lower resolution.
_MAX_TAPS = 12


@dataclass
class NearField:
    """The filtered near layer.

    Attributes:
        color: RGB times opacity, and opacity.
        blur: The largest radius in the window, which belongs to the nearest object, in pixels.
        direction: The direction towards the objects in the window, of length 1; 0 if there are
            none.
    """

    color: mi.Vector4f
    blur: mi.Float
    direction: mi.Vector2f


def near_field(layer: Layer, size: Size, radius: float) -> NearField:
    """Filters a layer with a Gaussian. ``radius`` is the radius of the window, in pixels; the
    standard deviation is a third of it.

    Source: J. J. Guo, PhD thesis, TU Delft, section 5.4.1.1, Listing 1 and Eq. 5.5. Wide windows
    are filtered in a copy at lower resolution.
    """
    full, color, blur = size, layer.color, layer.blur
    scale = 1
    while radius / scale > _MAX_TAPS and size.count > 1:
        dr.eval(color, blur)
        smaller = halved(mi.Vector4f, color, size)
        color, blur = dr.ravel(smaller), halved(mi.Float, blur, size)
        size, scale = size.half(), 2 * scale
    index, position = size.pixels()
    coverage = dr.gather(mi.Vector4f, color, index).w
    around = dr.ravel(mi.Vector4f(0, 0, coverage, blur))
    taps = dr.opaque(mi.Int32, max(1, round(radius / scale)))
    factor = dr.opaque(mi.Float, -0.5 / max(radius / scale / 3, 1e-3) ** 2)
    for axis in (mi.Vector2i(1, 0), mi.Vector2i(0, 1)):
        dr.make_opaque(axis)
        dr.eval(color, around)
        means = _pass(axis, position, size, color, around, taps, factor)
        color, around = (dr.ravel(values) for values in means)
    dr.eval(color, around)

    _index, position = full.pixels()
    place = (mi.Point2f(position) + 0.5) / scale
    color, found = (bilinear(mi.Vector4f, flat, size, place) for flat in (color, around))
    length = dr.sqrt(found.x**2 + found.y**2)
    # If the coverage is equal on all sides, only rounding errors remain of the direction
    is_clear = length > 1e-3 * dr.maximum(found.z, 1e-3)
    direction = mi.Vector2f(found.x, found.y) / dr.select(is_clear, length, 1)
    return NearField(color, found.w, dr.select(is_clear, direction, 0))


@dr.syntax
def _pass(axis, position, size, color, around, taps, factor):
    """The filter along an axis.

    Parameters:
        color: RGB times coverage, and coverage, which are averaged with Gaussian weights.
        around: The sums of the offsets of covered pixels in x and y and of the coverage, and the
            largest blur. All pixels of the window have the same weight.
    """
    i = -taps
    mean, weights = mi.Vector4f(0), mi.Float(0)
    offset, covered, largest = mi.Vector2f(0), mi.Float(0), mi.Float(-dr.inf)
    while i <= taps:
        at = size.index(position + i * axis)
        weight = dr.exp(factor * mi.Float(i * i))
        mean += weight * dr.gather(mi.Vector4f, color, at)
        weights += weight
        found = dr.gather(mi.Vector4f, around, at)
        offset += mi.Vector2f(found.x, found.y) + found.z * mi.Vector2f(i * axis)
        covered += found.z
        largest = dr.maximum(largest, found.w)
        i += 1
    return mean / weights, mi.Vector4f(offset.x, offset.y, covered, largest)
