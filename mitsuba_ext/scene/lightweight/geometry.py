"""The interface of shapes whose triangles are not in Mitsuba's scene."""

from __future__ import annotations

import mitsuba as mi


class Lightweight:
    """The geometry of a lightweight shape. It holds no reference to the shape, because the two
    would keep each other alive.

    Attributes:
        surface (mi.Shape | None): The shape that computes surface interactions. ``None`` if
            :meth:`interaction` computes them; their shape is then the lightweight shape.
    """

    surface: mi.Shape | None = None

    def closest(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32, mi.Point2f]:
        """The closest hit of each ray before ``ray.maxt``: distance, triangle (``NONE`` if there is
        no hit), and barycentric coordinates of the second and third corner."""
        raise NotImplementedError

    def occluded(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Whether there is a hit before ``ray.maxt``."""
        raise NotImplementedError

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction of an intersection with the lightweight shape."""
        raise NotImplementedError
