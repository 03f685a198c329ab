"""Camera rays that pass through area lights (``hide_emitters``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .path_decisions import SceneQuery


@dr.syntax
def behind_emitters(
    query: SceneQuery,
    scene: mi.Scene,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    active: mi.Bool,
) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
    """The first surface behind the area lights that a camera ray meets, and the ray from the last
    of these lights, to which that intersection belongs."""
    ray = mi.Ray3f(ray)
    on_emitter = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    while on_emitter:
        ray = query.starts.along(query.interaction(pi, ray), ray.d)
        pi = query.closest(scene, ray, coherent=True, active=on_emitter)
        on_emitter &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return ray, pi
