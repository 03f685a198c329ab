"""The evidence that learning is worth its time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.evidence import (
    BATCHES,
    TRIM,
    PathSums,
    gain_of,
    trimmed_batches,
)
from mitsuba_ext.planning.verdicts import best, is_worth


def _paths(seed: int, count: int = 1 << 14) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors, and by how much they would be larger: half as much again, on average."""
    rng = np.random.default_rng(seed)
    return rng.exponential(2.0, count), rng.exponential(1.0, count)


def test_gain_is_the_share_of_the_variance_that_a_decision_removes() -> None:
    gain, _error = gain_of(trimmed_batches(*_paths(1, 1 << 18)))
    assert gain == pytest.approx(1 / 3, abs=0.01)


def test_error_of_a_gain_is_its_scatter() -> None:
    found = np.array([gain_of(trimmed_batches(*_paths(seed))) for seed in range(200)])
    scatter = np.log(1 - found[:, 0]).std(ddof=1)
    assert found[:, 1].mean() == pytest.approx(scatter, rel=0.15)


def test_the_brightest_paths_do_not_decide_alone() -> None:
    error, more = _paths(1, TRIM)
    expected = gain_of(trimmed_batches(error, more))[0]
    more[17] = 1e9
    assert gain_of(trimmed_batches(error, more))[0] == pytest.approx(expected, abs=0.01)
    more[17] = np.inf
    assert gain_of(trimmed_batches(error, more))[0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("sums", [np.zeros((2, BATCHES)), -np.ones((2, BATCHES))])
def test_without_variance_there_is_no_gain(sums: np.ndarray) -> None:
    assert gain_of(sums) == (0.0, 0.0)


def test_uncertain_gains_count_less() -> None:
    assert is_worth(1.1, 0.0, 1.03) and is_worth(1.1, 0.5, 1.03)
    assert not is_worth(1.1, 1.0, 1.03) and not is_worth(1.02, 0.0, 1.03)
    # Noisy pilots, but much to gain
    assert is_worth(1.6, 0.8, 1.03)
    assert not is_worth(0.0, 0.0, 1.03)


def test_one_path_of_a_small_pass_is_left_out() -> None:
    error, more = _paths(1, 512)
    expected = gain_of(trimmed_batches(error, more))[0]
    error[3] = 1e9
    assert gain_of(trimmed_batches(error, more))[0] == pytest.approx(expected, abs=0.02)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("count", [1, 700, TRIM, 5 * TRIM + 77])
def test_sums_on_the_device_leave_out_the_same_paths(count: int) -> None:
    """Also where one path is 10⁹ times as bright as the others."""
    sums, expected, total, rng = PathSums(1), 0.0, 0.0, np.random.default_rng(count)
    for seed in range(2):
        error, more = (x.astype(np.float32) for x in _paths(seed, count))
        error[rng.integers(count)], other = 1e9, rng.random(count).astype(np.float32)
        expected += trimmed_batches(error.astype(np.float64), more.astype(np.float64))
        total += np.array([x.sum(dtype=np.float64) for x in (error, more, other)])
        sums.add(*(mi.Float(x) for x in (error, more, other)))
    batches, found = sums.read()
    np.testing.assert_allclose(batches, expected, rtol=1e-12)
    np.testing.assert_allclose(found, total, rtol=1e-12)


@pytest.mark.usefixtures("variant")
def test_few_of_many_equal_paths_are_left_out() -> None:
    sums, ones = PathSums(0), dr.full(mi.Float, 1, 4 * TRIM)
    sums.add(ones, ones)
    assert sums.read()[0].sum(axis=1) == pytest.approx(4 * TRIM - 4)


@pytest.mark.parametrize(("error", "chosen"), [(0.1, 2), (1.0, 1), (3.0, 0)])
def test_light_paths_must_gain_more_where_the_prediction_is_uncertain(
    error: float, chosen: int
) -> None:
    """Merging seems to be twice as efficient as ``path``; light paths are better by a fifth."""
    efficiencies, errors = np.array([1.0, 1.2, 2.0]), [0.0, error / 4, error]
    assert best(efficiencies, errors, 1.0, [1.0, 1.0, 1.0])[0] == chosen
