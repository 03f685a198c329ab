"""Cells of emitters: lights are divided into cells, and a point is found again in its cell."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lights.division import divide
from mitsuba_ext.scene.lights.light_cells import LightCells
from tests.support.lights import (
    LANES,
    SCALED,
    SHAPES,
    WHOLE,
    WHOLE_LIGHTS,
    Samples,
    ball,
    mixed_scene,
    samples_of,
    scene_with,
)

pytestmark = pytest.mark.usefixtures("variant")


# ---- Division ----


@pytest.mark.parametrize("name", SHAPES)
def test_the_cells_of_a_light_share_all_of_it(name):
    share = samples_of(name).share
    assert share.sum() == pytest.approx(1) and (share > 0).all()
    assert len(share) == 1 if name in WHOLE else 4 < len(share) <= 64


@pytest.mark.parametrize("name", ["slanted", "two triangles", "tube", "many faces"])
def test_cells_are_not_much_longer_than_a_voxel(name):
    voxel = 1.0
    scene = scene_with({name: SHAPES[name]()})
    cells = LightCells(scene, mi.Vector3f(voxel))
    n = 4096
    rng = mi.PCG32(size=n * cells.count)
    ref = dr.zeros(mi.Interaction3f, n * cells.count)
    cell = dr.arange(mi.UInt32, n * cells.count) // n
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    p = cells.sample(cell, ref, sample, mi.Bool(True))[0].p.numpy().reshape(3, cells.count, n)
    assert 1 < cells.count < 64 and np.ptp(p, axis=2).max() < 1.5 * voxel


def test_a_thousand_lights_are_not_divided():
    T = mi.ScalarTransform4f()
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    lamps = {
        f"lamp_{k}": {**lamp, "to_world": T.translate([3 * k, 0, 0])} for k in range(1000)
    }
    cells = LightCells(mi.load_dict({"type": "scene", **lamps}), mi.Vector3f(0.1))
    assert cells.count == 1000 and cells.emitter_index.tolist() == list(range(1000))


@pytest.mark.parametrize("name", [k for k in WHOLE_LIGHTS if k != "directional environment"])
def test_other_lights_stay_whole_and_are_sampled_as_mitsuba_does(name):
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "l": WHOLE_LIGHTS[name]()})
    cells = LightCells(scene, mi.Vector3f(0.1))
    assert cells.count == 1 and cells.share.tolist() == [1] and cells.emitter_index.tolist() == [0]
    rng = mi.PCG32(size=1000)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ref = dr.zeros(mi.Interaction3f, 1000)
    ds, weight = cells.sample(mi.UInt32(0), ref, sample, mi.Bool(True))
    ds_theirs, weight_theirs = scene.emitters()[0].sample_direction(ref, sample)
    assert bool(dr.all(dr.all(weight == weight_theirs)))
    assert bool(dr.all(dr.all(ds.p == ds_theirs.p)))
    seen = dr.max(weight) > 0
    assert bool(dr.any(seen)) or name == "directionalarea"
    si = scene.ray_intersect(mi.Ray3f(ref.p + ds.d * 0.99 * ds.dist, ds.d))
    cell, pdf = cells.pdf(ref, si, mi.DirectionSample3f(scene, si, ref), si.is_valid())
    assert bool(dr.all(cell == 0)) and bool(dr.all(dr.isfinite(pdf) & (pdf >= 0)))
    if name == "textured":
        assert bool(dr.all(~seen | (dr.abs(pdf / ds_theirs.pdf - 1) < 1e-3)))


def test_cells_keep_their_scene_alive():
    """An emitter that outlives its shape ends the process in any scene's next call of emitters."""
    slanted = {"slanted": SHAPES["slanted"]()}
    cells = [LightCells(scene_with(slanted), v) for v in (None, mi.Vector3f(0.5))]
    gc.collect()
    mixed = LightCells(mixed_scene(), None)
    for c in (*cells, mixed):
        ref = dr.zeros(mi.Interaction3f, 10)
        sample = mi.Point2f(dr.linspace(mi.Float, 0.1, 0.9, 10), 0.5)
        assert bool(dr.all(c.sample(mi.UInt32(0), ref, sample, mi.Bool(True))[0].pdf > 0))


# ---- Points found again ----


@pytest.mark.parametrize("name", SHAPES)
def test_a_sampled_point_is_found_in_its_cell_with_its_density(name):
    _assert_found(samples_of(name), wrong_cell=1e-4, wrong_pdf=1e-4)


@pytest.mark.parametrize("scale, offset", [(1e-3, 0), (1e4, 0), (1, 1e3)])
@pytest.mark.parametrize("name", SCALED)
def test_cells_are_found_in_small_large_and_distant_scenes(name, scale, offset):
    s = samples_of(name, scale, offset)
    assert len(s.share) == len(samples_of(name).share)
    # A thousand times its size from the origin, the light's own points are rounded
    _assert_found(s, *((6e-3, 1e-2) if offset else (3e-4, 3e-4)))


def _assert_found(s: Samples, wrong_cell: float, wrong_pdf: float) -> None:
    # Where the light is seen at a grazing angle, rounding moves points and their cosines
    seen = s.visible & (s.cosine > 0.05)
    assert seen.mean() > 0.05
    assert np.mean(s.found_cell[seen] != s.cell[seen]) < wrong_cell
    assert np.mean(np.abs(s.found_pdf[seen] / s.pdf[seen] - 1) > 1e-2) < wrong_pdf


def test_a_large_mesh_is_divided_into_few_cells():
    scene = scene_with({"ball": ball(320, 160)})
    assert scene.shapes()[0].face_count() > 100_000
    division = divide(scene, np.full(3, 0.01))[0]
    assert 32 < len(division.cell_sizes) <= 64
    cells = LightCells(scene, mi.Vector3f(0.01))
    rng = mi.PCG32(size=LANES)
    cell = dr.minimum(mi.UInt32(rng.next_float32() * cells.count), cells.count - 1)
    ref = dr.zeros(mi.Interaction3f, LANES)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ds, weight = cells.sample(cell, ref, sample, mi.Bool(True))
    si = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
    seen = (weight.x > 0) & (dr.abs(si.t - ds.dist) < 3e-5 * ds.dist)
    seen &= dr.abs(dr.dot(ds.d, si.n)) > 0.05
    found, _pdf = cells.pdf(ref, si, mi.DirectionSample3f(scene, si, ref), seen)
    # Mitsuba's sums over a hundred thousand faces are rounded: a cell has to begin where they say
    assert np.mean((found != cell).numpy()[seen.numpy()]) < 1e-4
