"""Closed scenes with an exact answer: path lengths and MIS weights add up."""

from __future__ import annotations

import importlib.util
import sys

import pytest
from statistical import MANY_SEEDS, SCENES, SEEDS, assert_exact, batches, load
from technique import FURNACES as NAMES
from technique import Technique
from techniques import REFERENCE, TECHNIQUES, pairs

pytestmark = pytest.mark.usefixtures("variant")


def _furnaces():
    specification = importlib.util.spec_from_file_location("furnaces", SCENES / "furnaces.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules["furnaces"] = module
    specification.loader.exec_module(module)
    return {furnace.path.stem: furnace for furnace in module.FURNACES}


FURNACES = _furnaces()
SIZE = 32
SPP = 256


def _has_answer(furnace: str, max_depth: int) -> bool:
    return any(region.exact(max_depth) is not None for region in FURNACES[furnace].regions)


def check_furnace(
    furnace: str, technique: Technique, max_depth: int, precision: float = 0.002
) -> None:
    """Fails if the radiance of a furnace is not the exact one."""
    regions = [r for r in FURNACES[furnace].regions if r.exact(max_depth) is not None]
    scene = load(furnace, width=SIZE, height=SIZE)
    spp, seeds = (SPP // 4, MANY_SEEDS) if technique.makes_splats else (SPP, 2)
    images = batches(scene, technique.make(max_depth), spp, SEEDS[:seeds])
    for region in regions:
        assert_exact(
            images, region.exact(max_depth), region.pixels(SIZE, SIZE), region.uniform(max_depth),
            region.allowance, precision, independent=not technique.makes_splats,
        )  # fmt: skip


def test_every_furnace_is_in_the_table() -> None:
    assert set(FURNACES) == set(NAMES)


@pytest.mark.parametrize(
    ("furnace", "max_depth", "name"),
    [case for case in pairs("furnaces", "depths") if _has_answer(*case.values[:2])],
)
def test_furnace_has_the_exact_radiance(furnace: str, max_depth: int, name: str) -> None:
    # Where nine of ten shadow rays are rejected, there is noise; and where light paths miss things
    precision = 0.01 if TECHNIQUES[name].parameters.get("floor") else 0.002
    precision = 0.02 if name == "light_tracer" else precision
    check_furnace(furnace, TECHNIQUES[name], max_depth, precision)


@pytest.mark.slow
@pytest.mark.parametrize("furnace", FURNACES)
def test_path_has_the_exact_radiance(furnace: str) -> None:
    """The answers themselves, checked once against Mitsuba."""
    check_furnace(furnace, REFERENCE, -1)
