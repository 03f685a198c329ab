"""Where rays start that leave a surface: as Mitsuba's, but closer in small scenes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from stage import lookat, sensor, stage

from mitsuba_ext.decisions.query.scene import scene_query
from mitsuba_ext.transport.ray_starts import RayStarts, ray_starts

pytestmark = pytest.mark.usefixtures("variant")


def _scaled(factor: float, **changes) -> mi.Scene:
    return mi.load_dict(stage(mi.ScalarTransform4f().scale(factor), **changes))


def _interaction() -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.n = mi.Point3f(1e-3, 2e-3, 3e-3), mi.Normal3f(0, 0, 1)
    return si


def _height(ray: mi.Ray3f) -> float:
    return (ray.o.z - 3e-3)[0] / mi.math.RayEpsilon


@pytest.mark.parametrize("factor", [1, 0.5, 1e4])
def test_rays_are_those_of_mitsuba_in_scenes_that_are_not_small(factor):
    assert scene_query(_scaled(factor)).starts == RayStarts()
    si, target = _interaction(), mi.Point3f(1e-3, 3e-3, 5e-3)
    starts = RayStarts()
    ray, expected = starts.towards(si, target), si.spawn_ray_to(target)
    assert dr.all(ray.o == expected.o) and dr.all(ray.maxt == expected.maxt)
    assert dr.all(starts.along(si, mi.Vector3f(0, 0, 1)).o == si.spawn_ray(mi.Vector3f(0, 0, 1)).o)


def test_rays_of_a_small_scene_start_as_close_as_those_of_its_enlarged_copy():
    starts = scene_query(_scaled(1e-3)).starts
    assert starts.unit == pytest.approx(4e-3)  # up to the camera
    si, up = _interaction(), mi.Vector3f(0, 0, 1)
    assert _height(starts.along(si, up)) == pytest.approx(7e-3, rel=1e-2)
    assert _height(starts.along(si, -up)) == pytest.approx(-7e-3, rel=1e-2)
    # They end before the target, where they are aimed at
    target = mi.Point3f(1e-3, 3e-3, 5e-3)
    ray = starts.towards(si, target)
    assert np.allclose(ray(ray.maxt / (1 - mi.math.ShadowEpsilon)), target, rtol=1e-5)
    assert dr.norm(ray.d)[0] == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("far", ["camera", "spot"])
def test_what_is_seen_or_lit_from_afar_keeps_mitsubas_offset(far):
    """Its points are rounded too much."""
    view = lookat([0, -4, 1.2], [0, 0, 0], [0, 0, 1])
    changes = {"camera": sensor(to_world=view)} if far == "camera" else {
        "projector": {"type": "projector", "to_world": view, "irradiance": 1.0}}  # fmt: skip
    assert ray_starts(_scaled(1e-3, **changes)) == RayStarts()
