"""Spherical triangles: their solid angle, and an area-preserving map from the unit square.

The map is from J. Arvo, *Stratified Sampling of Spherical Triangles*, 1995 (course, 4.3), in the
form of C. Peters, *BRDF Importance Sampling for Polygonal Lights*, 2021, which needs no angles of
the triangle. Instead of subtracting almost equal numbers as in these papers, differences are
computed from the edges of the triangle. The map is therefore exact for tiny and distant triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: The minimum of divisors: larger than 0, and smaller than all divisors of valid triangles.
_TINY = 1e-37


@dataclass
class SphericalTriangle:
    """A flat triangle, seen from the origin. Its lengths are in units of the distance to its
    farthest corner.

    Attributes:
        a, b, c: Its corners.
        ba, ac: Its edges b → a and a → c. They are stored because the difference of two corners is
            inexact if the triangle is small and distant.
        lengths: Distances of the three corners.
        volume: Determinant of the directions to the corners, not negative.
        denominator: 1 + the sum of the cosines between the three directions.
        half_angle: Half of its solid angle.
    """

    a: mi.Vector3f
    b: mi.Vector3f
    c: mi.Vector3f
    ba: mi.Vector3f
    ac: mi.Vector3f
    lengths: mi.Vector3f
    volume: mi.Float
    denominator: mi.Float
    half_angle: mi.Float

    @property
    def solid_angle(self) -> mi.Float:
        return 2 * self.half_angle

    def sample(self, sample: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Samples a point of the triangle, uniformly by solid angle. Returns the weights of the
        corners a and c (b has the rest). ``sample.x`` chooses an arc from b to a point
        between a and c, ``sample.y`` a point of this arc."""
        a, b, c = (v / length for v, length in zip((self.a, self.b, self.c), self.lengths))
        # ----- The point n between a and c: (a, b, n) has a fraction x of the solid angle -----
        # The vector between a and n is o = a·(rest + turned) + c·turned (Peters, Alg. 2). With
        # volume = r sin(Ω/2) and denominator = r cos(Ω/2), all numbers below are sums of positive
        # terms
        r = dr.hypot(self.volume, self.denominator)
        rest = r * dr.sin((1 - sample.x) * self.half_angle)
        turned = _one_plus_cosine(a, b) * dr.sin(sample.x * self.half_angle)
        one_plus_ac = _one_plus_cosine(a, c)
        o_a = rest + turned
        squared_norm = dr.square(rest) + 2 * turned * o_a * one_plus_ac
        scale = dr.rcp(dr.maximum(squared_norm, _TINY))
        n_a = rest * (rest + 2 * turned) * scale
        n_c = 2 * turned * (rest + turned * one_plus_ac) * scale
        # The same point in the plane of the triangle
        from_a = n_c / self.lengths.z
        from_a /= dr.maximum(n_a / self.lengths.x + from_a, _TINY)
        from_a = dr.clip(from_a, 0, 1)
        bn = dr.fma(self.ac, from_a, self.ba)
        n = self.b + bn
        n_length = dr.norm(n)

        # ----- A point of the arc from b to n: the cosine with b is uniform in 1 … cos(b, n) -----
        cosine = dr.dot(b, n) / n_length
        sine = dr.norm(dr.cross(b, bn)) / n_length
        # 1 - cosine and 1 + cosine, one of which may be small
        small = dr.square(sine) / (1 + dr.abs(cosine))
        versine = dr.select(cosine > 0, small, 1 - cosine)
        to_opposite = dr.maximum(dr.select(cosine > 0, 1 + cosine, small), _TINY)
        y = sample.y
        t = dr.sqrt(y * (2 - y * versine) / to_opposite)
        # (1 - t) + versine · (t - y)
        on_b = (1 - y) * (2 - versine * (1 + y)) / (to_opposite * (1 + t)) + versine * (t - y)
        on_b = dr.maximum(on_b, 0) / self.lengths.y
        on_n = t / n_length
        from_b = on_n / dr.maximum(on_b + on_n, _TINY)
        return from_b * (1 - from_a), from_b * from_a


def spherical_triangle(
    a: mi.Vector3f,
    b: mi.Vector3f,
    c: mi.Vector3f,
    ba: mi.Vector3f,
    ac: mi.Vector3f,
) -> SphericalTriangle:
    """The triangle with the corners ``a``, ``b``, ``c`` as seen from the origin; see
    :class:`SphericalTriangle`."""
    # In units of the greatest distance, so that products of lengths do not over- or underflow
    unit = dr.rcp(dr.maximum(dr.maximum(dr.norm(a), dr.norm(b)), dr.maximum(dr.norm(c), _TINY)))
    a, b, c, ba, ac = (v * unit for v in (a, b, c, ba, ac))
    lengths = mi.Vector3f(dr.norm(a), dr.norm(b), dr.norm(c))
    # The distance of the plane is most exact if computed from the nearest corner
    nearest = dr.select(lengths.x < lengths.y, a, b)
    nearest = dr.select(lengths.z < dr.minimum(lengths.x, lengths.y), c, nearest)
    product = lengths.x * lengths.y * lengths.z
    volume = dr.abs(dr.dot(nearest, dr.cross(ba, ac))) / dr.maximum(product, _TINY)
    lengths = dr.maximum(lengths, _TINY)
    x, y, z = (v / length for v, length in zip((a, b, c), lengths))
    # Eq. 8 of A. Van Oosterom and J. Strackee, The Solid Angle of a Plane Triangle, 1983
    denominator = 1 + dr.dot(x, y) + dr.dot(y, z) + dr.dot(x, z)
    half_angle = dr.atan2(volume, denominator)
    return SphericalTriangle(a, b, c, ba, ac, lengths, volume, denominator, half_angle)


def _one_plus_cosine(a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """1 + the cosine between two unit vectors, exact even if they are opposite."""
    return 0.5 * dr.squared_norm(a + b)
