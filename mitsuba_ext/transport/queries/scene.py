"""How the walk intersects rays with everything in a scene."""

from __future__ import annotations

import mitsuba as mi

from ...scene.lightweight_shapes import lightweight_shapes
from ...scene.media import may_be_chromatic
from ...scene.movers import movers
from ..scene_query import SceneQuery, ray_starts
from .lightweight_scene import LightweightQuery
from .moving_scene import MovingSceneQuery


def scene_query(scene: mi.Scene) -> SceneQuery:
    """The query that finds all shapes of ``scene``; the default one if Mitsuba knows them all.

    Raises:
        ValueError: A shape belongs to two movers, or to one and to the static scene.
        NotImplementedError: Something moves, in a ``cuda_*`` variant.
    """
    starts = ray_starts(scene)
    moving, lightweight = movers(scene), lightweight_shapes(scene)
    if moving and "cuda" in mi.variant():
        # Dr.Jit would leave out all rays but those in one of the acceleration structures
        raise NotImplementedError(
            '"moving" needs an llvm_* variant: on a GPU, Dr.Jit traces the rays of a kernel in one '
            "scene only, and shapes that move are scenes of their own"
        )
    query = MovingSceneQuery(scene, moving, starts) if moving else SceneQuery(starts)
    query = LightweightQuery(query, lightweight) if lightweight else query
    query.has_chromatic_media = may_be_chromatic(scene)
    return query
