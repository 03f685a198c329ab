"""Directions as points of a square: the unfolded faces of an octahedron."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def octahedral(v: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """A unit vector in octahedral coordinates, two numbers in [-1, 1]."""
    scale = dr.rcp(dr.abs(v.x) + dr.abs(v.y) + dr.abs(v.z))
    x, y = v.x * scale, v.y * scale
    is_below = v.z < 0
    return (
        dr.select(is_below, dr.mulsign(1 - dr.abs(y), x), x),
        dr.select(is_below, dr.mulsign(1 - dr.abs(x), y), y),
    )


def from_octahedral(x: mi.Float, y: mi.Float) -> mi.Vector3f:
    """The inverse of :func:`octahedral`."""
    z = 1 - dr.abs(x) - dr.abs(y)
    # Distance below the equator: this half of the octahedron was folded outwards
    below = dr.maximum(-z, 0)
    return dr.normalize(mi.Vector3f(x - dr.mulsign(below, x), y - dr.mulsign(below, y), z))
