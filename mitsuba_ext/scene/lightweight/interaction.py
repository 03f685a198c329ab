"""The surface interaction at a triangle outside Mitsuba's scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Triangle:
    """A triangle in world space, with the same data as in Mitsuba's meshes.

    Attributes:
        corners: The three corners.
        normals: Shading normals at the corners, not zero; ``None`` if the triangle is flat.
        uv: Texture coordinates at the corners; ``None`` if they are barycentric.
        is_flipped: Whether normals point to the other side.
    """

    corners: Sequence[mi.Point3f]
    normals: Sequence[mi.Normal3f] | None = None
    uv: Sequence[mi.Point2f] | None = None
    is_flipped: bool = False


def surface_interaction(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, triangle: Triangle
) -> mi.SurfaceInteraction3f:
    """The interaction at ``pi``, whose barycentric coordinates and shape are used; the same as for
    a triangle of Mitsuba."""
    a, b, c = triangle.corners
    weights = (1 - pi.prim_uv.x - pi.prim_uv.y, pi.prim_uv.x, pi.prim_uv.y)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(pi.t))
    si.t, si.time, si.wavelengths = pi.t, ray.time, ray.wavelengths
    si.p = _mix(weights, triangle.corners)
    si.n = mi.Normal3f(dr.normalize(dr.cross(b - a, c - a)))
    si.uv, si.dp_du, si.dp_dv = pi.prim_uv, b - a, c - a
    if triangle.uv is not None:
        si.uv = _mix(weights, triangle.uv)
        si.dp_du, si.dp_dv = _derivatives(triangle, si.n)
    si.sh_frame.n = si.n
    if triangle.normals is not None:
        n0, n1, n2 = triangle.normals
        n = mi.Vector3f(_mix(weights, triangle.normals))
        scale = dr.rsqrt(dr.squared_norm(n))
        n *= scale
        si.sh_frame.n = mi.Normal3f(n)
        # Derivatives of the normalized normal along the edges from the first corner
        du, dv = mi.Vector3f(n1 - n0) * scale, mi.Vector3f(n2 - n0) * scale
        si.dn_du, si.dn_dv = du - n * dr.dot(n, du), dv - n * dr.dot(n, dv)
    if triangle.is_flipped:
        si.n, si.sh_frame.n = -si.n, -si.sh_frame.n
    si.shape, si.prim_index = pi.shape, pi.prim_index
    si.initialize_sh_frame()
    si.wi = dr.select(pi.valid, si.to_local(-ray.d), -ray.d)
    return si


def _mix(weights, values):
    (u, v, w), (a, b, c) = weights, values
    return type(a)(dr.fma(a, u, dr.fma(b, v, c * w)))


def _derivatives(triangle: Triangle, n: mi.Normal3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The derivatives of the position with respect to the texture coordinates; any tangents where
    these are degenerate."""
    (a, b, c), (uv_a, uv_b, uv_c) = triangle.corners, triangle.uv
    ab, ac, duv_b, duv_c = b - a, c - a, uv_b - uv_a, uv_c - uv_a
    area = dr.fma(duv_b.x, duv_c.y, -(duv_b.y * duv_c.x))
    s, t = mi.coordinate_system(n)
    dp_du = (duv_c.y * ab - duv_b.y * ac) / area
    dp_dv = (duv_b.x * ac - duv_c.x * ab) / area
    return dr.select(area != 0, dp_du, s), dr.select(area != 0, dp_dv, t)
