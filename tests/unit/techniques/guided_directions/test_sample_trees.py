"""Trees of primary samples: densities are exact, samples follow them, and strata stay strata."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.techniques.guided_directions.sample_trees import LEAF, SampleTrees
from tests.support.statistical import THRESHOLD, sidak

pytestmark = pytest.mark.usefixtures("variant")

#: Edge of the smallest cells, in as many parts; and splits from the root to one of these.
CELLS, DEPTH = 16, 8

ALMOST_ONE = np.float32(1 - 2.0**-24)


# ---- Trees as nested tuples: ``None`` is a leaf, else (probability, left, right) ----


def _hot(corner: tuple[int, int], p: float = 1.0, depth: int = DEPTH):
    """All splits lead to one corner of the square."""
    tree = None
    for level in reversed(range(depth)):
        tree = (1 - p, None, tree) if corner[level % 2] else (p, tree, None)
    return tree


def _random(rng: np.random.Generator, depth: int = DEPTH, least: float = 0.02, stop: float = 0.0):
    """Random probabilities; a cell is not split with the probability ``stop``."""
    if depth == 0 or rng.random() < stop:
        return None
    left, right = (_random(rng, depth - 1, least, stop) for _ in range(2))
    return rng.uniform(least, 1 - least), left, right


def _along(axis: int, rng: np.random.Generator, depth: int = DEPTH):
    """Splits along one axis only decide anything."""
    if depth == 0:
        return None
    p = rng.uniform(0.1, 0.9) if (DEPTH - depth) % 2 == axis else 0.5
    return p, _along(axis, rng, depth - 1), _along(axis, rng, depth - 1)


def _forest(trees: list, shares) -> tuple[SampleTrees, np.ndarray]:
    """The trees in arrays, and the value that the leaves in each smallest cell have: the number of
    their node. [tree, x, y]"""
    nodes = list(zip(trees, [0] * len(trees)))
    columns, values = [], np.zeros((len(trees), CELLS, CELLS), int)
    squares = list(values)
    for number, (tree, depth) in enumerate(nodes):  # which becomes longer
        squares[number][:] = number
        if tree is None:
            columns.append((LEAF, 0, depth % 2 == 0))
            continue
        p, *children = tree
        columns.append((p, len(nodes), depth % 2 == 0))
        nodes += [(child, depth + 1) for child in children]
        squares += np.split(squares[number], 2, axis=depth % 2)  # views of ``values``
    probability, child, is_even = zip(*columns)
    roots = np.arange(len(trees), dtype=np.uint32)
    shares = np.broadcast_to(np.asarray(shares, np.float32), len(trees)).copy()
    number = dr.arange(mi.UInt32, len(nodes))
    return SampleTrees(
        mi.Float(probability), mi.UInt32(child), mi.Bool(is_even), mi.UInt32(roots),
        mi.Float(shares), number,
    ), values  # fmt: skip


def _table(tree, axes=(0, 1), axis: int = 0, shape=(CELLS, CELLS)) -> np.ndarray:
    """The density in the smallest cells, [x, y]: the factors of the splits along ``axes``."""
    if tree is None:
        return np.ones(shape)
    p, left, right = tree
    # A packed node keeps nine bits
    p = min(np.floor(p * 512 + 0.5), 511) / 512 if axis in axes else 0.5
    half = tuple(n // 2 if a == axis else n for a, n in enumerate(shape))
    halves = (_table(child, axes, 1 - axis, half) for child in (left, right))
    return np.concatenate([2 * q * t for q, t in zip((p, 1 - p), halves)], axis=axis)


def _tables(trees: list, shares) -> np.ndarray:
    shares = np.broadcast_to(shares, len(trees))
    return np.array([1 - s + s * _table(tree) for s, tree in zip(shares, trees)])


def _uniform(lanes: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((2, lanes), dtype=np.float32)


def _cases() -> dict[str, list]:
    rng = np.random.default_rng(1)
    return {
        "leaf": [None],
        "hot first corner": [_hot((0, 0))],
        "hot last corner": [_hot((1, 1))],
        "hot mixed corner": [_hot((1, 0), p=0.97)],
        "random": [_random(rng)],
        "first axis": [_along(0, rng)],
        "second axis": [_along(1, rng)],
        "second axis on the left": [(0.3, (0.8, None, None), None)],
        "second axis on the right": [(0.3, None, (0.2, None, None))],
        "leaves at odd depths": [_random(rng, depth=5, stop=0.2)],
        "leaves at all depths": [_random(rng, stop=0.15)],
        "many": [*(_random(rng, stop=0.1) for _ in range(60)), None, _hot((0, 1)), None],
    }


CASES, SHARES = _cases(), [0.0, 0.5, 0.9, 1.0]


# ---- Samples and their density ----


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", CASES)
def test_samples_are_distributed_by_the_density(name, share):
    """A chi² test, with bins of half the edge of the smallest cells; each lane picks a tree."""
    trees, lanes, count = CASES[name], 1 << 18, len(CASES[name])
    bins = 2 * CELLS if count == 1 else CELLS
    tree = np.random.default_rng(2).integers(0, count, lanes)
    forest, _values = _forest(trees, share)
    u = mi.Point2f(_uniform(lanes))
    point, density, _leaf = forest.sample(mi.UInt32(tree.astype(np.uint32)), u, mi.Bool(True))
    x, y = (point.numpy() * CELLS).astype(int)
    tables = _tables(trees, share)
    np.testing.assert_allclose(density.numpy(), tables[tree, x, y], rtol=1e-5)

    each = tuple((point.numpy() * bins).astype(int))
    observed = np.zeros((count, bins, bins))
    np.add.at(observed, (tree, *each), 1)
    expected = tables.repeat(bins // CELLS, 1).repeat(bins // CELLS, 2)
    expected *= (np.bincount(tree, minlength=count) / bins**2)[:, None, None]
    common = expected > 10
    o, e = (np.append(a[common], a[~common].sum()) for a in (observed, expected))
    o, e = o[e > 0], e[e > 0]
    assert observed[expected == 0].sum() == 0 and len(e) > 1
    if e[-1] < 10:  # too rare for chi², if there are any
        assert stats.poisson.sf(o[-1] - 1, e[-1]) > 1e-6
        o, e = o[:-1], e[:-1]
    p_value = stats.chi2.sf(np.sum((o - e) ** 2 / e), max(len(e) - count, 1))
    assert p_value > 2 * stats.norm.sf(sidak(len(CASES) * len(SHARES)))


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", CASES)
def test_densities_agree_with_the_cells(name, share):
    """Exactly one on average, at least the share of uniform samples; leaves are told apart."""
    trees = CASES[name]
    forest, values = _forest(trees, share)
    index, x, y = np.indices((len(trees), CELLS, CELLS)).reshape(3, -1)
    tree = mi.UInt32(index.astype(np.uint32))
    u = mi.Point2f(((np.array([x, y]) + 0.5) / CELLS).astype(np.float32))
    density, leaf = forest.density(tree, u, mi.Bool(True))
    value = forest.value(leaf, mi.Bool(True)).numpy().reshape(values.shape)
    density = density.numpy().reshape(values.shape)
    np.testing.assert_allclose(density, _tables(trees, share), rtol=1e-5)
    np.testing.assert_allclose(density.mean(axis=(1, 2), dtype=float), 1, atol=1e-6)
    assert density.min() >= np.float32(1) - np.float32(share)
    # A tree that decides nothing is not looked at
    assert np.array_equal(value, values if share > 0 else index.reshape(values.shape))


@pytest.mark.parametrize("name", CASES)
def test_the_density_of_a_sample_and_its_leaf_are_found_again(name):
    lanes, count = 1 << 14, len(CASES[name])
    forest, _values = _forest(CASES[name], np.linspace(0.3, 1, count))
    tree = dr.arange(mi.UInt32, lanes) % count
    point, density, leaf = forest.sample(tree, mi.Point2f(_uniform(lanes)), mi.Bool(True))
    again, same_leaf = forest.density(tree, point, mi.Bool(True))
    assert bool(dr.all(again == density)) and bool(dr.all(leaf == same_leaf))


@pytest.mark.parametrize("share", [0.0, 0.9])
@pytest.mark.parametrize("neighbour", [None, (0.3, None, None)])
def test_a_tree_without_a_split_changes_nothing(share, neighbour):
    forest, _values = _forest([neighbour, None], [0.5, share])
    u = mi.Point2f(_uniform(1000))
    point, density, leaf = forest.sample(dr.full(mi.UInt32, 1, 1000), u, mi.Bool(True))
    assert np.array_equal(point.numpy(), u.numpy())
    assert bool(dr.all(density == 1)) and bool(dr.all(leaf == 1))


def test_a_tree_that_decides_nothing_changes_nothing():
    forest, _values = _forest([_hot((0, 0))], 0.0)
    u = mi.Point2f(_uniform(1000))
    point, density, leaf = forest.sample(dr.zeros(mi.UInt32, 1000), u, mi.Bool(True))
    assert np.array_equal(point.numpy(), u.numpy())
    assert bool(dr.all(density == 1)) and bool(dr.all(leaf == 0))


def test_inactive_lanes_keep_their_numbers():
    forest, _values = _forest([None, _hot((0, 0)), _hot((1, 1))], 0.5)
    u, tree = mi.Point2f(_uniform(1000)), dr.arange(mi.UInt32, 1000) % 3
    active = (dr.arange(mi.UInt32, 1000) & 1) == 0
    point, density, leaf = forest.sample(tree, u, active)
    again, same_leaf = forest.density(tree, u, active)
    is_off = ~active.numpy()
    assert np.array_equal(point.numpy()[:, is_off], u.numpy()[:, is_off])
    for number in (leaf, same_leaf):
        assert np.array_equal(number.numpy()[is_off], tree.numpy()[is_off])
    for x in (density, again):
        assert (x.numpy()[is_off] == 1).all()
    assert (density.numpy()[~is_off] != 1).any()


def test_two_levels_of_splits_share_a_node():
    forest, _values = _forest([_random(np.random.default_rng(3))], 0.5)
    nodes = 1 + 4 + 16 + 64 + 256
    assert forest.bytes == (8 + 4) * nodes + 4, "with the value of each, and the tree's share"


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("p", [0.0, 1e-9, 1 / 512, 0.5, 0.999, 1.0])
def test_extreme_numbers_and_probabilities_give_samples_in_the_square(p, share):
    """With rounding, the last of all numbers once gave 1, and others the next cell."""
    below_half, few = np.nextafter(np.float32(0.5), np.float32(0)), np.float32(1e-7)
    edges = np.array([0, few, share, below_half, 0.5, 1 - few, ALMOST_ONE], np.float32)
    u = mi.Point2f(np.stack(np.meshgrid(edges, edges)).reshape(2, -1).clip(0, ALMOST_ONE))
    everywhere = _random(np.random.default_rng(3))
    trees = [_hot((0, 0), p), _hot((1, 1), p), (p, None, None), (0.5, None, (p, None, None))]
    forest, _values = _forest([*trees, everywhere], share)
    for number in range(len(trees) + 1):
        tree = dr.full(mi.UInt32, number, dr.width(u))
        point, density, leaf = forest.sample(tree, u, mi.Bool(True))
        assert ((point.numpy() >= 0) & (point.numpy() < 1)).all()
        again, same_leaf = forest.density(tree, point, mi.Bool(True))
        assert np.isfinite(density.numpy()).all() and (density.numpy() > 0).all()
        assert bool(dr.all(again == density)) and bool(dr.all(leaf == same_leaf))


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_strata_remain_strata(share):
    """Jittered numbers spread over the cells far more evenly than random ones would."""
    width = 64
    strata = np.indices((width, width)).reshape(2, -1)
    u = (strata + _uniform(width**2)) / width
    tree = _random(np.random.default_rng(4), depth=4, least=0.3)
    forest, _values = _forest([tree], share)
    point = forest.sample(mi.UInt32(0), mi.Point2f(u.astype(np.float32)), mi.Bool(True))[0]
    counts = np.histogram2d(*point.numpy(), 4, [[0, 1], [0, 1]])[0]
    expected = _tables([tree], share)[0].reshape(4, 4, 4, 4).mean(axis=(1, 3)) * width**2 / 16
    assert np.mean((counts - expected) ** 2 / expected) < 0.2, "1 for random numbers"


# ---- Two bounces ----


def test_a_tree_for_each_leaf_of_the_first_bounce_gives_unbiased_paths():
    """What is brought after a bounce is divided by the densities of the bounces up to it."""
    rng, lanes = np.random.default_rng(5), 1 << 20
    first = _random(rng, depth=5, least=0.2, stop=0.2)
    nodes = _forest([first], 0.5)[1]
    below = [_random(rng, depth=5, least=0.2, stop=0.1) for _ in range(nodes.max() + 1)]
    forest_of_first, forest = _forest([first], 0.5)[0], _forest(below, 0.5)[0]
    on = mi.Bool(True)
    u1, d1, leaf = forest_of_first.sample(mi.UInt32(0), mi.Point2f(_uniform(lanes, 6)), on)
    tree = forest_of_first.value(leaf, on)
    u2, d2, _leaf = forest.sample(tree, mi.Point2f(_uniform(lanes, 7)), on)
    f1, f2 = 3 * u1.x * u1.x, 8 * u1.x * u1.y * u2.x * (u2.y + dr.select(u2.x > u1.x, 1.0, 0))
    brought = (f1 / d1 + f2 / (d1 * d2)).numpy().astype(float)
    # ∫ f1 = 1; ∫ f2 = ∫ (3 x₁ - 2 x₁³) dx₁ = 1
    error = brought.std() / np.sqrt(lanes)
    assert len(np.unique(tree.numpy())) > 10 and error < 4e-3
    assert abs(brought.mean() - 2) < THRESHOLD * error


def test_where_bounces_alternate_a_mixture_by_prefix_would_be_biased():
    """Why a bounce's splits all stand above the next one's. The axes are two bounces with one
    number each; Guo's weight for what the first brings is 1 / (1 - a + a · its splits' factors)."""
    a, f = 0.5, np.arange(CELLS)[:, None] + 0.5
    alternating = (0.7, (0.9, (0.9, None, None), None), None)
    below = (0.9, (0.2, None, None), None)
    apart = (0.7, (0.5, below, below), None)

    def mean(tree, a: float) -> float:
        """The mean of f over its integral, exactly."""
        drawn, prefix = 1 - a + a * _table(tree), 1 - a + a * _table(tree, axes=(0,))
        return np.mean(drawn * f / prefix) / f.mean()

    assert mean(apart, a) == pytest.approx(1) and mean(apart, 1.0) == pytest.approx(1)
    assert mean(alternating, 1.0) == pytest.approx(1)
    assert abs(mean(alternating, a) - 1) > 0.01
