"""Finds the shapes of a scene whose triangles Mitsuba does not intersect."""

from __future__ import annotations

import mitsuba as mi

from .lightweight.geometry import Lightweight


def lightweight_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The lightweight shapes of ``scene``. Their geometry is the attribute ``lightweight``."""
    return [s for s in scene.shapes() if isinstance(getattr(s, "lightweight", None), Lightweight)]


def surface(shape: mi.Shape) -> mi.Shape:
    """The shape with the triangles of ``shape``: the nested mesh of a lightweight one, if it keeps
    it, or ``shape`` itself."""
    return getattr(getattr(shape, "lightweight", None), "surface", None) or shape
