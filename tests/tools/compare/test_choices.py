"""The errors by which ``benchmarks/choices.py`` compares integrators, for made-up images."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext.compare.references import Reference
from tests.support.paths import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
from choices import errors, errors_to, gain  # noqa: E402

_SHAPE = (40, 60, 3)


def _images(rng: np.random.Generator, noise: float, sparks: int = 0) -> list[np.ndarray]:
    """Three renders of a scene whose radiance is 1 everywhere, with ``sparks`` pixels that are far
    too bright."""
    images = [rng.normal(1.0, noise, _SHAPE) for _ in range(3)]
    for image in images:
        image.reshape(-1, 3)[rng.choice(40 * 60, sparks, replace=False)] += 30.0
    return images


def test_errors_are_the_relative_variance_of_one_render() -> None:
    rng = np.random.default_rng(1)
    found = errors({"path": _images(rng, 0.2), "auto": _images(rng, 0.1)})
    assert found["path"].mean() == pytest.approx(0.04 / 1.01, rel=0.1)
    assert found["auto"].mean() == pytest.approx(0.01 / 1.01, rel=0.1)


def test_sparks_count_the_same_in_each_integrator() -> None:
    rng = np.random.default_rng(2)
    found = errors({"path": _images(rng, 0.1, 24), "auto": _images(rng, 0.1, 24)})
    assert found["auto"].mean() == pytest.approx(found["path"].mean(), rel=0.1)


def test_light_that_path_misses_is_an_error_of_path() -> None:
    rng = np.random.default_rng(3)
    dark = [image - 0.5 for image in _images(rng, 0.1)]
    found = errors({"path": dark, "auto": _images(rng, 0.1)})
    assert found["path"].mean() == pytest.approx((0.25 + 0.01) / 1.01, rel=0.1)
    assert found["auto"].mean() == pytest.approx(0.01 / 1.01, rel=0.1)


def test_noise_of_the_reference_is_no_error() -> None:
    rng = np.random.default_rng(4)
    reference = Reference(rng.normal(1.0, 0.1, _SHAPE), np.full(_SHAPE, 0.01), Path())
    found = errors_to(reference, {"path": np.array(_images(rng, 0.2))})
    assert found["path"].mean() == pytest.approx(0.04 / 1.01, rel=0.1)


def test_gain_is_the_ratio_of_error_times_time() -> None:
    made = {"path": {"error": 4.0, "time": 2.0}, "auto": {"error": 1.0, "time": 4.0}}
    assert gain({"cpu": False, "integrators": made}, "auto") == pytest.approx(2.0)
