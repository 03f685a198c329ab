"""Trees of primary samples are built: learned and expected densities, and samples to ignore."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.guided_directions.cells import DEPTH, Cells, cell_centre, cell_code
from mitsuba_ext.techniques.guided_directions.sample_trees import LEAF, SampleTrees
from mitsuba_ext.techniques.guided_directions.tree_builder import Nodes, grown

pytestmark = pytest.mark.usefixtures("variant")

#: Smallest cells along each axis, what the expectation is worth in equal samples, and how many of
#: them are split.
CELLS, PRIOR, SPLIT = 16, 16, 4


def _uniform(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((2, count), dtype=np.float32)


def _samples(u, value, weight=1.0) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    value, weight = (np.broadcast_to(x, u.shape[1]).astype(np.float32) for x in (value, weight))
    return cell_code(mi.Point2f(u)), mi.Float(value), mi.Float(weight)


def _grown(samples, tree=0, count: int = 1, prior=()) -> Nodes:
    """Trees, the first of which have a prior."""
    tree = np.broadcast_to(tree, len(samples[0])).astype(np.uint32)
    prior = np.append(prior, np.arange(len(prior), count + 1)).astype(np.uint32)
    return grown(Cells.of(*samples, mi.UInt32(tree)), mi.UInt32(prior), 2)


def _learned(*data) -> Nodes:
    """One tree."""
    return _grown(_samples(*data))


def _arrays(nodes: Nodes) -> list[np.ndarray]:
    return [x.numpy() for x in (nodes.probability, nodes.child, nodes.is_even)]


def _table(nodes: Nodes, root: int = 0) -> np.ndarray:
    """The density of a tree in the smallest cells, [x, y]."""
    probability, child, is_even = _arrays(nodes)

    def table(node: int, axis: int, shape: tuple[int, int]) -> np.ndarray:
        p = float(probability[node])
        if p == LEAF:
            return np.ones(shape)
        assert is_even[node] == (axis == 0) and 0 < p < 1
        half = tuple(n // 2 if a == axis else n for a, n in enumerate(shape))
        halves = (table(child[node] + side, 1 - axis, half) for side in range(2))
        return np.concatenate([2 * q * t for q, t in zip((p, 1 - p), halves)], axis=axis)

    return table(root, 0, (CELLS, CELLS))


def _is_uniform(nodes: Nodes, root: int = 0) -> bool:
    return float(nodes.probability[root]) == LEAF


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
    nodes = _learned(u, np.where(is_left, 3, 1) * weight, weight)
    assert float(nodes.probability[0]) == pytest.approx(0.75, abs=2e-3)


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
        results.append(_arrays(_grown(_samples(u[:, order], value[order]), tree[order], trees)))
    assert len(results[0][0]) > 5000 and all(map(np.array_equal, *results))


# ---- Many trees ----


@pytest.mark.parametrize("lowest", [0, 8, 10])
def test_trees_of_surroundings_are_built_from_all_samples_in_them(lowest: int):
    """Ten regions lie in a region of the level before, and all of these in the first one. Samples
    of a region belong to the surroundings as well, and some samples may belong to them only."""
    count, small, trees = 50_000, 8, 1 + 7 + 70
    rng, u = np.random.default_rng(4), 0.1 + 0.9 * _uniform(count)
    region = rng.integers(lowest, trees, count)
    parent = np.append([0] * small, 1 + np.arange(70) // 10).astype(np.uint32)
    levels = [slice(0, 1), slice(1, small), slice(small, trees)]
    data = _samples(u, FUNCTIONS["edge"](*u), rng.uniform(0.2, 5, count))
    cells = Cells.of(*data, mi.UInt32(region), mi.UInt32(parent), levels)
    prior = mi.UInt32(np.append(parent, trees))
    nested = _arrays(grown(cells, prior, len(levels), small))
    # The same with a copy of each sample for each tree around it
    around = [region, parent[region], parent[parent[region]]]
    own = np.concatenate([np.full(count, True), *(a != b for a, b in zip(around[1:], around))])
    index, tree = np.tile(np.arange(count), 3)[own], np.concatenate(around)[own]
    copies = [dr.gather(type(x), x, mi.UInt32(index)) for x in data]
    alone = _arrays(grown(Cells.of(*copies, mi.UInt32(tree)), prior, len(levels)))
    assert len(nested[0]) > 1000
    for x, y in zip(nested, alone):
        np.testing.assert_allclose(x, y, atol=1e-4)


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
    none = np.resize([len(counts), len(counts) + 1, 2**24 - 1], len(tree))
    tree = np.concatenate([tree, none])[order]
    nodes = _grown(_samples(u, value), tree, len(counts))
    assert _is_uniform(nodes, len(counts))
    for index, part in enumerate(parts):
        together = _table(nodes, index)
        assert (together == 1).all() == (counts[index] < SPLIT)
        if counts[index] > 0:
            alone = _table(_learned(part, functions[index](*part)))
            np.testing.assert_allclose(together, alone, rtol=1e-3)


def test_forests_follow_each_other():
    u = _uniform(1 << 12)
    one, other = (_learned(u, x) for x in u)
    nodes = one.followed_by(other)
    assert nodes.count == one.count + other.count
    np.testing.assert_array_equal(_table(nodes), _table(one))
    np.testing.assert_array_equal(_table(nodes, one.count), _table(other))


def test_samples_are_drawn_by_the_densities_that_were_learned():
    """What is built is what ``SampleTrees`` wants; leaves are the same."""
    u = _uniform(1 << 12)
    value = [f(*u) for f in FUNCTIONS.values()]
    tree, count = np.repeat(np.arange(len(value)), u.shape[1]), len(value)
    nodes = _grown(_samples(np.tile(u, count), np.concatenate(value)), tree, count)
    shape, share = (nodes.probability, nodes.child, nodes.is_even), mi.Float([1.0] * count)
    roots = dr.arange(mi.UInt32, count)
    trees = SampleTrees(*shape, roots, share, dr.arange(mi.UInt32, nodes.count))
    tree = dr.repeat(roots, 1 << DEPTH)
    code = dr.tile(dr.arange(mi.UInt32, 1 << DEPTH), count)
    density, leaf = trees.density(tree, cell_centre(code), mi.Bool(True))
    x, y = (cell_centre(code).numpy() * CELLS).astype(int)
    tables = np.array([_table(nodes, index) for index in range(count)])
    # Probabilities are rounded to nine bits
    np.testing.assert_allclose(density.numpy(), tables[tree.numpy(), x, y], rtol=0.1, atol=0.05)
    node = nodes.leaf(tree, code)
    assert bool(dr.all(trees.value(leaf, mi.Bool(True)) == node))
    assert bool(dr.all(dr.gather(mi.Float, nodes.probability, node) == LEAF))


@pytest.mark.parametrize("trees", [5, 500])
@pytest.mark.parametrize("levels", [1, 3, 5])
def test_launches_do_not_grow_with_the_trees_or_their_levels(trees: int, levels: int):
    """Each launch takes 10 µs on a GPU. The nodes of a depth are split together; the cells of each
    level of surroundings are added up in two kernels."""
    count = 20_000
    rng, u = np.random.default_rng(1), _uniform(count)
    tree = rng.integers(trees * (levels - 1), trees * levels, count)
    number = np.arange(trees * levels)
    parent = np.where(number < trees, number, number - trees)
    slices = [slice(start, start + trees) for start in number[::trees]]
    data, prior = _samples(u, FUNCTIONS["spot"](*u)), np.append(parent, trees * levels)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        cells = Cells.of(*data, mi.UInt32(tree), mi.UInt32(parent), slices)
        nodes = grown(cells, mi.UInt32(prior), levels, slices[-1].start)
        dr.eval(nodes)
        launches = len(dr.kernel_history())
    assert nodes.count > trees * levels
    assert launches <= 110 + 4 * levels, launches


# ---- What is expected ----


def _with_expected(u, value, name: str = "ramp") -> tuple[np.ndarray, np.ndarray]:
    """The densities of a tree, and of the one of a function that is expected."""
    many = _uniform(1 << 16, 9)
    values = [FUNCTIONS[n](*many) for n in ("edge", name)]
    value = np.broadcast_to(value, u.shape[1])
    tree = np.repeat([0, 1, 3], [many.shape[1], many.shape[1], u.shape[1]])
    data = _samples(np.concatenate([many, many, u], axis=1), np.concatenate([*values, value]))
    # Another tree, without a sample, is the one that is expected of it
    nodes = _grown(data, tree, 4, [0, 1, 0, 1])
    np.testing.assert_array_equal(_table(nodes, 2), _table(nodes, 0))
    return _table(nodes, 3), _table(nodes, 1)


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
