"""What the walk asks of a shape whose triangles are not in Mitsuba's scene."""

from __future__ import annotations

import mitsuba as mi

from .traversal import Hit


class Lightweight:
    """The geometry of a shape.

    Attributes:
        shape (mi.Shape): The shape that surface interactions have.
        has_interactions (bool): Does :meth:`interaction` compute them? If not, ``shape`` does.
    """

    shape: mi.Shape
    has_interactions: bool

    def closest(self, ray: mi.Ray3f, active: mi.Bool) -> Hit:
        """The closest hit of each ray before ``ray.maxt``."""
        raise NotImplementedError

    def occluded(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Is there any hit before ``ray.maxt``?"""
        raise NotImplementedError

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction of an intersection with ``shape``."""
        raise NotImplementedError
