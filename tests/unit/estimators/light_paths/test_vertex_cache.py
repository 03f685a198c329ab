"""Light paths are stored in rounds and joined into one list."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths import light_walk
from mitsuba_ext.estimators.light_paths.bidirectional_programs import LightSums
from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.light_vertices import VertexCache
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums
from mitsuba_ext.transport.path_decisions import EmitterSampling
from tests.support.statistical import load, one_thread

pytestmark = pytest.mark.usefixtures("variant")

LANES, DEPTH = 1000, 7


def _rounds(scene: mi.Scene, stride: int) -> list[VertexCache]:
    """The same paths, with ``stride`` vertices stored at a time."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, LANES)
    walk = LightWalk(LightEmission(scene), DEPTH, 100, LightSums(PartialSums(), EmitterSampling()))
    active = dr.full(mi.Bool, True, LANES)
    rounds: list[VertexCache] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(light_walk, "STRIDE", stride)
        walk.run_in_rounds(scene, sampler, mi.Float(0), mi.Color0f(), active, rounds.append)
    return rounds


def _words(cache: VertexCache) -> list[np.ndarray]:
    vertex = cache.at(dr.arange(mi.UInt32, cache.count), mi.Bool(True))
    si, sums = vertex.si, vertex.history
    columns = [si.p, si.wi, si.uv, vertex.β, sums.dVCM, sums.dVC, vertex.depth, vertex.lane]
    return [column.numpy() for column in columns]


def test_a_path_has_the_same_vertices_however_many_are_stored_at_a_time() -> None:
    scene = load("cornell_box")
    with one_thread():
        whole = _rounds(scene, DEPTH)
        assert len(whole) == 1
        expected = VertexCache.joined(whole)
        parts = _rounds(scene, 2)
        assert len(parts) > 2
        joined = VertexCache.joined(parts)
        assert joined.count == expected.count
        for a, b in zip(_words(joined), _words(expected)):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(joined.number.numpy(), expected.number.numpy())
        np.testing.assert_array_equal(joined.end.numpy(), expected.end.numpy())


def test_vertices_of_a_path_follow_each_other() -> None:
    cache = VertexCache.joined(_rounds(load("cornell_box"), 3))
    *_, depth, lane = _words(cache)
    end, number = cache.end.numpy(), cache.number.numpy()
    assert number.sum() == cache.count and number.max() <= DEPTH - 1
    np.testing.assert_array_equal(lane, np.repeat(np.arange(LANES), number))
    within = np.arange(cache.count) - (end - number)[lane]
    # Every surface of this scene is rough: no vertex is left out
    np.testing.assert_array_equal(depth, within + 1)
