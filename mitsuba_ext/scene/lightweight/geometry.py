"""What the walk asks of a shape whose triangles are not in Mitsuba's scene."""

from __future__ import annotations

import mitsuba as mi


class Lightweight:
    """The geometry of a lightweight shape, which does not refer to that shape: they would keep each
    other alive.

    Attributes:
        surface (mi.Shape | None): The shape of surface interactions, which computes them. ``None``
            if they are computed by :meth:`interaction`; they then have the lightweight shape.
    """

    surface: mi.Shape | None = None

    def closest(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32, mi.Point2f]:
        """The closest hit of each ray before ``ray.maxt``: distance, triangle (``NONE`` if there is
        no hit), and barycentric coordinates of the second and third corner."""
        raise NotImplementedError

    def occluded(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Is there any hit before ``ray.maxt``?"""
        raise NotImplementedError

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction of an intersection with the lightweight shape."""
        raise NotImplementedError
