"""The construction of light trees."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.scene.lights.tree_construction import HALVINGS, Lights, build_trees


def _lights(count: int, seed: int = 0, **changes) -> Lights:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    axis[::7] = 0
    angle = np.where(axis.any(axis=1), 0.5 * np.pi, np.pi)
    values = dict(
        center=rng.normal(size=(count, 3)), spread=np.full(count, 0.01),
        reach=np.full(count, 0.02), axis=axis, angle=angle, strength=rng.uniform(0.1, 1, count),
    )  # fmt: skip
    return Lights(**values | changes)


def _leaves(trees, node: int) -> list[int]:
    link = int(trees.link[node])
    if link & 1:
        return [link >> 1]
    first, count = link >> 6, (link >> 1 & 31) + 1
    assert (trees.parent[first : first + count] == node).all()
    return [x for child in range(first, first + count) for x in _leaves(trees, child)]


@pytest.mark.parametrize("count", [1, 2, 3, 32, 33, 1000])
def test_each_light_is_a_leaf_of_its_tree(count):
    owner = np.arange(count) % 3
    trees = build_trees(_lights(count), owner, 4)
    for set_ in range(3):
        mine = sorted(_leaves(trees, set_)) if (owner == set_).any() else []
        assert mine == np.flatnonzero(owner == set_).tolist()
    assert trees.nodes[3, 7] == 0, "the set is empty"
    link = trees.link[trees.leaf]
    np.testing.assert_array_equal(link >> 1, np.arange(count))
    assert (link & 1).all() and len(trees.nodes) == len(trees.link) == len(trees.parent)


def test_nodes_bound_their_lights():
    lights = _lights(500)
    trees = build_trees(lights)
    bits = trees.nodes.view(np.uint32) & 0xFF
    for node, words in enumerate(trees.nodes):
        mine = _leaves(trees, node)
        center, spread, axis = words[:3], words[3], words[4:7]
        distance = np.linalg.norm(lights.center[mine] - center, axis=1) + lights.reach[mine]
        assert bits[node, 3] == 0 or spread * 255 / bits[node, 3] >= distance.max() * (1 - 1e-6)
        cosine = bits[node, 7] / 127.5 - 1
        if cosine > -1:
            inner = np.arccos(np.clip(lights.axis[mine] @ axis / np.linalg.norm(axis), -1, 1))
            assert np.arccos(cosine) >= (inner + lights.angle[mine]).max()
    root = trees.nodes[0]
    assert root[7] == pytest.approx(lights.strength.sum(), rel=1e-4)
    mean = (lights.strength[:, None] * lights.center).sum(axis=0) / lights.strength.sum()
    np.testing.assert_allclose(root[:3], mean, atol=1e-5)


def test_trees_are_not_deep():
    rng = np.random.default_rng(1)
    everywhere = build_trees(_lights(10**4))
    assert everywhere.depth * HALVINGS <= 30
    # Each light is half as far as the one before; then, all are in one place
    scales = 0.5 ** np.arange(1000)[:, None] * rng.normal(size=(1, 3))
    for center in (scales, np.zeros((1000, 3))):
        assert build_trees(_lights(1000, center=center)).depth * HALVINGS <= 50


def test_a_light_takes_less_than_100_bytes():
    trees = build_trees(_lights(10**4))
    total = sum(x.nbytes for x in (trees.nodes, trees.link, trees.parent, trees.leaf))
    assert total < 100 * 10**4
