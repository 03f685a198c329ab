"""The surfaces of scenes/water_glass.xml: glass, water and air meet as they should."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

AIR, GLASS, WATER = range(3)

#: For each file, what is before the surface (where its normal points) and what is behind it.
SIDES = {"tumbler": (AIR, GLASS), "tumbler_wet": (WATER, GLASS), "tumbler_water": (AIR, WATER)}


@pytest.mark.slow
def test_a_straight_ray_leaves_what_it_has_entered(scenes) -> None:
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


def test_the_refractive_indices_are_those_of_glass_water_and_air() -> None:
    scene = load("water_glass", width=8, height=8)
    params = mi.traverse(scene)
    etas = sorted(v for k, v in params if k in ("glass.eta", "glass_in_water.eta", "water.eta"))
    glass, water, air = 1.5046, 1.333, 1.000277
    assert etas == pytest.approx([glass / water, water / air, glass / air], rel=1e-3)
