"""Light paths are stored in rounds and joined into one list."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.bidirectional_programs import LightSums
from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.light_vertices import (
    LightVertices,
    PackedVertices,
    VertexCache,
)
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums
from mitsuba_ext.transport.path_decisions import EmitterSampling
from tests.support.statistical import load, one_thread

pytestmark = pytest.mark.usefixtures("variant")

LANES, DEPTH = 1000, 7


def _rounds(scene: mi.Scene, stride: int) -> list[LightVertices]:
    """The same paths, with ``stride`` vertices stored at a time."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, LANES)
    walk = LightWalk(LightEmission(scene), DEPTH, 100, LightSums(PartialSums(), EmitterSampling()))
    paths = walk.begin(scene, sampler, mi.Float(0), mi.Color0f(), mi.Bool(True))
    rounds = []
    while dr.any(paths.active)[0]:
        vertices, paths = walk.advance(scene, sampler, paths, stride)
        rounds.append(vertices)
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
        expected = VertexCache(whole, LANES)
        parts = _rounds(scene, 2)
        assert len(parts) > 2
        # Joined at once, or each round by itself first
        for rounds in (parts, [PackedVertices(part) for part in _rounds(scene, 2)]):
            joined = VertexCache(rounds, LANES)
            assert joined.count == expected.count
            for a, b in zip(_words(joined), _words(expected)):
                np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(joined.first.numpy(), expected.first.numpy())


def test_vertices_of_a_path_follow_each_other() -> None:
    cache = VertexCache(_rounds(load("cornell_box"), 3), LANES)
    *_, depth, lane = _words(cache)
    first, number = cache.first.numpy(), cache.number.numpy()
    assert number.sum() == cache.count and number.max() <= DEPTH - 1
    np.testing.assert_array_equal(lane, np.repeat(np.arange(LANES), number))
    within = np.arange(cache.count) - first[lane]
    # Every surface of this scene is rough: no vertex is left out
    np.testing.assert_array_equal(depth, within + 1)
