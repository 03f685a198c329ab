"""Portals: openings that a scene marks, through which a room is lit."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

#: The maximum cosine of the angle between adjacent edges of a portal.
_RIGHT_ANGLE = 1e-3


@dataclass(frozen=True)
class Portal:
    """A rectangular opening. All vectors have unit length.

    Attributes:
        center: Its centre.
        x, y: The directions of its edges.
        half_width, half_height: Half the length of its edges.
    """

    center: np.ndarray
    x: np.ndarray
    y: np.ndarray
    half_width: float
    half_height: float

    @property
    def outwards(self) -> np.ndarray:
        """The normal that points out of the room."""
        return -np.cross(self.x, self.y)

    @property
    def corners(self) -> np.ndarray:
        """Its corners, shape [4, 3]."""
        x, y = self.half_width * self.x, self.half_height * self.y
        return self.center + np.array([-x - y, x - y, x + y, y - x])

    @classmethod
    def of_matrix(cls, matrix: np.ndarray) -> Portal:
        """The square from (−1, −1) to (1, 1) in the plane z = 0, transformed by ``matrix``; its z
        axis points into the room.

        Raises:
            ValueError: The result is not a rectangle.
        """
        if not np.isfinite(matrix).all() or (matrix[3] != (0, 0, 0, 1)).any():
            raise ValueError("it must be an affine transform of finite numbers")
        x, y = matrix[:3, 0], matrix[:3, 1]
        width, height = np.linalg.norm(x), np.linalg.norm(y)
        if width == 0 or height == 0:
            raise ValueError("the square that it transforms must keep an area")
        x, y = x / width, y / height
        if abs(x @ y) > _RIGHT_ANGLE:
            raise ValueError("the square that it transforms must become a rectangle")
        y -= (x @ y) * x
        if matrix[:3, 2] @ np.cross(x, y) < 0:  # mirrored: the room is still where z points
            x = -x
        return cls(matrix[:3, 3], x, y / np.linalg.norm(y), width, height)


def portals(scene: mi.Scene) -> list[Portal]:
    """The portals of a scene."""
    found = (getattr(shape, "portal", None) for shape in scene.shapes())
    return [portal for portal in found if isinstance(portal, Portal)]
