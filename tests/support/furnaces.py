"""Furnaces: closed scenes whose radiance is known exactly."""

from __future__ import annotations

import importlib.util
import sys

from tests.support.statistical import MANY_SEEDS, SCENES, SEEDS, assert_exact, batches, load
from tests.support.technique import Technique


def _furnaces():
    specification = importlib.util.spec_from_file_location("furnaces", SCENES / "furnaces.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules["furnaces"] = module
    specification.loader.exec_module(module)
    return {furnace.path.stem: furnace for furnace in module.FURNACES}


#: The furnaces of ``scenes/furnaces.py``, by the names of their scenes.
FURNACES = _furnaces()

#: Width and height of the films.
SIZE = 32

#: Samples per pixel.
SPP = 256


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
