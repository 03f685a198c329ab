"""The elliptical cone that a disk subtends at a point.

An exactly area-preserving map needs elliptic integrals (I. Guillén et al., *Area-Preserving
Parameterizations for Spherical Ellipses*, 2017). This map has a closed form instead. The distance
from the axis of the cone is distributed exactly. The angle about the axis has a distribution that
can be inverted, and that differs from the exact one by a factor between 1 and 1.21 for all points.
The density is known, and the weights of samples are bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class EllipticalCone:
    """The directions towards a disk.

    The plane perpendicular to the axis, at distance 1, cuts the cone in an ellipse. The points of
    the ellipse are x = ``tan_x``·ρ·cos φ, y = ``tan_y``·ρ·sin φ.

    Attributes:
        frame: The axes x and y of the ellipse, and the axis of the cone.
        tan_x, tan_y: Half-axes of the ellipse; tan_x ≤ tan_y.
        radius: Radius of the disk, which is the unit of the lengths below.
        along, height: The components, in the plane of the disk (along ``side``) and perpendicular
            to it, of the vector from the origin to the point where the axis meets the disk.
        shift: Distance from the centre of the disk to this point, along ``side``.
        side: Unit vector in the plane of the disk that points away from the origin.
    """

    frame: mi.Frame3f
    tan_x: mi.Float
    tan_y: mi.Float
    radius: mi.Float
    along: mi.Float
    height: mi.Float
    shift: mi.Float
    side: mi.Vector3f

    def sample(self, sample: mi.Point2f) -> mi.Vector3f:
        """The vector from the centre of the disk to a point of it."""
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        r_2 = dr.minimum(dr.squared_norm(disk), 1)
        # ----- The angle: density ∝ 1 / (f_x cos²φ + f_y sin²φ) -----
        f_x, f_y = _f(dr.square(self.tan_x)), _f(dr.square(self.tan_y))
        # The angle of the point on the scaled circle is uniform
        cosine, sine = dr.sqrt(f_y) * disk.x, dr.sqrt(f_x) * disk.y
        length = dr.hypot(cosine, sine)
        cosine = dr.select(length > 0, cosine / length, 1)
        sine = dr.select(length > 0, sine / length, 0)
        # ----- ρ: the cosine with the axis is uniform -----
        k = dr.square(self.tan_x * cosine) + dr.square(self.tan_y * sine)
        f = _f(k)
        # 1 - cosine; the largest one is k / f = 1 - 1 / √(1 + k)
        versine = r_2 * k / f
        ρ = dr.sqrt(r_2 * (2 - versine) / f) / dr.maximum(1 - versine, dr.rsqrt(1 + k))
        x, y = self.tan_x * ρ * cosine, self.tan_y * ρ * sine
        # ----- The point where the ray hits the disk, relative to the point on the axis -----
        # Without division by the height: this is exact even for a distant disk seen edge on
        distance_2 = dr.square(self.along) + dr.square(self.height)
        to_plane = dr.maximum(self.height - x * self.along, 1e-37)
        x_disk = self.shift + x * distance_2 / to_plane
        y_disk = y * self.height * dr.sqrt(distance_2) / to_plane
        outside = dr.maximum(dr.hypot(x_disk, y_disk), 1)
        return (x_disk * self.side + y_disk * self.frame.t) * (self.radius / outside)

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        """The density, per solid angle, of the direction ``d`` in the cone under :meth:`sample`.
        The vector may have any length."""
        local = self.frame.to_local(d)
        # cos²φ and sin²φ, up to a factor
        x_2, y_2 = dr.square(local.x * self.tan_y), dr.square(local.y * self.tan_x)
        total = x_2 + y_2
        x_2 = dr.select(total > 0, x_2 / total, 1)
        y_2 = dr.select(total > 0, y_2 / total, 0)
        x_square, y_square = dr.square(self.tan_x), dr.square(self.tan_y)
        f_x, f_y = _f(x_square), _f(y_square)
        f = _f(x_square * x_2 + y_square * y_2)
        uneven = f / (f_x * x_2 + f_y * y_2)
        area = dr.maximum(self.tan_x * self.tan_y, 1e-37)
        return dr.inv_two_pi * uneven * dr.sqrt(f_x) * dr.sqrt(f_y) / area


def elliptical_cone(
    centre: mi.Vector3f, normal: mi.Vector3f, radius: mi.Float
) -> EllipticalCone:
    """The cone of the disk with this centre, unit normal and radius, seen from the origin.

    Its plane of symmetry holds the origin, the centre and the normal; it cuts the disk in the
    diameter whose ends are P and Q. The axis of the cone bisects the angle between them, and the
    ellipse follows from their distances alone.
    """
    # In units of the radius, and in the plane of symmetry: the centre lies at x along the disk, and
    # at the height h
    centre = centre / radius
    h = dr.dot(centre, normal)
    normal, h = dr.select(h < 0, -normal, normal), dr.abs(h)
    along = centre - h * normal
    x = dr.norm(along)
    side = dr.select(x > 1e-6 * h, along / x, mi.Frame3f(normal).s)
    # |P|² |Q|² = w² + 4 h². (|P| + |Q|)² - 4 = 2 (d + w) and 4 - (|P| - |Q|)² = 2 (d - w);
    # the smaller of d + w and d - w is 4 h² over the larger one
    w = (x - 1) * (x + 1) + dr.square(h)
    d = dr.sqrt(dr.square(w) + dr.square(2 * h))
    large = dr.maximum(d + dr.abs(w), 1e-37)
    small = dr.square(2 * h) / large
    plus, minus = dr.select(w > 0, large, small), dr.select(w > 0, small, large)
    plus = dr.maximum(plus, 1e-37)
    tan_x, tan_y = dr.sqrt(minus / plus), dr.sqrt(2 / plus)
    # The axis meets the disk at q from its centre, towards the origin
    q = -4 * x / (2 * plus + 4)
    axis = centre + q * side
    axis /= dr.maximum(dr.norm(axis), 1e-37)
    y = dr.cross(normal, side)
    frame = mi.Frame3f(dr.cross(y, axis), y, axis)
    return EllipticalCone(frame, tan_x, tan_y, radius, x + q, h, q, side)


def _f(k: mi.Float) -> mi.Float:
    """√(1 + k) (1 + √(1 + k)). Along a ray of the ellipse that ends at the distance √k from the
    centre, 1 - cosine of the cone reaches k / f."""
    a = dr.sqrt(1 + k)
    return a * (1 + a)
