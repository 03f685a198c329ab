"""Convex spherical polygons as fans of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .spherical_triangle import SphericalTriangle, spherical_triangle


@dataclass
class SphericalPolygon:
    """A flat convex polygon, seen from the origin.

    Attributes:
        triangles: The triangles (corner 0, corner k, corner k + 1), k = 1, 2, …
    """

    triangles: list[SphericalTriangle]

    @property
    def solid_angle(self) -> mi.Float:
        # Half angles are arguments of complex numbers. The argument of the product is their sum,
        # which takes only one arctangent
        cos, sin = self.triangles[0].denominator, self.triangles[0].volume
        for triangle in self.triangles[1:]:
            x, y = triangle.denominator, triangle.volume
            cos, sin = cos * x - sin * y, cos * y + sin * x
        angle = dr.atan2(sin, cos)
        # Near a half sphere, rounding may wrap the angle around
        return 2 * dr.select(angle < -1e-3, angle + dr.two_pi, dr.maximum(angle, 0))

    def sample(self, sample: mi.Point2f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Samples a point of the polygon, uniformly by solid angle. Returns the index k - 1 of its
        triangle, and the weights of the corners k and k + 1 (corner 0 has the rest).

        The map is continuous: ``sample.x`` moves the end of an arc from corner 0 along the other
        edges of the polygon, and ``sample.y`` moves along the arc."""
        total = self.triangles[0].half_angle
        for triangle in self.triangles[1:]:
            total = total + triangle.half_angle
        target = total * sample.x
        chosen, index, passed = self.triangles[0], mi.UInt32(0), mi.Float(0)
        before = mi.Float(0)
        for k, triangle in enumerate(self.triangles[1:], 1):
            before = before + self.triangles[k - 1].half_angle
            # A triangle without solid angle is not chosen
            is_behind = (target >= before) & (triangle.half_angle > 0)
            chosen = dr.select(is_behind, triangle, chosen)
            index, passed = dr.select(is_behind, k, index), dr.select(is_behind, before, passed)
        x = (target - passed) / dr.maximum(chosen.half_angle, 1e-37)
        weights = chosen.sample(mi.Point2f(dr.clip(x, 0, 1), sample.y))
        return index, *weights


def spherical_polygon(corners: list[mi.Vector3f], edges: list[mi.Vector3f]) -> SphericalPolygon:
    """The polygon with these corners, in their order, as seen from the origin.

    Parameters:
        corners: Three or more, in a plane.
        edges: Vectors from each corner to the next one, which must be exact even if the polygon is
            distant.
    """
    triangles, diagonal = [], edges[0]
    for k in range(1, len(corners) - 1):
        triangles.append(
            spherical_triangle(corners[k], corners[0], corners[k + 1], diagonal, edges[k])
        )
        diagonal = diagonal + edges[k]
    return SphericalPolygon(triangles)
