"""Point patterns, and their weights: known cells, sums, symmetries, degenerate points, and what is
unbiased."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import cKDTree

from mitsuba_ext.pointsets import (
    PATTERNS,
    correction,
    nearest_neighbour_weights,
    piecewise_points,
    piecewise_weights,
    points,
    shifted,
    stratum_weights,
    tent,
    trapezoid_weights,
    unbiased_weights,
    voronoi_weights,
)

BOUNDARIES = ("clip", "torus")


def _sets(count: int, dimension: int, repetitions: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((repetitions, count, dimension))


def _z(values: np.ndarray, expected: float) -> float:
    """How many standard errors their mean is off."""
    return (values.mean() - expected) / (values.std(ddof=1) / np.sqrt(len(values)))


# ---- Cells ----


def test_lengths_of_known_cells() -> None:
    x = [0.5, 0.2, 0.9]
    np.testing.assert_allclose(voronoi_weights(x, "clip"), [0.35, 0.35, 0.3])
    np.testing.assert_allclose(voronoi_weights(x, "torus"), [0.35, 0.3, 0.35])
    np.testing.assert_allclose(voronoi_weights([0.3], "torus"), [1])
    np.testing.assert_allclose(voronoi_weights([0.4, 0.4, 0.8, 0.4], "clip"), [0.2, 0.2, 0.4, 0.2])


def test_areas_of_known_cells() -> None:
    """A diagonal cuts the square; on the torus, four lines do."""
    x = [[0.25, 0.25], [0.75, 0.75], [0.75, 0.25]]
    clipped = voronoi_weights(x, "clip")
    np.testing.assert_allclose(clipped, [0.375, 0.375, 0.25], atol=1e-12)
    np.testing.assert_allclose(voronoi_weights([[0, 0], [0.5, 0.5]], "torus"), [0.5, 0.5])
    np.testing.assert_allclose(voronoi_weights([[0.1, 0.2], [0.1, 0.6]], "clip"), [0.4, 0.6])


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


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 3, 16, 49])
def test_measures_are_positive_and_add_up_to_one(pattern, count, dimension, boundary):
    weights = voronoi_weights(points(pattern, count, dimension, seed=3), boundary)
    assert abs(weights.sum() - 1) < 1e-12 and weights.min() > 0
    if pattern == "lattice" and boundary == "torus":
        np.testing.assert_allclose(weights, 1 / count, rtol=1e-9)


def _grid(edge: int, dimension: int, offset: float) -> np.ndarray:
    return np.array(list(itertools.product(*[(np.arange(edge) + offset) / edge] * dimension)))


_ANGLES = np.arange(12) * np.pi / 6
DEGENERATE = {
    "all_equal": np.full((5, 2), 0.3),
    "equal_twice": np.repeat(_sets(20, 2, 1)[0], 2, axis=0),
    "nearly_equal": _sets(20, 2, 1)[0].repeat(3, 0) + np.tile([[0], [1e-13], [1e-9]], (20, 1)),
    "on_a_line": np.stack([np.linspace(0, 1, 17), np.full(17, 0.5)], 1),
    "on_the_diagonal": np.linspace(0, 1, 9)[:, None].repeat(2, 1),
    "on_the_border": np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0], [0, 0.5], [1, 0.2]]),
    "grid": _grid(8, 2, 0.5),
    "grid_from_zero": _grid(8, 2, 0),
    "on_a_circle": 0.5 + 0.4 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1),
    "in_a_corner": _sets(200, 2, 1)[0] * 1e-3,
    "grid_3d": _grid(3, 3, 0.5),
    "equal_3d": np.full((4, 3), 0.7),
    "on_a_plane": np.concatenate([_sets(30, 2, 1)[0], np.full((30, 1), 0.5)], 1),
}  # fmt: skip


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_points_have_weights(name, boundary):
    x = DEGENERATE[name]
    weights = voronoi_weights(x, boundary)
    assert abs(weights.sum() - 1) < 1e-12 and weights.min() >= 0
    if name in ("all_equal", "grid", "grid_3d", "equal_3d"):
        np.testing.assert_allclose(weights, 1 / len(x), rtol=1e-9)
    if name == "equal_twice":
        np.testing.assert_array_equal(weights[::2], weights[1::2])
        np.testing.assert_allclose(weights[::2] * 2, voronoi_weights(x[::2], boundary), rtol=1e-9)


def test_weights_move_with_the_points() -> None:
    x = points("independent", 50, 2, seed=7)
    for boundary in BOUNDARIES:
        weights = voronoi_weights(x, boundary)
        order = np.random.default_rng(0).permutation(len(x))
        np.testing.assert_allclose(voronoi_weights(x[order], boundary), weights[order], rtol=1e-9)
        for other in (1 - x, x[:, ::-1], x * [1, -1] + [0, 1]):
            np.testing.assert_allclose(voronoi_weights(other, boundary), weights, rtol=1e-9)
    moved = shifted(x, [0.3, 0.85])
    np.testing.assert_allclose(voronoi_weights(moved), voronoi_weights(x), rtol=1e-9)
    line = x[:, 0]
    moved = voronoi_weights(shifted(line, 0.77))
    np.testing.assert_allclose(moved, voronoi_weights(line), rtol=1e-9)


@pytest.mark.parametrize("wrong, says", [
    (lambda: voronoi_weights([]), "shape"), (lambda: voronoi_weights(np.zeros((2, 4))), "4 dim"),
    (lambda: voronoi_weights([0.5, 1.5]), "outside"),
    (lambda: voronoi_weights([np.nan]), "outside"),
    (lambda: voronoi_weights([0.5], "wrap"), '"wrap"'), (lambda: points("sobel", 4), '"sobel"'),
    (lambda: points("sobol", 0), "0 points"), (lambda: stratum_weights([0.1], [0, 0.5, 1]), "1 of"),
])  # fmt: skip
def test_errors_say_what_is_wrong(wrong, says):
    with pytest.raises(ValueError, match=says):
        wrong()


# ---- One dimension ----


def test_the_correction_is_exact_for_few_points() -> None:
    """Eq. 4.7 in fractions."""
    for count in (1, 2, 5, 40):
        for k in range(11):
            x = Fraction(k, 10)
            a = (count - count * x - x) * x ** (count - 1)
            b = (count * x + x - 1) * (1 - x) ** (count - 1)
            assert correction(float(x), count) == pytest.approx(float((a + b + 2) / 2), rel=1e-13)


def test_the_correction_is_stable_for_many_points() -> None:
    x = np.array([0, 1e-300, 1e-12, 1e-7, 1e-3, 0.5, 1 - 1e-7, 1 - 1e-16, 1])
    for count in (2, 1000, 10**6, 10**9):
        g = correction(x, count)
        assert np.isfinite(g).all() and (g >= 0.5).all() and g.max() <= 1.25
        np.testing.assert_allclose(g[[0, -1]], 0.5)
    weights = unbiased_weights(points("independent", 10**6, 1)[:, 0])
    assert np.isfinite(weights).all() and abs(weights.sum() - 1) < 1e-2


def test_the_trapezoidal_rule_is_exact_for_lines() -> None:
    x = points("independent", 20, 1, seed=2)[:, 0]
    weights, at_0, at_1 = trapezoid_weights(x)
    assert weights.sum() + at_0 + at_1 == pytest.approx(1)
    assert (weights * (3 * x - 1)).sum() - at_0 + 2 * at_1 == pytest.approx(0.5)


# ---- Bias: each of these has a fixed seed, and fails with probability 6e-5 ----

FUNCTIONS = {
    "exp": (lambda x: np.exp(x), np.e - 1),
    "sine": (lambda x: 1 + np.sin(2 * np.pi * x + 0.3), 1.0),
    "step": (lambda x: (x > 0.8).astype(float), 0.2),
}


@pytest.mark.parametrize("count", [1, 2, 3, 16])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_weights_of_an_interval_are_unbiased(name, count):
    f, integral = FUNCTIONS[name]
    sets = _sets(count, 1, 4000, seed=count)[..., 0]
    assert abs(_z(np.array([unbiased_weights(x) @ f(x) for x in sets]), integral)) < 4
    torus = [voronoi_weights(x) for x in sets]
    for moved in (lambda x: x, tent):
        sums = np.array([w @ f(moved(x)) for w, x in zip(torus, sets)])
        assert abs(_z(sums, integral)) < 4


def test_clipped_cells_are_biased_at_the_ends() -> None:
    """By what the correction says."""
    sets = _sets(8, 1, 20_000, seed=1)[..., 0]
    means = np.array([voronoi_weights(x, "clip") @ (x < 0.05) for x in sets])
    assert _z(means, 0.05) < -10
    grid = (np.arange(1000) + 0.5) / 1000
    assert abs(_z(means, np.mean(correction(grid, 8) * (grid < 0.05)))) < 4


@pytest.mark.parametrize("dimension, count", [(2, 1), (2, 2), (2, 5), (2, 30), (3, 4)])
def test_cells_on_the_torus_are_unbiased(dimension, count):
    """In each dimension, for independent points. Clipped ones are too small in the corners."""
    repetitions = 1500 if dimension == 2 else 300
    sets = _sets(count, dimension, repetitions, seed=dimension)

    def f(x: np.ndarray) -> np.ndarray:
        return (x < 0.3).all(axis=-1) + x[..., 0] ** 2

    integral = 0.3**dimension + 1 / 3
    for boundary, moved in itertools.product(BOUNDARIES, (lambda x: x, tent)):
        if boundary == "torus" or count == 1:
            sums = np.array([voronoi_weights(x, boundary) @ f(moved(x)) for x in sets])
            assert abs(_z(sums, integral)) < 4


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_shift_makes_any_weights_that_add_up_to_one_unbiased(pattern):
    x = points(pattern, 20, 2, seed=4)
    weights = np.random.default_rng(0).dirichlet(np.ones(len(x)))
    shifts = _sets(1, 2, 4000, seed=5)

    def f(x: np.ndarray) -> np.ndarray:
        return np.exp(x[..., 0]) * (x[..., 1] > 0.7)

    integral = (np.e - 1) * 0.3
    for w in (weights, voronoi_weights(x)):
        assert abs(_z(f(shifted(x, shifts)) @ w, integral)) < 4


def test_weights_of_piecewise_constant_densities_are_unbiased() -> None:
    """Also where most sets leave a piece without a point."""
    edges, probabilities = [0, 0.1, 0.5, 1], [0.05, 0.6, 0.35]
    sums = []
    for u in _sets(6, 1, 5000)[..., 0]:
        x = piecewise_points(u, edges, probabilities)
        sums.append(piecewise_weights(x, edges, probabilities) @ np.exp(-3 * x))
    assert abs(_z(np.array(sums), (1 - np.exp(-3)) / 3)) < 4


def test_weights_of_strata_add_up_to_their_widths() -> None:
    edges, rng = np.array([0, 0.2, 0.3, 1]), np.random.default_rng(1)
    x = np.concatenate([rng.uniform(a, b, 50) for a, b in zip(edges, edges[1:])])
    weights = stratum_weights(x, edges, voronoi_weights)
    for low, high in zip(edges, edges[1:]):
        assert weights[(x > low) & (x < high)].sum() == pytest.approx(high - low)
    sums = []
    for _ in range(4000):
        x = np.concatenate([rng.uniform(a, b, 3) for a, b in zip(edges, edges[1:])])
        sums.append(stratum_weights(x, edges) @ np.exp(x))
    assert abs(_z(np.array(sums), np.e - 1)) < 4


# ---- Variance ----


@pytest.mark.parametrize("dimension, least", [(1, 1000), (2, 10)])
def test_weights_lower_the_error_on_smooth_functions(dimension, least):
    def f(x: np.ndarray) -> np.ndarray:
        return np.prod(1 + np.sin(2 * np.pi * x), axis=-1)

    sets = _sets(256, dimension, 60)
    plain = np.mean([(f(x).mean() - 1) ** 2 for x in sets])
    weighted = np.mean([(voronoi_weights(x) @ f(x) - 1) ** 2 for x in sets])
    assert plain > least * weighted


def test_the_tent_removes_the_seam() -> None:
    """On a function that differs at the ends, by orders of magnitude."""
    errors = {"torus": [], "tent": [], "plain": []}
    for x in _sets(256, 1, 100)[..., 0]:
        w = voronoi_weights(x)
        errors["torus"].append(w @ np.exp(x) - np.e + 1)
        errors["tent"].append(w @ np.exp(tent(x)) - np.e + 1)
        errors["plain"].append(np.exp(x).mean() - np.e + 1)
    torus, with_tent, plain = (np.mean(np.square(x)) for x in errors.values())
    assert 100 * with_tent < torus and 30 * torus < plain


# ---- Patterns ----


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dimension, count", [(1, 1), (1, 10), (2, 1), (2, 23), (2, 64), (3, 27)])
def test_patterns_are_uniform_reproducible_and_in_the_cube(pattern, dimension, count):
    x = points(pattern, count, dimension, seed=11)
    assert x.shape == (count, dimension) and x.dtype == np.float64
    assert x.min() >= 0 and np.float32(x.max()) < 1
    np.testing.assert_array_equal(points(pattern, count, dimension, seed=11), x)
    assert (points(pattern, count, dimension, seed=12) != x).any()
    rng = np.random.default_rng(0)
    firsts = np.array([points(pattern, count, dimension, rng)[-1] for _ in range(300)])
    for axis in range(dimension):
        if pattern not in ("sobol", "halton", "stratified", "latin_hypercube"):
            assert stats.kstest(firsts[:, axis], "uniform").pvalue > 6e-5


@pytest.mark.parametrize("dimension, count", [(1, 7), (2, 16), (2, 7), (2, 30), (3, 27), (3, 40)])
def test_stratified_points_have_a_cell_each(dimension, count):
    """Of equal volume where the count is a power."""
    rng = np.random.default_rng(3)
    sets = np.array([points("stratified", count, dimension, rng) for _ in range(2000)])
    edge = int(count ** (1 / dimension) + 1e-9)
    if edge**dimension == count:
        cell = np.floor(sets * edge) @ edge ** np.arange(dimension)
        assert (np.sort(cell, axis=1) == np.arange(count)).all()
    # Each point in a cell of its own: their extents do not overlap
    low, high = sets.min(axis=0), sets.max(axis=0)
    for i, j in itertools.combinations(range(count), 2):
        assert ((high[i] < low[j]) | (high[j] < low[i])).any()


@pytest.mark.parametrize("pattern, factor", [
    ("stratified", 3), ("latin_hypercube", 3), ("halton", 30), ("hammersley", 30), ("sobol", 30),
    ("lattice", 30), ("poisson_disk", 2),
])  # fmt: skip
def test_patterns_integrate_smooth_functions_better_than_chance(pattern, factor):
    rng = np.random.default_rng(8)

    def f(x: np.ndarray) -> np.ndarray:
        return np.exp(x[:, 0] + 0.3 * x[:, 1])

    integral = (np.e - 1) * (np.exp(0.3) - 1) / 0.3

    def error(name: str) -> float:
        return np.mean([(f(points(name, 64, 2, rng)).mean() - integral) ** 2 for _ in range(50)])

    assert factor * error(pattern) < error("independent")
