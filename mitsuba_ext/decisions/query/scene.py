"""How the walk intersects rays with all that a scene holds."""

from __future__ import annotations

import mitsuba as mi

from ...scene.lightweight_shapes import lightweight_shapes
from ...scene.movers import movers
from ...transport.ray_starts import ray_starts
from ...transport.scene_query import SceneQuery
from .lightweight_scene import LightweightQuery
from .moving_scene import MovingSceneQuery


def scene_query(scene: mi.Scene) -> SceneQuery:
    """The query that finds all shapes of ``scene``; the default one if Mitsuba knows them all.

    Raises:
        ValueError: A shape belongs to two movers, or to one and to the static scene.
    """
    starts = ray_starts(scene)
    moving, lightweight = movers(scene), lightweight_shapes(scene)
    query = MovingSceneQuery(scene, moving, starts) if moving else SceneQuery(starts)
    return LightweightQuery(query, lightweight) if lightweight else query
