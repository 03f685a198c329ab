"""Closed scenes with an exact answer: the sum over path lengths and all weights add up."""

from __future__ import annotations

import importlib.util
import sys

import pytest
from statistical import (
    REFERENCE,
    SCENES,
    SEEDS,
    UNDER_TEST,
    UNUSUAL,
    UnderTest,
    assert_exact,
    batches,
    load,
)

pytestmark = pytest.mark.usefixtures("variant")


def _furnaces():
    specification = importlib.util.spec_from_file_location("furnaces", SCENES / "furnaces.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules["furnaces"] = module
    specification.loader.exec_module(module)
    return {furnace.path.stem: furnace for furnace in module.FURNACES}


FURNACES = _furnaces()
DEPTHS = (1, 2, 3, 6, -1)
SIZE = 32
SPP = 64

CASES = [
    (furnace, name, max_depth)
    for furnace in FURNACES
    for name in UNDER_TEST
    for max_depth in DEPTHS
    if UNDER_TEST[name].can_render(max_depth)
    # Learning takes its time: one guided direction, two, and all
    and not (UNDER_TEST[name].insists and max_depth in (1, 6))
    and any(region.exact(max_depth) is not None for region in FURNACES[furnace].regions)
]


def _check(furnace: str, integrator: UnderTest, max_depth: int, precision: float = 0.002) -> None:
    scene = load(furnace, width=SIZE, height=SIZE)
    images = batches(scene, integrator.make(max_depth), SPP, SEEDS[:8])
    for region in FURNACES[furnace].regions:
        exact = region.exact(max_depth)
        if exact is not None:
            pixels, uniform = region.pixels(SIZE, SIZE), region.uniform(max_depth)
            assert_exact(images, exact, pixels, uniform, region.allowance, precision)


@pytest.mark.parametrize(("furnace", "name", "max_depth"), CASES)
def test_furnace_has_the_exact_radiance(furnace: str, name: str, max_depth: int) -> None:
    _check(furnace, UNDER_TEST[name], max_depth)


@pytest.mark.parametrize("furnace", FURNACES)
def test_path_has_the_exact_radiance(furnace: str) -> None:
    """The answers themselves, checked once against Mitsuba."""
    _check(furnace, REFERENCE, -1)


@pytest.mark.parametrize("furnace", ["furnace_lamps", "furnace_isothermal"])
@pytest.mark.parametrize("name", ["rejecting_floor", "mapped_floor"])
def test_rejecting_nine_of_ten_shadow_rays_keeps_the_exact_radiance(
    furnace: str, name: str
) -> None:
    _check(furnace, UNUSUAL[name], -1, precision=0.01)
