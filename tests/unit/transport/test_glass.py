"""Refractive indices against catalogues, and the surfaces of a glass of water."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.materials.glass import GLASSES, Cauchy, Constant, Sellmeier, check_index
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

#: Fraunhofer's lines F, d and C, in nm.
F, D, C = 486.1327, 587.5618, 656.2725

#: n_d, Abbe number, and their tolerances: rounding, and other measurements in the last two rows.
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
def test_index_and_abbe_number_agree_with_the_catalogue(name: str) -> None:
    index = GLASSES[name]
    n_d, abbe_number, n_tolerance, abbe_tolerance = CATALOGUE[name]
    assert index(D) == pytest.approx(n_d, abs=n_tolerance)
    assert (index(D) - 1) / (index(F) - index(C)) == pytest.approx(abbe_number, abs=abbe_tolerance)


def test_indices_follow_the_formulas_of_cauchy_and_sellmeier() -> None:
    assert Cauchy((1.5, 0.004))(500.0) == pytest.approx(1.5 + 0.004 / 0.25)
    assert Cauchy((1.5, 0.004, 1e-4))(500.0) == pytest.approx(1.5 + 0.004 / 0.25 + 1e-4 / 0.0625)
    assert Sellmeier(((1.2, 0.01),))(500.0) == pytest.approx(math.sqrt(1 + 1.2 * 0.25 / 0.24))


def test_index_is_constant_outside_the_visible_wavelengths() -> None:
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


# ---- The surfaces of scenes/water_glass.xml ----

AIR, GLASS, WATER = range(3)

#: For each file, the medium on the side of the normal, and the medium on the other side.
SIDES = {"tumbler": (AIR, GLASS), "tumbler_wet": (WATER, GLASS), "tumbler_water": (AIR, WATER)}


@pytest.mark.slow
def test_a_straight_ray_leaves_the_medium_that_it_entered(scenes) -> None:
    shapes = {
        name: {"type": "ply", "filename": str(scenes / f"assets/{name}.ply")} for name in SIDES
    }
    scene = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    draw = np.random.default_rng(1)
    target, d = draw.uniform(-0.05, 0.05, (3, 4096)), draw.normal(size=(3, 4096))
    d = mi.Vector3f(d / np.linalg.norm(d, axis=0))
    ray = mi.Ray3f(mi.Point3f(target) + mi.Vector3f(0, 0, 0.055) - d, d)
    medium, hits, wrong = dr.full(mi.Int32, AIR, 4096), 0, 0
    for _ in range(8):
        si, found = scene.ray_intersect(ray), mi.Int32(medium)
        enters = dr.dot(si.n, ray.d) < 0
        for (before, behind), shape in zip(SIDES.values(), scene.shapes()):
            here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
            hits += dr.count(here)[0]
            wrong += dr.count(here & (found != dr.select(enters, before, behind)))[0]
            medium = dr.select(here, dr.select(enters, behind, before), medium)
        ray = dr.select(si.is_valid(), si.spawn_ray(ray.d), ray)
        ray.o = dr.select(si.is_valid(), ray.o, mi.Point3f(9))
    # A few rays touch an edge, where rounding decides
    assert dr.all(medium == AIR) and hits > 8000 and wrong <= 4


def test_the_scene_has_the_refractive_indices_of_glass_water_and_air() -> None:
    scene = load("water_glass", width=8, height=8)
    params = mi.traverse(scene)
    etas = sorted(v for k, v in params if k in ("glass.eta", "glass_in_water.eta", "water.eta"))
    glass, water, air = 1.5046, 1.333, 1.000277
    assert etas == pytest.approx([glass / water, water / air, glass / air], rel=1e-3)
