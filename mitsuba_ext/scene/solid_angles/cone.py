"""The cone that a sphere subtends at a point outside it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Cone:
    """The directions towards a sphere.

    Attributes:
        axis: Unit vector to the centre.
        distance: Distance to the centre.
        radius: Radius of the sphere, less than the distance.
        depth: 1 - cosine of the angle between the axis and the side of the cone.
    """

    axis: mi.Vector3f
    distance: mi.Float
    radius: mi.Float
    depth: mi.Float

    @property
    def solid_angle(self) -> mi.Float:
        return dr.two_pi * self.depth

    def sample(self, sample: mi.Point2f) -> mi.Vector3f:
        """Samples a direction uniformly in the cone. Returns the unit vector from the centre of the
        sphere to the point seen in this direction. The concentric map of the disk makes it
        continuous."""
        disk = mi.warp.square_to_uniform_disk_concentric(sample)
        # 1 - cos θ is uniform; sin²θ = (1 - cos θ) (1 + cos θ) is exact for small cones
        r_2 = dr.minimum(dr.squared_norm(disk), 1)
        versine = r_2 * self.depth
        sine_2 = versine * (2 - versine)
        # Law of cosines, in units of the radius: the ray meets the sphere at two distances whose
        # product is ratio² - 1; the nearer one is this product divided by the other
        ratio = self.distance / self.radius
        half_chord = dr.safe_sqrt(1 - sine_2 * dr.square(ratio))
        gap = self.distance - self.radius
        product = gap * (self.distance + self.radius) / dr.square(self.radius)
        far = dr.maximum(ratio * (1 - versine) + half_chord, 1e-37)
        across = dr.minimum(product / far * dr.sqrt(sine_2), 1)
        along = sine_2 * ratio + (1 - versine) * half_chord
        # The azimuth of the disk's point; at the centre of the disk, it is undefined
        r = dr.sqrt(r_2)
        x, y = (dr.select(r > 0, v / r, 0) for v in disk)
        return -mi.Frame3f(self.axis).to_world(mi.Vector3f(-x * across, -y * across, along))


def cone(centre: mi.Vector3f, radius: mi.Float) -> Cone:
    """The cone of the sphere with this centre, seen from the origin, which is not inside."""
    distance = dr.maximum(dr.norm(centre), dr.maximum(radius, 1e-37))
    sine_2 = dr.square(radius / distance)
    # (d - r)(d + r) / d² is exact near the sphere, where 1 - sin² is not
    cosine = dr.sqrt((distance - radius) * (distance + radius)) / distance
    return Cone(centre / distance, distance, radius, sine_2 / (1 + cosine))
