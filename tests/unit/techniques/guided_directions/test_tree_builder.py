"""Trees of primary samples are built: learned and expected densities, and samples to ignore."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.guided_directions.sample_trees import LEAF, SampleTrees
from mitsuba_ext.techniques.guided_directions.tree_builder import (
    DEPTH,
    Samples,
    TreeBuilder,
    cell_centre,
    cell_code,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("variant")

#: Smallest cells along each axis, what the expectation is worth in equal samples, and how many of
#: them are split.
CELLS, PRIOR, SPLIT = 16, 16, 4


def _uniform(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((2, count), dtype=np.float32)


def _samples(u, value, weight=1.0) -> Samples:
    value, weight = (np.broadcast_to(x, u.shape[1]).astype(np.float32) for x in (value, weight))
    return Samples(cell_code(mi.Point2f(u)), mi.Float(value), mi.Float(weight))


def _add(builder: TreeBuilder, samples: Samples, tree=0, count: int = 1, expected=None) -> int:
    tree = np.broadcast_to(tree, len(samples.code)).astype(np.uint32)
    return builder.add(samples, mi.UInt32(tree), count, expected)


def _learned(*data) -> TreeBuilder:
    """One tree, at node 1."""
    builder = TreeBuilder()
    assert _add(builder, _samples(*data)) == 1
    return builder


def _arrays(builder: TreeBuilder) -> list[np.ndarray]:
    return [x.numpy() for x in (builder.probability, builder.child, builder.is_even)]


def _table(builder: TreeBuilder, root: int = 1) -> np.ndarray:
    """The density of a tree in the smallest cells, [x, y]."""
    probability, child, is_even = _arrays(builder)

    def table(node: int, axis: int, shape: tuple[int, int]) -> np.ndarray:
        p = float(probability[node])
        if p == LEAF:
            return np.ones(shape)
        assert is_even[node] == (axis == 0) and 0 < p < 1
        half = tuple(n // 2 if a == axis else n for a, n in enumerate(shape))
        halves = (table(child[node] + side, 1 - axis, half) for side in range(2))
        return np.concatenate([2 * q * t for q, t in zip((p, 1 - p), halves)], axis=axis)

    return table(root, 0, (CELLS, CELLS))


def _is_uniform(builder: TreeBuilder, root: int = 1) -> bool:
    return float(builder.probability[root]) == LEAF


# ---- Cells ----


def test_codes_and_centres_of_cells_are_inverse():
    code = dr.arange(mi.UInt32, 1 << DEPTH)
    assert bool(dr.all(cell_code(cell_centre(code)) == code))
    u = mi.Point2f(_uniform(1000))
    assert (np.abs((cell_centre(cell_code(u)) - u).numpy()) <= 0.5 / CELLS).all()


@pytest.mark.parametrize("u, code", [
    ((0, 0), 0), ((0.5, 0), 0b10000000), ((0, 0.5), 0b01000000), ((0.25, 0), 0b00100000),
    ((0, 0.25), 0b00010000), ((0, 1 / CELLS), 1), ((0.5 - 2.0**-25, 0), 0b00101010),
    ((1 - 2.0**-24, 1 - 2.0**-24), 0b11111111),
])  # fmt: skip
def test_the_first_bit_of_a_code_is_the_side_of_the_first_split(u, code):
    assert int(cell_code(mi.Point2f(*u))[0]) == code


# ---- Samples without information ----


@pytest.mark.parametrize("count, value", [
    (1, 1.0), (SPLIT - 1, 1.0), (15, [0.0] * 12 + [1.0] * 3), (1000, 0.0), (1000, 1e30),
    (1000, [1.0] * 999 + [1e30]),
])  # fmt: skip
def test_few_equal_and_single_enormous_values_give_no_splits(count, value):
    assert _is_uniform(_learned(_uniform(count), value))


def test_enormous_values_among_a_million_have_little_influence():
    """Their squares must not leave the range of integers."""
    u, count = _uniform(1 << 20), 3
    u[:, :count] = 0.7
    table = _table(_learned(u, np.where(np.arange(u.shape[1]) < count, 1e30, 1)))
    # Each of the eight splits has that many equal samples
    assert table.max() <= (2 * (count + 0.5 * PRIOR) / (count + PRIOR)) ** DEPTH * 1.0001


def test_faint_differences_give_no_splits():
    u = _uniform(1 << 14)
    assert _is_uniform(_learned(u, 1 + 0.2 * u[0]))
    assert not _is_uniform(_learned(u, 0.2 + u[0]))


def test_a_split_is_kept_if_splits_below_it_are():
    """On a checkerboard, the first split alone says nothing."""
    u = _uniform(1 << 14)
    table = _table(_learned(u, (u[0] < 0.5) == (u[1] < 0.5)))
    assert table[::15, ::15] == pytest.approx(np.array([[2, 0], [0, 2]]), abs=0.05)


@pytest.mark.parametrize("count", [2 * SPLIT, 1000])
def test_samples_of_one_cell_leave_the_others_their_prior(count):
    """In each split, the expectation of equal shares is worth ``PRIOR`` equal samples."""
    cell = np.full((2, count), 0.5 / CELLS, np.float32)
    table = _table(_learned(cell, 3.0))
    p = (count + 0.5 * PRIOR) / (count + PRIOR)
    assert table[0, 0] == pytest.approx((2 * p) ** DEPTH, rel=1e-4)
    assert table[-1, -1] == pytest.approx(2 * (1 - p), rel=1e-4)
    assert table.mean() == pytest.approx(1) and table.min() > 0


# ---- What is learned ----

FUNCTIONS = {
    "ramp": lambda x, y: 0.05 + x**2 * y,
    "edge": lambda x, y: np.where(x + y < 0.7, 5.0, 0.1),
    "spot": lambda x, y: np.exp(-((x - 0.3) ** 2 + (y - 0.6) ** 2) / 0.02),
    "stripes": lambda x, y: np.where(np.floor(8 * y) % 2 == 0, 1.0, 0.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_density_approaches_the_function(name):
    u = _uniform(1 << 18)
    table = _table(_learned(u, FUNCTIONS[name](*u)))
    f = FUNCTIONS[name](*(np.indices((256, 256)) + 0.5) / 256)
    f /= f.mean()
    coarse = f.reshape(CELLS, 16, CELLS, 16).mean(axis=(1, 3))
    variances = [np.mean(f**2 / d.repeat(16, 0).repeat(16, 1)) - 1 for d in (table, 0 * table + 1)]
    assert table.mean() == pytest.approx(1)
    # Subtrees are left out that change the mean square by less than 5 %
    assert np.abs(table - coarse).mean() < np.sqrt(0.05)
    assert variances[0] < 0.1 * variances[1]


@pytest.mark.parametrize("name", ["ramp", "edge"])
def test_samples_of_another_density_give_the_same_tree_if_they_are_weighted(name):
    r = _uniform(1 << 18).astype(float)
    u = np.stack([np.sqrt(0.25 + 2 * r[0]) - 0.5, r[1]]).clip(0, 1 - 2.0**-24)
    weight = 1 / (0.5 + u[0])
    weighted = _table(_learned(u, FUNCTIONS[name](*u) * weight, weight))
    equal = _table(_learned(r, FUNCTIONS[name](*r)))
    assert np.abs(weighted - equal).mean() < 0.03


def test_shares_follow_the_means_however_dense_the_samples_are():
    """Rounded to a coarse fixed point, small weights once made means too large."""
    u = _uniform(1 << 14)
    is_left = u[0] < 0.5
    weight = np.where(is_left, 1 / 171, 1 / 256)
    builder = _learned(u, np.where(is_left, 3, 1) * weight, weight)
    assert float(builder.probability[1]) == pytest.approx(0.75, abs=2e-3)


@pytest.mark.parametrize("power", [-66, 66])
def test_the_unit_of_values_does_not_matter(power):
    u = _uniform(1 << 14)
    one, other = (_arrays(_learned(u, FUNCTIONS["spot"](*u) * 2.0**n)) for n in (0, power))
    assert all(map(np.array_equal, one, other))


def test_the_same_samples_in_another_order_give_the_same_trees():
    """Exactly; their mean in single precision once made a difference."""
    count, trees = 100_000, 500
    rng, u = np.random.default_rng(1), _uniform(count)
    value, tree = rng.lognormal(0, 1, count), rng.integers(0, trees, count)
    results = []
    for order in (np.arange(count), np.argsort(value)):
        builder = TreeBuilder()
        _add(builder, _samples(u[:, order], value[order]), tree[order], trees)
        results.append(_arrays(builder))
    assert len(results[0][0]) > 5000 and all(map(np.array_equal, *results))


# ---- Many trees ----


def test_merged_samples_give_the_same_trees():
    """In each region, the samples of a cell are merged into one."""
    count, regions = 50_000, 70
    rng, u = np.random.default_rng(4), _uniform(count)
    region = mi.UInt32(rng.integers(0, regions, count).astype(np.uint32))
    samples = _samples(u, FUNCTIONS["edge"](*u), rng.uniform(0.2, 5, count))
    merged = samples.in_order(region).merged()
    cells = {(int(r), int(c)) for r, c in zip(region.numpy(), samples.code.numpy())}
    found = zip(merged.tree.numpy().tolist(), merged.code.numpy().tolist())
    assert sorted(cells) == list(found)
    results = []
    for data, tree in ((samples, region), (merged, merged.tree)):
        builder = TreeBuilder()
        builder.add(data, tree // 10, regions // 10)
        builder.add(data, tree, regions, 1 + dr.arange(mi.UInt32, regions) // 10)
        results.append(_arrays(builder))
    assert len(results[0][0]) > 1000 and all(map(np.array_equal, *results))


def test_trees_built_together_equal_trees_built_alone():
    """Each tree uses its own samples. Samples whose number belongs to no tree are not used."""
    counts = [3000, 0, SPLIT - 1, 60, 5000]
    functions = [FUNCTIONS[name] for name in ("ramp", "edge", "spot", "spot", "stripes")]
    parts = [_uniform(count, seed) for seed, count in enumerate(counts)]
    tree = np.repeat(np.arange(len(counts)), counts)
    u = np.concatenate(parts, axis=1)
    value = np.concatenate([f(*part) for f, part in zip(functions, parts)])
    order = np.random.default_rng(2).permutation(2 * len(tree))
    # As many samples that belong to none
    u, value = np.concatenate([u, 1 - u], 1)[:, order], np.tile(value, 2)[order]
    none = np.resize([len(counts), 2**24, 2**24 + 1, 2**32 - 1], len(tree))
    tree = np.concatenate([tree, none])[order]
    builder = TreeBuilder()
    first = _add(builder, _samples(u, value), tree, len(counts))
    for index, part in enumerate(parts):
        together = _table(builder, first + index)
        assert (together == 1).all() == (counts[index] < SPLIT)
        if counts[index] > 0:
            alone = _table(_learned(part, functions[index](*part)))
            np.testing.assert_allclose(together, alone, rtol=1e-3)


def test_forests_follow_each_other():
    builder, u = TreeBuilder(), _uniform(1 << 12)
    assert builder.node_count == 1 and _is_uniform(builder, 0)
    first = _add(builder, _samples(u, u[0]))
    before = _table(builder, first)
    count = builder.node_count
    assert _add(builder, _samples(u, u[1])) == count
    np.testing.assert_array_equal(_table(builder, first), before)
    np.testing.assert_array_equal(_table(builder, count), _table(_learned(u, u[1])))


def test_samples_are_drawn_by_the_densities_that_were_learned():
    """What is built is what ``SampleTrees`` wants; leaves are the same."""
    builder, u = TreeBuilder(), _uniform(1 << 12)
    value = [f(*u) for f in FUNCTIONS.values()]
    tree, count = np.repeat(np.arange(len(value)), u.shape[1]), len(value)
    first = _add(builder, _samples(np.tile(u, count), np.concatenate(value)), tree, count)
    roots = first + dr.arange(mi.UInt32, count)
    shape, share = (builder.probability, builder.child, builder.is_even), mi.Float([1.0] * count)
    trees = SampleTrees(*shape, roots, share, dr.arange(mi.UInt32, builder.node_count))
    tree = dr.repeat(dr.arange(mi.UInt32, count), 1 << DEPTH)
    code = dr.tile(dr.arange(mi.UInt32, 1 << DEPTH), count)
    density, leaf = trees.density(tree, cell_centre(code), mi.Bool(True))
    x, y = (cell_centre(code).numpy() * CELLS).astype(int)
    tables = np.array([_table(builder, first + index) for index in range(count)])
    # Probabilities are rounded to nine bits
    np.testing.assert_allclose(density.numpy(), tables[tree.numpy(), x, y], rtol=0.1, atol=0.05)
    node = builder.leaf(dr.gather(mi.UInt32, roots, tree), code)
    assert bool(dr.all(trees.value(leaf, mi.Bool(True)) == node))
    assert bool(dr.all(dr.gather(mi.Float, builder.probability, node) == LEAF))


# ---- What is expected ----


def _with_expected(u, value, name: str = "ramp") -> tuple[np.ndarray, np.ndarray]:
    """The densities of a tree, and of the one of a function that is expected."""
    builder, many = TreeBuilder(), _uniform(1 << 16, 9)
    root, edge = (_add(builder, _samples(many, FUNCTIONS[n](*many))) for n in (name, "edge"))
    # Another tree, without a sample, is the one that is expected of it
    first = _add(builder, _samples(u, value), 1, 2, mi.UInt32([edge, root]))
    np.testing.assert_array_equal(_table(builder, first), _table(builder, edge))
    return _table(builder, first + 1), _table(builder, root)


@pytest.mark.parametrize("count", [1, SPLIT - 1])
def test_a_tree_of_too_few_samples_is_the_expected_one(count):
    table, expected = _with_expected(_uniform(count), 1.0)
    np.testing.assert_array_equal(table, expected)


def test_a_split_is_kept_if_splits_are_expected_below_it():
    table, expected = _with_expected(_uniform(SPLIT), 1.0, "stripes")
    assert expected.max() > 1.9 and np.abs(table - expected).mean() < 0.2


def test_the_expectation_counts_less_with_more_samples():
    spot, distances = FUNCTIONS["spot"], []
    for count in (40, 1 << 10, 1 << 16):
        u = _uniform(count)
        table, expected = _with_expected(u, spot(*u))
        own = _table(_learned(u, spot(*u)))
        distances.append([np.abs(table - t).mean() for t in (expected, own)])
    from_expected, from_own = np.transpose(distances)
    assert from_expected[0] < from_own[0] and (np.diff(from_expected) > 0).all()
    assert (np.diff(from_own) < 0).all() and from_own[-1] < 0.02


def test_an_expectation_is_worth_a_number_of_samples_in_each_cell():
    count = 100
    table, expected = _with_expected(np.full((2, count), 0.9, np.float32), 1.0)
    for cut in (lambda t: (t, t[8:]), lambda t: (t[8:], t[8:, 8:])):
        p, q = (half.mean() / whole.mean() / 2 for whole, half in map(cut, (table, expected)))
        assert p == pytest.approx((count + PRIOR * q) / (count + PRIOR), rel=1e-3)


def test_cells_without_samples_take_over_the_splits_expected_there():
    u = _uniform(1 << 12)
    u[0] *= 0.5
    table, expected = _with_expected(u, FUNCTIONS["spot"](*u))
    right, right_expected = (t[8:] / t[8:].mean() for t in (table, expected))
    np.testing.assert_allclose(right, right_expected, rtol=1e-4)
    assert right_expected.max() > 1.5
    left, left_expected = (t[:8] / t[:8].mean() for t in (table, expected))
    assert np.abs(left - left_expected).mean() > 0.5
