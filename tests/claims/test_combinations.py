"""Decisions can be combined: any two of them, in one integrator, are unbiased."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.combinations import FACTORS, covering_array
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_exact,
    assert_same_pixels_on_average,
    batches,
    two_halves,
)

pytestmark = pytest.mark.usefixtures("variant")

ROWS = covering_array(FACTORS)

#: The number of rows that ``make test`` renders, in each of two tests.
_QUICK = 2

_OPTICS = {
    "aperture_radius": 0.1, "focus_distance": 3.0, "shutter_open": 0.25, "shutter_close": 0.75,
}  # fmt: skip

_SPIN = {"axis": [1.0, 2.0, 0.5], "angle": 200.0, "translate": [0.3, 0.0, 0.1]}


def _slots(row: dict[str, str]) -> dict[str, Any]:
    slots: dict[str, Any] = {}
    for factor, choice in row.items():
        slots |= FACTORS[factor][choice]
    return slots


def _integrator(row: dict[str, str], max_depth: int) -> mi.Integrator:
    slots = _slots(row)
    if not mi.is_spectral:
        slots.pop("wavelength", None)
    return mi.load_dict({"type": "composed_path", "max_depth": max_depth, **slots})


def _cases(offset: int) -> list:
    """The variant and the number of each row; other rows are quick for another ``offset``."""
    cases = []
    for index, row in enumerate(ROWS):
        variant = "llvm_ad_spectral" if "wavelength" in _slots(row) else "llvm_ad_rgb"
        is_quick = index % (len(ROWS) // _QUICK) == offset and variant == "llvm_ad_rgb"
        marks = () if is_quick else pytest.mark.slow
        name = "-".join(row.values())
        cases.append(pytest.param(variant, index, id=name, marks=marks))
    return cases


def _moving(choice: str, child: dict[str, Any], plugin: str = "moving") -> dict[str, Any]:
    return {"type": plugin, **_SPIN, "child": child} if choice == "moving" else child


def _camera(choice: str, *arguments: Any, **changes: Any) -> dict[str, Any]:
    still = sensor("thinlens", *arguments, **_OPTICS, **changes)
    if choice != "moving":
        return still
    return {"type": "moving_camera", "translate": [0.1, 0.05, 0.0], "child": still}


# ---- Exact ----


def _furnace(choice: str) -> mi.Scene:
    """A room whose walls emit what they absorb: the radiance is 1 everywhere, also on the white
    things in it, and on what moves there and emits what it absorbs itself."""
    T = mi.ScalarTransform4f
    wall = {"bsdf": diffuse(0.5), "emitter": area(0.5)}
    turns = {
        "back": ([1, 0, 0], 0), "front": ([1, 0, 0], 180), "floor": ([1, 0, 0], -90),
        "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90), "right": ([0, 1, 0], -90),
    }  # fmt: skip
    walls = {
        name: rectangle(T().rotate(axis, angle), T().translate([0, 0, -2]).scale([2, 2, 1]), **wall)
        for name, (axis, angle) in turns.items()
    }
    camera = _camera(choice, lookat([0, 0, 1.8], [0, 0, 0], [0, 1, 0]), film=film())
    skin = wall if choice == "moving" else {"bsdf": diffuse(1.0)}
    cube = {"type": "cube", "to_world": T().translate([-0.5, 0.1, 0]).scale(0.35), **skin}
    ball = {"type": "sphere", "center": [0.7, 0.1, 0.0], "radius": 0.4,
            "bsdf": {"type": "conductor", "material": "none"}}  # fmt: skip
    return mi.load_dict({
        "type": "scene", "sensor": camera, **walls, "cube": _moving(choice, cube), "ball": ball,
    })  # fmt: skip


@pytest.mark.parametrize("variant, index", _cases(0), indirect=["variant"])
def test_furnace_has_the_exact_radiance(variant: str, index: int) -> None:
    row = ROWS[index]
    scene, integrator = _furnace(row["scene"]), _integrator(row, -1)
    images = batches(scene, integrator, 256, SEEDS[:2])
    # The three colours of a spectrum of one are not exactly one
    allowance = 2e-3 if variant == "llvm_ad_spectral" else 0.0
    assert_exact(images, 1.0, allowance=allowance, precision=0.004)
    _assert_all_is_used(row, integrator)


def _assert_all_is_used(row: dict[str, str], integrator: mi.Integrator) -> None:
    """Without this check, a correct mean would say little."""
    if row["directions"] != "uniform":
        assert integrator.learners["directions"].guide is not None
    if row["next_event"] in ("visibility", "contribution") and row["connections"] != "none":
        assert "as path" not in str(integrator.learners["next_event"])


# ---- The mean of ``path`` ----


def _lamps(choice: str) -> mi.Scene:
    T = mi.ScalarTransform4f
    lamp = rectangle(
        T().translate([1, 0.5, 1.6]).rotate([1, 0, 0], 180).scale([0.5, 0.3, 1]),
        bsdf=diffuse(0.0), emitter=area(2.0),
    )  # fmt: skip
    point = {"type": "point", "position": [-1, -1, 1.5], "intensity": 0.7}
    block = {"type": "cube", "bsdf": diffuse(0.3, 0.6, 0.3),
             "to_world": T().translate([0.5, 0, 0.4]).scale([0.3, 0.3, 0.4])}  # fmt: skip
    camera = _camera(choice, film=film(20, 16))
    point, block = _moving(choice, point, "moving_light"), _moving(choice, block)
    return mi.load_dict(
        stage(camera=camera, lamp=_moving(choice, lamp), point=point, block=block)
    )


@functools.cache
def _expected(variant: str, choice: str) -> np.ndarray:
    """Mitsuba's ``path`` knows no motion: there, the same with all defaults, which other tests
    compare with averages over resting scenes."""
    plugin = "path" if choice == "static" else "composed_path"
    integrator = mi.load_dict({"type": plugin, "max_depth": 4})
    return two_halves(_lamps(choice), integrator, 4096, REFERENCE_SEEDS)


@pytest.mark.parametrize("variant, index", _cases(1), indirect=["variant"])
def test_mean_agrees_with_path(variant: str, index: int) -> None:
    row = ROWS[index]
    expected = _expected(variant, row["scene"])
    integrator = _integrator(row, 4)
    images = two_halves(_lamps(row["scene"]), integrator, 1024, SEEDS)
    precision = 0.03 if row["connections"] == "none" else 0.018
    # Colours of single wavelengths are outside of the gamut
    tolerance = 9.0 if variant == "llvm_ad_spectral" else 0.0
    assert_same_pixels_on_average(images, expected, precision, tolerance=tolerance)
    _assert_all_is_used(row, integrator)


# ---- The array ----


def test_any_two_choices_are_in_one_row() -> None:
    assert len(ROWS) <= 1.6 * 6 * 5
    for (a, choices), (b, others) in itertools.combinations(FACTORS.items(), 2):
        found = {(row[a], row[b]) for row in ROWS}
        assert found == set(itertools.product(choices, others)), (a, b)
