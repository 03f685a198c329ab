"""Refractive indices against catalogues."""

from __future__ import annotations

import math

import pytest

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before drjit)
from mitsuba_ext.transport.materials.glass import GLASSES, Cauchy, Constant, Sellmeier, check_index

#: Fraunhofer's lines F, d and C, in nm.
F, D, C = 486.1327, 587.5618, 656.2725

#: n_d, Abbe number, and what these are off by: rounding, and, of the last two, other measurements.
CATALOGUE = {
    "bk7": (1.51680, 64.17, 1e-5, 0.01),
    "bak4": (1.56883, 55.98, 1e-5, 0.01),
    "f2": (1.62004, 36.37, 1e-5, 0.01),
    "sf6": (1.80518, 25.43, 1e-5, 0.01),
    "sf10": (1.72825, 28.41, 1e-5, 0.01),
    "sf11": (1.78472, 25.76, 1e-5, 0.01),
    "n-sf6": (1.80518, 25.36, 1e-5, 0.01),
    "n-sf11": (1.78472, 25.68, 1e-5, 0.01),
    "fused silica": (1.45846, 67.82, 1e-5, 0.01),
    "sapphire": (1.7682, 72.3, 1e-4, 0.1),
    "water": (1.3330, 55.8, 5e-4, 0.3),
    "diamond": (2.4175, 55.3, 5e-4, 0.3),
}


@pytest.mark.parametrize("name", GLASSES)
def test_index_and_abbe_number_are_those_of_the_catalogue(name: str) -> None:
    index = GLASSES[name]
    n_d, abbe_number, n_tolerance, abbe_tolerance = CATALOGUE[name]
    assert index(D) == pytest.approx(n_d, abs=n_tolerance)
    assert (index(D) - 1) / (index(F) - index(C)) == pytest.approx(abbe_number, abs=abbe_tolerance)


def test_formulas_are_those_of_cauchy_and_sellmeier() -> None:
    assert Cauchy((1.5, 0.004))(500.0) == pytest.approx(1.5 + 0.004 / 0.25)
    assert Cauchy((1.5, 0.004, 1e-4))(500.0) == pytest.approx(1.5 + 0.004 / 0.25 + 1e-4 / 0.0625)
    assert Sellmeier(((1.2, 0.01),))(500.0) == pytest.approx(math.sqrt(1 + 1.2 * 0.25 / 0.24))


def test_index_ends_where_light_is_not_visible() -> None:
    glass = GLASSES["sf10"]
    assert glass(100.0) == glass(360.0) and glass(2000.0) == glass(830.0)


@pytest.mark.parametrize("index, message", [
    (Sellmeier(((1.0, 0.25),)), "pole at 500 nm"),
    (Sellmeier(((-4.0, 0.01),)), "not a positive number at 360 nm"),
    (Cauchy((-1.0, 0.2)), "not a positive number at 448 nm"),
    (Cauchy((math.nan, 0.2)), "not a positive number"),
    (Constant(0.0), "not a positive number"),
])  # fmt: skip
def test_impossible_indices_are_refused(index, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_index(index)
