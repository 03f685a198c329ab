"""Connecting points of the scene to the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...scene.movers import is_moving_camera, point_at_rest, sensor_at_rest, viewing_axis
from ...transport.path_decisions import SceneQuery

#: The sensors of Mitsuba to which a point can be connected.
_CONNECTABLE = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")


@dataclass
class SensorConnection:
    """A connection of a point of the scene to the sensor.

    Attributes:
        d, dist: Direction to the point of the aperture, and the distance.
        target: End of the shadow ray: the point of this line on the near clip plane, where camera
            rays begin.
        position: Position on the film: pixels in the crop window, plus the window's offset.
        importance: Density with which the sensor, from this point of the aperture, would send a
            camera ray here, per area across the ray; it integrates to 1 over the crop window. It
            is the factor of flux per solid angle.
        reach: The length of the camera ray, which ends at the far clip plane.
        active: Points that are seen unless they are occluded.
    """

    d: mi.Vector3f
    dist: mi.Float
    target: mi.Point3f
    position: mi.Point2f
    importance: mi.Float
    reach: mi.Float
    active: mi.Bool

    def direction_sample(self) -> mi.DirectionSample3f:
        """What a shadow ray needs."""
        ds = dr.zeros(mi.DirectionSample3f, dr.width(self.dist))
        ds.p, ds.d, ds.dist = self.target, self.d, self.dist
        return ds


class UniformLens:
    """Chooses points of the aperture uniformly."""

    def sample(
        self, sample: mi.Point2f, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float | float]:
        """The random numbers that choose a point of the aperture for a connection to ``si`` (in the
        frame in which the sensor rests), and the weight of the connection (1 / density of these
        numbers)."""
        return sample, 1.0


class ConnectableSensor:
    """A ``perspective`` or ``thinlens``, to which points of the scene can be connected.

    Mitsuba's ``sample_direction`` is used for positions only. Its importance is 0 on a part of the
    film of a ``perspective`` with a shifted principal point, and it returns points behind a
    ``thinlens``.

    Parameters:
        sensor: A sensor for which :meth:`can_connect` is true.
        lens: Chooses the points of the aperture.

    Attributes:
        is_parallel: Whether all camera rays have the same direction. The density of a camera ray
            does not depend on the distance then.
    """

    is_parallel = False

    def __init__(self, sensor: mi.Sensor, lens: UniformLens | None = None) -> None:
        self._lens = lens or UniformLens()
        parameters = self._read(sensor)
        film = sensor.film()
        width, height = (int(n) for n in film.size())
        crop_width, crop_height = (int(n) for n in film.crop_size())
        angle = float(dr.slice(parameters["x_fov"]))
        crop = crop_width * crop_height / (width * height)
        #: Area of the crop window's image at the distance 1
        area = (2 * math.tan(math.radians(angle) / 2)) ** 2 * height / width * crop
        self._inverse_area = dr.opaque(mi.Float, 1 / area)

    def _read(self, sensor: mi.Sensor) -> mi.SceneParameters:
        """Reads what sensors have in common."""
        # By parameters, not by methods of the class: Mitsuba's integrators that nest ours pass the
        # sensor as a plain ``mi.Sensor``
        parameters, film = mi.traverse(sensor), sensor.film()
        self._sensor = sensor
        self._size = dr.opaque(mi.Vector2f, [int(n) for n in film.crop_size()])
        self._offset = mi.Vector2f(mi.ScalarVector2f(film.crop_offset()))
        self._near = dr.opaque(mi.Float, parameters["near_clip"])
        self._far = dr.opaque(mi.Float, parameters["far_clip"])
        return parameters

    @staticmethod
    def can_connect(sensor: mi.Sensor) -> bool:
        """Whether points of the scene can be connected to this sensor."""
        return sensor_at_rest(sensor).class_name() in _CONNECTABLE

    @property
    def needs_aperture_sample(self) -> bool:
        return self._sensor.needs_aperture_sample()

    def connect(
        self,
        si: mi.SurfaceInteraction3f,
        sample: mi.Point2f,
        active: mi.Bool,
        clips_far: bool = True,
    ) -> tuple[SensorConnection, mi.Float | float]:
        """Connects ``si`` to a point of the aperture, which ``sample`` chooses.

        Parameters:
            clips_far: Whether points behind the far clip plane are not seen. In scenes with media,
                camera rays pass index-matched surfaces, and have no end behind the first of them.

        Returns:
            The connection, and its weight (1 unless the lens prefers some points).
        """
        sample, weight = self._lens.sample(sample, self._at_rest(si), active)
        ds, _importance = self._sensor.sample_direction(si, sample, active)
        cosine = -dr.dot(ds.d, ds.n)
        depth = cosine * ds.dist
        inside = dr.all((ds.uv >= 0) & (ds.uv < self._size))
        # A negative density marks points behind a thin lens; a ``perspective`` gives the density 0
        # to points behind the far clip plane
        marks_behind = clips_far or self.needs_aperture_sample
        active = active & (ds.pdf > 0) if marks_behind else active
        active = active & inside & (depth > self._near)
        if clips_far:
            active &= depth < self._far
        pdf = self._inverse_area * dr.rcp(dr.select(active, cosine, 1) ** 3)
        return SensorConnection(
            ds.d, ds.dist, ds.p - ds.d * (self._near / dr.select(active, cosine, 1)),
            ds.uv + self._offset, dr.select(active, pdf / dr.square(ds.dist), 0),
            (self._far - self._near) / dr.select(active, cosine, 1), active,
        ), weight  # fmt: skip

    def origin(self, ray: mi.Ray3f) -> tuple[mi.Point3f, mi.Float]:
        """The point of the aperture from which a camera ray comes (the ray itself begins at the
        near clip plane), and the density of the ray: per solid angle, and if rays are parallel, per
        area across the ray. It integrates to 1 over the crop window."""
        axis = viewing_axis(self._sensor, ray.time)
        inverse = dr.rcp(dr.maximum(dr.dot(ray.d, axis), 1e-6))
        return ray.o - ray.d * (self._near * inverse), self._inverse_area * inverse**3

    def _at_rest(self, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """The interaction with its point in the frame in which a moving camera rests."""
        if not is_moving_camera(self._sensor):
            return si
        moved = mi.SurfaceInteraction3f(si)
        moved.p = point_at_rest(self._sensor, si.p, si.time)
        return moved


def is_occluded(
    query: SceneQuery,
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    connection: SensorConnection,
    active: mi.Bool,
    hides_emitters: bool = False,
) -> mi.Bool:
    """Whether the connection of ``si`` to the sensor is occluded. With ``hides_emitters``, area
    lights do not occlude."""
    ds = connection.direction_sample()
    if not hides_emitters:
        return query.occluded(scene, si, ds, active)
    return _is_occluded_by_others(query, scene, query.shadow_ray(scene, si, ds), ds.p, active)


@dr.syntax
def _is_occluded_by_others(query, scene, ray, target, active) -> mi.Bool:
    ray = mi.Ray3f(ray)
    occluded = mi.Bool(False)
    active = mi.Bool(active)
    while active:
        pi = query.closest(scene, ray, coherent=False, active=active)
        active &= pi.is_valid()
        passes = active & (pi.shape.emitter() != None)  # noqa: E711
        occluded |= active & ~passes
        ray = query.starts.towards(query.interaction(pi, ray), target)
        active = passes
    return occluded
