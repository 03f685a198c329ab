"""Point patterns and their weights: known cells, sums, symmetries, and unbiased estimates."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mitsuba_ext.util.pointsets import (
    PATTERNS,
    correction,
    nearest_neighbour_weights,
    patterns,
    piecewise_points,
    piecewise_weights,
    points,
    shifted,
    stratum_weights,
    tent,
    trapezoid_weights,
    unbiased_weights,
    voronoi,
    voronoi_weights,
)

BOUNDARIES = ("clip", "torus")


def _sets(count: int, dimension: int, repetitions: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((repetitions, count, dimension))


def _z(values: np.ndarray, expected: float) -> float:
    """How many standard errors their mean is off."""
    return (values.mean() - expected) / (values.std(ddof=1) / np.sqrt(len(values)))


# ---- Cells, and other weights ----


def test_lengths_of_known_cells() -> None:
    x = [0.5, 0.2, 0.9]
    np.testing.assert_allclose(voronoi_weights(x, "clip"), [0.35, 0.35, 0.3])
    np.testing.assert_allclose(voronoi_weights(x, "torus"), [0.35, 0.3, 0.35])
    np.testing.assert_allclose(voronoi_weights([0.3], "torus"), [1])
    np.testing.assert_allclose(voronoi_weights([0, 0, 1], "torus"), 1 / 3)
    np.testing.assert_allclose(voronoi_weights([0.4, 0.4, 0.8, 0.4], "clip"), [0.2, 0.2, 0.4, 0.2])
    # One point is nearest to no test point
    np.testing.assert_array_equal(nearest_neighbour_weights([0.1, 0.9], [0.0, 0.2]), [1, 0])


def test_areas_of_known_cells() -> None:
    """A diagonal cuts the square; on the torus, four lines do."""
    x = [[0.25, 0.25], [0.75, 0.75], [0.75, 0.25]]
    clipped = voronoi_weights(x, "clip")
    np.testing.assert_allclose(clipped, [0.375, 0.375, 0.25], atol=1e-12)
    np.testing.assert_allclose(voronoi_weights([[0, 0], [0.5, 0.5]], "torus"), [0.5, 0.5])
    np.testing.assert_allclose(voronoi_weights([[0.1, 0.2], [0.1, 0.6]], "clip"), [0.4, 0.6])
    across_the_seam = [[1 - 2.0**-53, 0.5], [0, 0.5], [0.02, 0.5], [0.5, 0.5]]
    np.testing.assert_allclose(voronoi_weights(across_the_seam), [0.13, 0.13, 0.25, 0.49])
    near_the_border = [[1e-5, 0.5], [3e-5, 0.5], [0.5, 0.5]]
    clipped = voronoi_weights(near_the_border, "clip")
    np.testing.assert_allclose(clipped, [2e-5, 0.249995, 0.749985], rtol=1e-6)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("dimension, count", [(1, 40), (2, 3), (2, 40), (2, 400), (3, 1), (3, 60)])
def test_measures_are_the_shares_of_places_that_are_nearest(boundary, dimension, count):
    x = points("independent", count, dimension, seed=count)
    tests = points("sobol", 1 << 16, dimension, seed=1)
    tree = cKDTree(x, boxsize=1 if boundary == "torus" else None)
    share = np.bincount(tree.query(tests)[1], minlength=count) / len(tests)
    np.testing.assert_allclose(voronoi_weights(x, boundary), share, atol=2e-3, rtol=0.02)
    if boundary == "clip":
        np.testing.assert_array_equal(nearest_neighbour_weights(x, tests), share)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_measures_are_positive_and_add_up_to_one(pattern, dimension):
    for count, boundary in itertools.product((1, 2, 3, 16, 49), BOUNDARIES):
        weights = voronoi_weights(points(pattern, count, dimension, seed=3), boundary)
        assert abs(weights.sum() - 1) < 1e-12 and weights.min() > 0
        if pattern == "lattice" and boundary == "torus":
            np.testing.assert_allclose(weights, 1 / count, rtol=1e-9)


def _grid(edge: int, dimension: int, offset: float) -> np.ndarray:
    return np.array(list(itertools.product(*[(np.arange(edge) + offset) / edge] * dimension)))


_ANGLES = np.arange(12) * np.pi / 6
DEGENERATE = {
    "all_equal": np.full((5, 2), 0.3), "many_equal": np.full((100, 2), 0.5),
    "equal_twice": np.repeat(_sets(20, 2, 1)[0], 2, axis=0),
    "nearly_equal": _sets(20, 2, 1)[0].repeat(3, 0) + np.tile([[0], [1e-13], [1e-9]], (20, 1)),
    "on_a_line": np.stack([np.linspace(0, 1, 17), np.full(17, 0.5)], 1),
    "on_the_diagonal": np.linspace(0, 1, 9)[:, None].repeat(2, 1),
    "many_on_a_diagonal": np.linspace(0.45, 0.55, 100)[:, None].repeat(2, 1),
    "on_the_border": np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0], [0, 0.5], [1, 0.2]]),
    "grid": _grid(8, 2, 0.5), "grid_from_zero": _grid(8, 2, 0), "grid_3d": _grid(3, 3, 0.5),
    "on_a_circle": 0.5 + 0.4 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1),
    "in_a_corner": _sets(200, 2, 1)[0] * 1e-3, "equal_3d": np.full((4, 3), 0.7),
    "many_on_a_plane": np.concatenate([_sets(150, 2, 1)[0], np.full((150, 1), 0.5)], 1),
    "many_on_a_line": np.stack([np.linspace(0.01, 0.99, 100), np.full(100, 0.5)], 1),
    "many_on_a_line_3d": np.linspace(0.01, 0.99, 150)[:, None] * [1, 0, 0] + [0, 0.5, 0.5],
}  # fmt: skip


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_points_have_weights(name, boundary):
    x = DEGENERATE[name]
    weights = voronoi_weights(x, boundary)
    assert abs(weights.sum() - 1) < 1e-12 and weights.min() >= 0
    if name in ("all_equal", "many_equal", "grid", "grid_3d", "equal_3d"):
        np.testing.assert_allclose(weights, 1 / len(x), rtol=1e-9)
    if name == "equal_twice":
        np.testing.assert_array_equal(weights[::2], weights[1::2])
        np.testing.assert_allclose(weights[::2] * 2, voronoi_weights(x[::2], boundary), rtol=1e-9)
    if name.startswith("many_on_a_line"):
        np.testing.assert_allclose(weights, voronoi_weights(x[:, 0], boundary), rtol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [1e-6, 1e-9, 1e-10, 1e-11])
def test_a_heap_of_points_does_not_starve_the_other_points(size, dimension):
    rng = np.random.default_rng(0)
    others, middle = rng.random((50, dimension)), np.full((1, dimension), 0.5)
    heap = np.concatenate([others, middle + size * rng.random((50, dimension))])
    for boundary in BOUNDARIES:
        one = voronoi_weights(np.concatenate([others, middle]), boundary)
        weights = voronoi_weights(heap, boundary)
        np.testing.assert_allclose(weights[:50], one[:50], rtol=1e-4)
        assert weights[50:].sum() == pytest.approx(one[50], rel=1e-4)


def test_no_image_that_matters_is_left_out() -> None:
    for power, boundary in itertools.product((1, 2, 3), BOUNDARIES):
        # With this seed, the missing images would change the sum by 1e-6 only
        x = np.clip(_sets(100, 2, 1, seed=12)[0] ** power, 1e-6, 1 - 1e-6)
        exact = voronoi._cell_measures(x, voronoi._images(x, boundary, np.inf))
        np.testing.assert_allclose(voronoi_weights(x, boundary), exact, rtol=1e-6)
    # Without any, only the cell in the middle is bounded
    alone = voronoi._cell_measures(np.array([*2 * _grid(2, 2, 0), [0.5, 0.5]]), np.empty((0, 2)))
    np.testing.assert_allclose(alone, [*[np.inf] * 4, 0.5])


def test_weights_move_with_the_points() -> None:
    x = points("independent", 50, 2, seed=7)
    for boundary in BOUNDARIES:
        weights = voronoi_weights(x, boundary)
        order = np.random.default_rng(0).permutation(len(x))
        np.testing.assert_allclose(voronoi_weights(x[order], boundary), weights[order], rtol=1e-9)
        for other in (1 - x, x[:, ::-1], x * [1, -1] + [0, 1]):
            np.testing.assert_allclose(voronoi_weights(other, boundary), weights, rtol=1e-9)
    for y, shift in ((x, [0.3, 0.85]), (x[:, 0], 0.77)):
        moved = voronoi_weights(shifted(y, shift))
        np.testing.assert_allclose(moved, voronoi_weights(y), rtol=1e-9)


HALVES, SQUARE = [0, 0.5, 1], np.full((4, 2), 0.5)


@pytest.mark.parametrize("function, says, wrong", [
    (voronoi_weights, "shape", [[]]), (voronoi_weights, "4 dimensions", [np.zeros((2, 4))]),
    (voronoi_weights, "outside", [[0.5, 1.5]]), (voronoi_weights, "outside", [[[0.5, -0.5]]]),
    (voronoi_weights, "outside", [[[0.5, np.nan]]]), (voronoi_weights, '"wrap"', [[0.5], "wrap"]),
    (points, '"sobel"', ["sobel", 4]), (points, "count is 0", ["sobol", 0]),
    (points, "count is 4.5", ["sobol", 4.5]), (points, "dimension is 0", ["sobol", 4, 0]),
    (unbiased_weights, r"\(N,\) expected", [SQUARE]), (unbiased_weights, "outside", [[np.nan]]),
    (trapezoid_weights, "shape", [SQUARE]), (trapezoid_weights, "outside", [[2.0]]),
    (nearest_neighbour_weights, r"\(8, 3\)", [SQUARE, np.zeros((8, 3))]),
    (nearest_neighbour_weights, "shape", [[0.5], []]), (stratum_weights, "1 of", [[0.1], HALVES]),
    (stratum_weights, "outside", [[-4, 0.6], HALVES]), (stratum_weights, "edges", [[0], [0, 0.5]]),
    (stratum_weights, "edges", [[0], [0, 0, 1]]), (stratum_weights, "edges", [[0], [0, np.nan, 1]]),
    (piecewise_points, "edges", [[0.1], [0.1, 1], [1]]),
    (piecewise_points, "outside", [[np.nan], HALVES, [0.2, 0.8]]),
    (piecewise_points, "probabilities", [[0.1], HALVES, [0.2, 0.2]]),
    (piecewise_points, "probabilities", [[0.1], HALVES, [1.2, -0.2]]),
    (piecewise_weights, "probabilities", [[0.1], [0, 1], [0.5, 0.5]]),
    (piecewise_weights, "outside", [[np.nan], [0, 1], [1]]),
])  # fmt: skip
def test_errors_say_what_is_wrong(function, says, wrong):
    with pytest.raises(ValueError, match=f"{function.__name__}: .*{says}"):
        function(*wrong)


def test_the_correction_is_exact_for_few_points_and_stable_for_many() -> None:
    # Eq. 4.7 (Guo) in fractions
    for count, k in itertools.product((1, 2, 5, 40), range(11)):
        x = Fraction(k, 10)
        a = (count - count * x - x) * x ** (count - 1)
        b = (count * x + x - 1) * (1 - x) ** (count - 1)
        assert correction(float(x), count) == pytest.approx(float((a + b + 2) / 2), rel=1e-13)
    x = np.array([0, 1e-300, 1e-12, 1e-7, 1e-3, 0.5, 1 - 1e-7, 1 - 1e-16, 1])
    for count in (2, 1000, 10**9):
        g = correction(x, count)
        assert np.isfinite(g).all() and (g >= 0.5).all() and g.max() <= 1.25
        np.testing.assert_allclose(g[[0, -1]], 0.5)
        y = 2.0 ** -np.array([20, 30, 40])
        np.testing.assert_allclose(correction(1 - y, count), correction(y, count), rtol=1e-14)
    weights = unbiased_weights(points("independent", 10**5, 1)[:, 0])
    assert np.isfinite(weights).all() and abs(weights.sum() - 1) < 1e-2


def test_the_trapezoidal_rule_is_exact_for_lines() -> None:
    equal_ends = np.array([0.3, 0.3, 0.5, 0.8, 0.8, 0.8])
    for x in (points("independent", 20, 1, seed=2)[:, 0], equal_ends):
        weights, at_0, at_1 = trapezoid_weights(x)
        assert weights.sum() + at_0 + at_1 == pytest.approx(1)
        assert (weights * (3 * x - 1)).sum() - at_0 + 2 * at_1 == pytest.approx(0.5)


# ---- Bias and variance: tests of bias have a fixed seed, and fail with probability 6e-5 ----


@pytest.mark.parametrize("count", [1, 2, 3, 16])
def test_weights_of_an_interval_are_unbiased(count):
    sets = _sets(count, 1, 4000, seed=count)[..., 0]
    unbiased = np.array([unbiased_weights(x) for x in sets])
    torus = np.array([voronoi_weights(x) for x in sets])
    for weights, x in ((unbiased, sets), (torus, sets), (torus, tent(sets))):
        wave, step = 1 + np.sin(2 * np.pi * x + 0.3), x > 0.8
        for f, integral in ((np.exp(x), np.e - 1), (wave, 1), (step, 0.2)):
            assert abs(_z((weights * f).sum(axis=1), integral)) < 4


def test_clipped_cells_are_biased_at_the_ends_by_what_the_correction_says() -> None:
    sets = _sets(8, 1, 8000, seed=1)[..., 0]
    means = np.array([voronoi_weights(x, "clip") @ (x < 0.05) for x in sets])
    assert _z(means, 0.05) < -10
    grid = (np.arange(1000) + 0.5) / 1000
    assert abs(_z(means, np.mean(correction(grid, 8) * (grid < 0.05)))) < 4


@pytest.mark.parametrize("dimension, count", [(2, 2), (2, 5), (2, 30), (3, 4)])
def test_cells_on_the_torus_are_unbiased(dimension, count):
    sets = _sets(count, dimension, 1000 if dimension == 2 else 300, seed=dimension)
    weights = np.array([voronoi_weights(x) for x in sets])
    for x in (sets, tent(sets)):
        f = (x < 0.3).all(axis=-1) + x[..., 0] ** 2
        assert abs(_z((weights * f).sum(axis=1), 0.3**dimension + 1 / 3)) < 4


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_shift_makes_any_weights_that_add_up_to_one_unbiased(pattern):
    x = points(pattern, 20, 2, seed=4)
    weights = np.random.default_rng(0).dirichlet(np.ones(len(x)))
    moved = shifted(x, _sets(1, 2, 4000, seed=5))
    f = np.exp(moved[..., 0]) * (moved[..., 1] > 0.7)
    for w in (weights, voronoi_weights(x)):
        assert abs(_z(f @ w, (np.e - 1) * 0.3)) < 4


def test_weights_of_piecewise_constant_densities_are_unbiased() -> None:
    """This includes densities with a piece that most sets leave without a point."""
    edges, probabilities = [0, 0.1, 0.5, 1], [0.05, 0.6, 0.35]
    sums = []
    for u in _sets(6, 1, 3000)[..., 0]:
        x = piecewise_points(u, edges, probabilities)
        sums.append(piecewise_weights(x, edges, probabilities) @ np.exp(-3 * x))
    assert abs(_z(np.array(sums), (1 - np.exp(-3)) / 3)) < 4
    # A piece of probability 1 needs no correction
    x = np.array([0.1, 0.2, 0.7])
    np.testing.assert_allclose(piecewise_weights(x, [0, 1], [1]), unbiased_weights(x), rtol=1e-14)
    np.testing.assert_allclose(piecewise_weights([0.1], [0, 0.9, 1], [0.9, 0.1]), [1])


def test_weights_of_strata_add_up_to_their_widths() -> None:
    edges, rng = np.array([0, 0.2, 0.3, 1]), np.random.default_rng(1)
    x = np.concatenate([rng.uniform(a, b, 50) for a, b in zip(edges, edges[1:])])
    weights = stratum_weights(x, edges, voronoi_weights)
    np.testing.assert_allclose(weights.reshape(3, 50).sum(axis=1), np.diff(edges))
    sums = []
    for _ in range(2000):
        x = np.concatenate([rng.uniform(a, b, 3) for a, b in zip(edges, edges[1:])])
        sums.append(stratum_weights(x, edges) @ np.exp(x))
    assert abs(_z(np.array(sums), np.e - 1)) < 4


def test_edges_belong_to_the_stratum_that_begins_whatever_the_rounding() -> None:
    weights = stratum_weights(HALVES, HALVES, lambda u: voronoi_weights(u, "clip"))
    np.testing.assert_allclose(weights, [0.5, 0.25, 0.25])
    rng = np.random.default_rng(0)
    for _ in range(300):
        edges = np.concatenate([[0], np.sort(rng.random(9)), [1]])
        weights = stratum_weights(np.nextafter(edges[1:], 0), edges, voronoi_weights)
        np.testing.assert_allclose(weights, np.diff(edges))


@pytest.mark.parametrize("dimension, least", [(1, 1000), (2, 10)])
def test_weights_lower_the_error_on_smooth_functions(dimension, least):
    sets = _sets(256, dimension, 60)
    f = np.prod(1 + np.sin(2 * np.pi * sets), axis=-1)
    weights = np.array([voronoi_weights(x) for x in sets])
    plain, weighted = (np.mean(((w * f).sum(axis=1) - 1) ** 2) for w in (1 / 256, weights))
    assert plain > least * weighted


def test_the_tent_removes_the_seam() -> None:
    """On a function that differs at the ends, by orders of magnitude."""
    sets = _sets(256, 1, 100)[..., 0]
    weights = np.array([voronoi_weights(x) for x in sets])
    pairs = ((weights, sets), (weights, tent(sets)), (1 / 256, sets))
    errors = [(w * np.exp(x)).sum(axis=1) - np.e + 1 for w, x in pairs]
    torus, with_tent, plain = np.square(errors).mean(axis=1)
    assert 100 * with_tent < torus and 30 * torus < plain


# ---- Patterns ----


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dimension, count", [(1, 10), (2, 1), (2, 7), (2, 16), (3, 11)])
def test_patterns_are_uniform_on_average_reproducible_and_in_the_cube(pattern, dimension, count):
    x = points(pattern, count, dimension, seed=11)
    assert x.shape == (count, dimension) and x.dtype == np.float64
    np.testing.assert_array_equal(points(pattern, count, dimension, seed=11), x)
    assert (points(pattern, count, dimension, seed=12) != x).any()
    rng = np.random.default_rng(0)
    sets = np.array([points(pattern, count, dimension, rng) for _ in range(400)])
    assert sets.min() >= 0 and np.float32(sets.max()) < 1
    for axis, limit in itertools.product(range(dimension), (0.2, 0.5, 0.9)):
        share = (sets[..., axis] < limit).mean(axis=1)
        # Some patterns have exactly this number on each side
        error = share.std(ddof=1) / np.sqrt(len(share))
        assert abs(share.mean() - limit) <= 4 * error + 1e-9


def test_rounding_does_not_reach_the_upper_end(monkeypatch):
    last = 1 - 2.0**-53
    monkeypatch.setitem(patterns.MAKERS, "independent", lambda n, d, _: np.full((n, d), last))
    assert np.float32(points("independent", 2).max()) < 1
    np.testing.assert_array_equal(shifted([-1e-20, 0.5, np.nan], 0), [0, 0.5, np.nan])


@pytest.mark.parametrize("dimension, count", [(1, 7), (2, 16), (2, 7), (2, 30), (3, 27), (3, 40)])
def test_stratified_points_have_a_cell_each(dimension, count):
    edge = int(count ** (1 / dimension) + 1e-9)
    columns = edge ** (dimension - 1)
    for seed in range(100):
        x = points("stratified", count, dimension, seed)
        column = np.floor(x[:, :-1] * edge) @ edge ** np.arange(dimension - 1)
        sizes = np.bincount(column.astype(int), minlength=columns)
        assert len(sizes) == columns and sizes.max() - sizes.min() == (count % columns > 0)
        for index, size in enumerate(sizes):
            along = np.sort(x[column == index, -1])
            np.testing.assert_array_equal(np.floor(along * size), np.arange(size))


@pytest.mark.parametrize("count, dimension", [(31, 2), (32, 2), (34, 3)])
def test_the_lattice_is_the_best_that_powers_make(count, dimension):
    """The criterion is the dual lattice: few frequencies alias, and only high ones."""
    reach = 60 if dimension == 2 else 20
    h = np.array(list(itertools.product(range(-reach, reach + 1), repeat=dimension)))
    decay = 1 / np.prod(np.maximum(1, np.abs(h)) ** 2.0, axis=1)

    def error(generator: np.ndarray) -> float:
        return decay[h @ generator % count == 0].sum() - 1

    coprime = [a for a in range(1, count) if np.gcd(a, count) == 1]
    best = min(error(a ** np.arange(dimension) % count) for a in coprime)
    assert error(patterns._generator(count, dimension)) < 1.02 * best


def test_lattices_and_hammersley_points_prefer_no_direction() -> None:
    slopes = set()
    for seed in range(60):
        x = points("lattice", 7, 2, seed)
        first, second = x[x[:, 0].argsort()][:2, 1]
        slopes.add(round((second - first) * 7) % 7)
    assert slopes == {2, 3, 4, 5}
    steps = [np.diff(points("hammersley", 16, 2, seed)[:, 0]) % 1 for seed in range(20)]
    assert 0 < sum(np.allclose(s, 1 / 16) for s in steps) < 20


def test_poisson_disks_keep_apart_across_the_seam() -> None:
    sets = [points("poisson_disk", 64, 2, seed) for seed in range(20)]
    nearest = [cKDTree(x, boxsize=1).query(x, 2)[0][:, 1].min() for x in sets]
    assert np.mean(nearest) * 8 > 0.55


@pytest.mark.parametrize("pattern, factor", [
    ("stratified", 3), ("latin_hypercube", 3), ("halton", 30), ("hammersley", 30), ("sobol", 30),
    ("lattice", 30), ("poisson_disk", 2),
])  # fmt: skip
def test_patterns_integrate_smooth_functions_better_than_chance(pattern, factor):
    rng = np.random.default_rng(8)
    integral = (np.e - 1) * (np.exp(0.3) - 1) / 0.3

    def error(name: str) -> float:
        sets = np.array([points(name, 64, 2, rng) for _ in range(50)])
        return np.mean((np.exp(sets @ [1, 0.3]).mean(axis=1) - integral) ** 2)

    assert factor * error(pattern) < error("independent")
