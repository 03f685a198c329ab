"""The path space of a scene: the data for making and evaluating paths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....rendering.camera import CameraNumbers, Lanes, camera_rays, film_extent
from ....transport.estimator import CameraRays
from ....transport.heroes import Heroes
from ....transport.path_decisions import SceneQuery
from ...light_paths.emission import LightEmission
from ...light_paths.sensor import ConnectableSensor
from .lights import LightKinds
from .memory import Head, Place

#: The maximum distance by which a ray may miss a vertex, in units of the shortest segment that ends
#: at the vertex. A larger one would change the geometric factors of the path.
_MAX_MISS = 0.1


# Not a dataclass: Dr.Jit would treat one that a loop uses as part of the loop's state
class PathSpace:
    """Paths from the camera to a light.

    Parameters (and attributes):
        scene, sensor: The rendered scene and the sensor.
        emission: The sampler of the rays with which light paths begin.
        connectable: The sensor as an end of connections; ``None`` if scene points cannot be
            connected to it.
        query: The query that intersects rays with the scene.
        spp: Samples per pixel of the whole render, for ray differentials.
        least, most: The minimum and maximum lengths of paths, in segments.
        hides_emitters: Whether camera rays pass through area lights, and the sky is invisible.

    Attributes:
        kinds: The kinds of lights.
        heroes: Hero wavelength sampling for dispersive BSDFs.
        radius: The approximate radius of the scene.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        emission: LightEmission,
        connectable: ConnectableSensor | None,
        query: SceneQuery,
        spp: int,
        least: int,
        most: int,
        hides_emitters: bool = False,
    ) -> None:
        self.scene, self.sensor, self.emission = scene, sensor, emission
        self.connectable, self.query, self.spp = connectable, query, spp
        self.least, self.most, self.hides_emitters = least, most, hides_emitters
        self.kinds, self.heroes = LightKinds(scene), Heroes(scene)
        self.radius = emission.radius
        width, height = film_extent(sensor.film())
        self._width, self._height = width, height
        self.size = mi.ScalarVector2f(width, height)
        self._offset = mi.ScalarVector2f(sensor.film().crop_offset())

    def camera_ray(self, head: Head) -> CameraRays:
        """The camera ray of a path."""
        place = head.film * self.size
        corner = mi.Point2i(
            dr.minimum(mi.Int32(place.x), self._width - 1),
            dr.minimum(mi.Int32(place.y), self._height - 1),
        )
        numbers = CameraNumbers(
            place - mi.Point2f(corner), head.aperture, head.time, head.wavelength
        )
        pixel = mi.UInt32(corner.y * self._width + corner.x)
        lanes = Lanes(pixel, corner + mi.Point2i(self.sensor.film().crop_offset()), mi.UInt32(0))
        return camera_rays(self.sensor, lanes, numbers, self.spp)

    def on_film(
        self, p: mi.Point3f, ray: mi.Ray3f, head: Head, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Bool]:
        """The film position (as :attr:`Head.film`) of a point seen through the path's aperture
        point, and whether the point is visible unless occluded. ``ray`` is any camera ray of the
        path, for its time and wavelengths."""
        if self.connectable is None:
            return mi.Point2f(0), mi.Bool(False)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        si.p, si.time, si.wavelengths = p, ray.time, ray.wavelengths
        seen, _weight = self.connectable.connect(si, head.aperture, active)
        film = mi.Point2f((seen.position - self._offset) / self.size)
        return dr.clip(film, 0, 1 - 2.0**-24), seen.active

    def is_same(self, si: mi.SurfaceInteraction3f, p: mi.Point3f, reach: mi.Float) -> mi.Bool:
        """Whether a ray has hit the vertex at ``p``, up to rounding. A hit on a surface close in
        front of it does not count, because the densities of the path apply to the sampled vertex.

        Parameters:
            reach: The length of the shortest segment that ends at the vertex.
        """
        exact = self.query.starts.distance(p) + mi.math.RayEpsilon * si.t
        return si.is_valid() & (dr.norm(si.p - p) <= dr.minimum(exact, _MAX_MISS * reach))


def towards(p: mi.Point3f, place: Place, is_direction: mi.Bool) -> mi.Vector3f:
    """The direction from ``p`` to a vertex, which is itself a direction for a light at infinity."""
    return dr.select(is_direction, mi.Vector3f(place.p), dr.normalize(place.p - p))


def turned(d: mi.Vector3f, sample: mi.Point2f, low: float, high: float) -> mi.Vector3f:
    """A direction at an angle to ``d`` between ``low`` and ``high``. The logarithm of the angle is
    uniformly distributed. The density depends only on the angle, so the reverse perturbation has
    the same density.

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997, section 5.3; D. Cline,
    PhD thesis, 2007, Fig. 7.26.
    """
    angle = low * dr.power(high / low, sample.x)
    sin, cos = dr.sincos(angle)
    y, x = dr.sincos(dr.two_pi * sample.y)
    return mi.Frame3f(d).to_world(mi.Vector3f(sin * x, sin * y, cos))
