"""The depths that a lens sees: where rays through points of its aperture first hit a surface."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..scene.movers import point_at_rest, sensor_at_rest, viewing_axis
from .path_decisions import SceneQuery

#: The largest number of surfaces that a ray may pass through; the next one stops it.
_MOST_PASSED = 16

#: The number that chooses the centre of the aperture, and of the range of wavelengths.
_MIDDLE = 0.5

#: Returns whether a ray passes through a surface. Called with the interaction, the side on which
#: the ray arrives (1 or -1), and a mask.
Passes = Callable[..., "mi.Bool"]


class LensView:
    """The surfaces that a sensor's rays hit first, and their depths: distances along the axis, from
    the centre of the lens.

    Parameters:
        scene: The scene.
        sensor: A ``thinlens``, or a ``perspective``, whose rays begin in the middle. It may move:
            depths are measured in the frame in which it rests.
        query: How rays intersect the scene.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery) -> None:
        self._scene, self._sensor, self._query = scene, sensor, query
        rest = sensor_at_rest(sensor)
        self.axis = viewing_axis(rest, mi.Float(0))
        self._middle = mi.Transform4f(rest.world_transform()) @ mi.Point3f(0)
        dr.make_opaque(self.axis, self._middle)

    def ray(
        self, position: mi.Point2f, aperture: mi.Point2f | float, time: mi.Float
    ) -> mi.Ray3f:
        """The ray through a position on the film, in units of its size, and the point of the
        aperture that two numbers choose (0.5: its centre)."""
        return self._sensor.sample_ray(time, _MIDDLE, position, mi.Point2f(aperture))[0]

    def depth(self, p: mi.Point3f) -> mi.Float:
        """The depth of a point of the frame in which the sensor rests."""
        return dr.dot(p - self._middle, self.axis)

    def inverse_depth(self, p: mi.Point3f, active: mi.Bool) -> mi.Float:
        """1 / :meth:`depth`; 0 behind the lens, and where not ``active``: the value of the sky."""
        depth = self.depth(p)
        active = active & (depth > 0)
        return dr.select(active, dr.rcp(dr.select(active, depth, 1)), 0)

    def meet(self, ray: mi.Ray3f, active: mi.Bool = True) -> tuple[mi.Point3f, mi.Float]:
        """The point that a ray hits first, in the frame in which the sensor rests, and its inverse
        depth: 0 where the ray hits nothing."""
        pi = self.closest(ray, active)
        is_hit = pi.is_valid()
        p = point_at_rest(self._sensor, ray(dr.select(is_hit, pi.t, 0)), ray.time)
        return p, self.inverse_depth(p, is_hit)

    def closest(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """The first intersection of a ray."""
        return self._query.closest(self._scene, ray, coherent=True, active=mi.Bool(active))

    def surface(self, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The full surface interaction at the first intersection of a ray."""
        return self._query.interaction(self.closest(ray, active), ray)

    def onward(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Ray3f:
        """The continuation of ``ray`` behind the surface that it has hit, in the same direction."""
        return self._query.starts.along(si, ray.d)

    def surface_behind(
        self, ray: mi.Ray3f, passes: Passes, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """The first surface that stops a ray, and the side on which the ray arrives there."""
        return _walk(self, mi.Ray3f(ray), passes, active)


@dr.syntax
def _walk(view, ray, passes, active):
    si, side = dr.zeros(mi.SurfaceInteraction3f), mi.Float(0)
    steps, going = mi.UInt32(0), mi.Bool(active)
    while going:
        si = view.surface(ray, going)
        side = dr.sign(dr.dot(si.n, ray.d))
        going &= si.is_valid() & passes(si, side, going) & (steps < _MOST_PASSED)
        steps += 1
        ray = dr.select(going, view.onward(si, ray), ray)
    return si, side
