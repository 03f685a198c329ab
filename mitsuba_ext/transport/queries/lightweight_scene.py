"""Ray intersection in a scene with shapes whose triangles Mitsuba does not know."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...scene.lightweight.geometry import Lightweight
from ...scene.lightweight.traversal import NONE
from ..scene_query import SceneQuery
from .box import Box


class _Part(NamedTuple):
    """A lightweight shape."""

    geometry: Lightweight
    surface: mi.ShapePtr
    box: Box


class LightweightQuery(SceneQuery):
    """Intersects rays with a scene, and then with each lightweight shape.

    Parameters:
        rest: How rays intersect the rest of the scene.
        shapes: The lightweight shapes.

    Attributes:
        rest (SceneQuery): How rays intersect the rest of the scene.
    """

    def __init__(self, rest: SceneQuery, shapes: Sequence[mi.Shape]) -> None:
        super().__init__(rest.starts)
        self.rest = rest
        self._parts = [
            _Part(
                shape.lightweight, mi.ShapePtr(shape.lightweight.surface or shape),
                Box(shape.bbox()),
            )
            for shape in shapes
        ]  # fmt: skip

    def closest(self, scene, ray, coherent, active):
        pi = self.rest.closest(scene, ray, coherent, active)
        ray = mi.Ray3f(ray)
        for part in self._parts:
            # Shapes behind the closest hit so far cannot be hit
            ray.maxt = dr.select(pi.valid, pi.t, ray.maxt)
            pi = dr.if_stmt(
                (pi, ray),
                active & part.box.is_met(ray),
                functools.partial(_closer, part),
                lambda pi, _ray: pi,
                label="lightweight",
            )
        return pi

    def interaction(self, pi, ray):
        parts = [part for part in self._parts if part.geometry.surface is None]
        if not parts:
            return self.rest.interaction(pi, ray)
        mine = [pi.valid & (pi.shape == part.surface) for part in parts]
        # Mitsuba's shapes compute all others
        rest = mi.PreliminaryIntersection3f(pi)
        for is_mine in mine:
            rest.t = dr.select(is_mine, dr.inf, rest.t)
        rest.valid = rest.t < dr.inf
        si = self.rest.interaction(rest, ray)
        for part, is_mine in zip(parts, mine):
            si = dr.if_stmt(
                (si, pi, ray),
                is_mine,
                lambda _si, pi, ray, part=part: part.geometry.interaction(pi, ray),
                lambda si, _pi, _ray: si,
                label="lightweight",
            )
        return si

    def emitter(self, si, emitter):
        return self.rest.emitter(si, emitter)

    def occluded(self, scene, si, ds, active):
        ray = self.shadow_ray(scene, si, ds)
        occluded = self.rest.occluded(scene, si, ds, active)
        for part in self._parts:
            occluded = dr.if_stmt(
                (occluded, ray),
                active & ~occluded & part.box.is_met(ray),
                functools.partial(_blocks, part),
                lambda occluded, _ray: occluded,
                label="lightweight",
            )
        return occluded

    def is_lightweight(self, pi: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Whether a ray has hit a lightweight shape."""
        is_mine = mi.Bool(False)
        for part in self._parts:
            is_mine |= pi.valid & (pi.shape == part.surface)
        return is_mine


def _closer(
    part: _Part, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
) -> mi.PreliminaryIntersection3f:
    t, triangle, uv = part.geometry.closest(ray, mi.Bool(True))
    is_hit = triangle != NONE
    found = dr.zeros(mi.PreliminaryIntersection3f, dr.width(t))
    found.t, found.prim_index, found.prim_uv = t, triangle, uv
    found.shape, found.valid = part.surface, is_hit
    return dr.select(is_hit, found, pi)


def _blocks(part: _Part, _occluded: mi.Bool, ray: mi.Ray3f) -> mi.Bool:
    return part.geometry.occluded(ray, mi.Bool(True))
