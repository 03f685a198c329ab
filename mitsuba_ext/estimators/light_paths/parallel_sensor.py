"""Connecting points of the scene to an ``orthographic`` sensor.

All camera rays of the sensor are parallel. A point is seen from one direction alone, at one place
of the film. The sensor's importance is thus a delta distribution over directions, and uniform over
the area A of the crop window, which is measured across the rays. A camera ray meets a surface with
the density cos θ / A per area, whatever the distance.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.movers import sensor_at_rest, viewing_axis
from .sensor import ConnectableSensor, SensorConnection


class ParallelSensor(ConnectableSensor):
    """An ``orthographic`` sensor to which points of the scene can be connected.

    Parameters:
        sensor: The sensor. Its transform may scale and shear.
    """

    is_parallel = True

    def __init__(self, sensor: mi.Sensor) -> None:
        self._read(sensor)
        film = sensor.film()
        to_world = mi.Transform4f(sensor_at_rest(sensor).world_transform())
        to_film = mi.orthographic_projection(
            film.size(), film.crop_size(), film.crop_offset(), self._near, self._far
        )
        self._to_camera, self._to_film = to_world.inverse(), to_film
        #: World units per unit along the rays in the camera's frame
        self._scale = dr.norm(to_world @ mi.Vector3f(0, 0, 1))
        to_film = to_film.inverse()
        origin = to_world @ (to_film @ mi.Point3f(0))
        right = to_world @ (to_film @ mi.Point3f(1, 0, 0)) - origin
        down = to_world @ (to_film @ mi.Point3f(0, 1, 0)) - origin
        axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
        self._inverse_area = dr.rcp(dr.abs(dr.dot(dr.cross(right, down), axis)))
        dr.make_opaque(self._to_camera, self._to_film, self._scale, self._inverse_area)

    def connect(
        self,
        si: mi.SurfaceInteraction3f,
        sample: mi.Point2f,
        active: mi.Bool,
        clips_far: bool = True,
    ) -> tuple[SensorConnection, float]:
        p = self._to_camera @ self._at_rest(si).p
        # Mitsuba's rays begin at the near clip plane, and their length is not scaled
        dist = (p.z - self._near) * self._scale
        film = self._to_film @ p
        uv = mi.Point2f(film.x, film.y) * self._size
        inside = dr.all((uv >= 0) & (uv < self._size))
        reach = self._far - self._near
        active = active & inside & (dist > 0)
        if clips_far:
            active &= dist < reach
        d = -viewing_axis(self._sensor, si.time)
        importance = dr.select(active, self._inverse_area, 0)
        return SensorConnection(
            d, dist, si.p + d * dist, uv + self._offset, importance, reach, active
        ), 1.0  # fmt: skip

    def origin(self, ray: mi.Ray3f) -> tuple[mi.Point3f, mi.Float]:
        return ray.o, self._inverse_area
