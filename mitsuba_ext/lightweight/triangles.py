"""Intersects rays with triangles, such that no ray passes between two that share an edge."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi


def intersect(
    ray: mi.Ray3f, maxt: mi.Float, corners: Sequence[mi.Point3f]
) -> tuple[mi.Bool, mi.Float, mi.Point2f]:
    """Whether a ray hits a triangle before ``maxt``; if so, at which distance, and the barycentric
    coordinates of the second and third corner.

    The sign of a product of an edge and the ray, in Plücker coordinates, tells on which side the
    ray passes the edge. Two triangles that share the edge compute it from the same numbers, with
    the other sign: rounding errors do not open a gap. Products and sums are fused where it is said,
    so that each backend rounds both in the same way.
    """
    a, b, c = (corner - ray.o for corner in corners)
    ab, bc, ca = b - a, c - b, a - c
    w_c, w_a, w_b = _side(ab, a + b, ray.d), _side(bc, b + c, ray.d), _side(ca, c + a, ray.d)
    is_inside = (dr.minimum(dr.minimum(w_a, w_b), w_c) >= 0) | (
        dr.maximum(dr.maximum(w_a, w_b), w_c) <= 0
    )
    normal = _cross(ab, ca)
    cosine = dr.dot(normal, ray.d)
    t = dr.dot(normal, a) / cosine
    uv = mi.Point2f(w_b, w_c) / (w_a + w_b + w_c)
    # A comparison with NaN is false: the triangle is seen from its edge
    return is_inside & (t >= 0) & (t < maxt), t, uv


def _side(edge: mi.Vector3f, ends: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    x, y, z = _cross(edge, ends)
    return dr.fma(x, d.x, dr.fma(y, d.y, z * d.z))


def _cross(a: mi.Vector3f, b: mi.Vector3f) -> mi.Vector3f:
    return mi.Vector3f(
        dr.fma(a.y, b.z, -(a.z * b.y)),
        dr.fma(a.z, b.x, -(a.x * b.z)),
        dr.fma(a.x, b.y, -(a.y * b.x)),
    )
