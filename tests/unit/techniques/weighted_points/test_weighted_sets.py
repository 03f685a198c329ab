"""Weighted sets in device memory, and the numbers that kernels draw from them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.techniques.weighted_points.weighted_sets import WEIGHTS, WeightedSets
from mitsuba_ext.util.pointsets import PATTERNS, voronoi_weights

pytestmark = pytest.mark.usefixtures("variant")


def _drawn(sets: WeightedSets, users: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Whole sets for each user: points [user, N, D], and weights [user, N]."""
    rng = np.random.default_rng(seed)
    number = sets.choose(mi.Float(np.repeat(rng.random(users, np.float32), sets.count)))
    shift = mi.Point2f(np.repeat(rng.random((2, users), np.float32), sets.count, axis=1))
    index = dr.tile(dr.arange(mi.UInt32, sets.count), users)
    u, weight = sets.draw(number, shift, index, mi.Bool(True))
    dimension = 2 if isinstance(u, mi.Point2f) else 1
    u = np.asarray(u.numpy()).reshape(dimension, users, sets.count)
    weight = dr.full(mi.Float, 1.0, users * sets.count) * weight  # it may be the number 1.0
    return np.moveaxis(u, 0, -1), weight.numpy().reshape(users, sets.count)


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dimension", [1, 2])
def test_weights_of_a_set_add_up_to_one(pattern, weights, dimension):
    if dimension == 1 and pattern not in ("independent", "lattice"):
        pytest.skip("the same code")
    for count in (1, 2, 15):
        sets = WeightedSets(pattern, weights, count, dimension, seed=3)
        u, weight = _drawn(sets, 100)
        assert u.min() >= 0 and u.max() < 1 and weight.min() > 0
        np.testing.assert_allclose(weight.mean(axis=1), 1, rtol=1e-5)
        if weights == "none":
            np.testing.assert_array_equal(weight, 1)


@pytest.mark.parametrize("weights", ["none", "torus", "unbiased"])
def test_each_point_is_uniform_whatever_its_weight(weights):
    sets = WeightedSets("stratified", weights, 9, 2, seed=1)
    u, weight = _drawn(sets, 20_000)
    for index in (0, 8):
        for axis in range(2):
            assert stats.kstest(u[:, index, axis], "uniform").pvalue > 6e-5
    # The mean weight does not depend on the position
    for region in (u < 0.1).all(axis=-1), (np.abs(u - 0.5) < 0.2).all(axis=-1):
        sums = (weight * region).mean(axis=1) - region.mean()
        expected = (0.1**2, 0.4**2)[int(region.mean() > 0.05)]
        z = ((weight * region).mean(axis=1).mean() - expected) / (
            sums.std(ddof=1) / np.sqrt(len(sums))
        )
        assert abs(z) < 4


def test_seeds_give_sets_of_their_own() -> None:
    u, weight = _drawn(WeightedSets("independent", "voronoi", 16, 2, seed=5), 50)
    again, _ = _drawn(WeightedSets("independent", "voronoi", 16, 2, seed=5), 50)
    other, _ = _drawn(WeightedSets("independent", "voronoi", 16, 2, seed=6), 50)
    np.testing.assert_array_equal(u, again)
    assert not np.isclose(u, other).any()
    # Several sets, not one: users differ, although nothing is shifted
    assert len(np.unique(u[:, 0, 0])) > 10


def test_all_sets_are_used_alike() -> None:
    sets = WeightedSets("independent", "none", 16, 2, seed=5)
    sample = mi.Float((np.arange(3200) + 0.5) / 3200)
    assert (np.bincount(sets.choose(sample).numpy()) == 100).all()
    assert sets.choose(mi.Float(np.nextafter(np.float32(1), np.float32(0)))).numpy() == 31


def test_weights_belong_to_the_points_that_are_drawn() -> None:
    for kind, boundary in (("voronoi", "clip"), ("torus", "torus")):
        u, weight = _drawn(WeightedSets("independent", kind, 8, 2, seed=1), 5)
        for x, w in zip(u, weight):
            np.testing.assert_allclose(w, 8 * voronoi_weights(x, boundary), rtol=1e-4)


def test_only_voronoi_points_stay_where_they_are() -> None:
    for kind in WEIGHTS:
        u, _ = _drawn(WeightedSets("poisson_disk", kind, 8, 2, seed=1), 20)
        assert (len(np.unique(u[:, 0, 0].round(5))) <= 2) == (kind == "voronoi")


def test_the_order_of_points_is_random() -> None:
    """The order of the points must not be correlated with the order of samplers or of other
    sets."""
    u, _ = _drawn(WeightedSets("lattice", "voronoi", 64, 1, seed=1), 50)
    first = u[:, :8, 0].mean(axis=1)
    assert abs(first.mean() - 0.5) < 0.1 and first.std() > 0.05


def test_a_second_weight_belongs_to_places_modulo_a_period() -> None:
    sets = WeightedSets("independent", "torus", 12, 1, seed=3, periods=4)
    index, zero = dr.arange(mi.UInt32, 12), dr.zeros(mi.UInt32, 12)
    u, weight, folded = sets.draw(zero, mi.Point2f(0.3), index, mi.Bool(True))
    np.testing.assert_allclose(weight, 12 * voronoi_weights(u.numpy()), rtol=1e-4)
    np.testing.assert_allclose(folded, 12 * voronoi_weights(u.numpy() * 4 % 1), rtol=1e-3)
    # Groups of four equidistant points coincide modulo 1/4: none of them has the weight zero
    sets = WeightedSets("lattice", "torus", 64, 1, seed=3, periods=4)
    index, zero = dr.arange(mi.UInt32, 64), dr.zeros(mi.UInt32, 64)
    _u, _weight, folded = sets.draw(zero, mi.Point2f(0.3), index, mi.Bool(True))
    np.testing.assert_allclose(folded, 1, rtol=1e-3)
