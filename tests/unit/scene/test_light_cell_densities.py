"""Cells of emitters: samples have their reported density, and bring the light that rays find."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.scene.lights.light_cells import LightCells
from tests.support.lights import (
    LANES,
    SHAPES,
    SQUARE,
    VOXEL,
    agree,
    mesh,
    mixed_scene,
    samples_of,
    scene_with,
)

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", SHAPES)
def test_directions_are_distributed_by_the_density(name):
    """A chi² test: samples are counted in bins, rays integrate the density over these."""
    s = samples_of(name)
    lowest, highest = s.d[s.visible].min(axis=0), s.d[s.visible].max(axis=0)
    axes = np.argsort(lowest - highest)[:2]  # those along which the directions differ most
    edges = [np.linspace(lowest[k] - 1e-6, highest[k] + 1e-6, 17) for k in axes]
    density = s.ray_pdf * s.probability[s.ray_cell] * (s.ray_value > 0) * s.ray_angle
    x, y = s.ray_d[:, axes].T
    observed = np.histogram2d(*s.d[s.visible][:, axes].T, edges)[0]
    expected = np.histogram2d(x, y, edges, weights=density)[0]
    square = np.histogram2d(x, y, edges, weights=density**2)[0]
    assert observed[square == 0].sum() < 3e-4 * LANES
    used = expected > 25
    variance = expected + square - expected**2 / LANES
    chi2 = np.sum((observed - expected)[used] ** 2 / variance[used])
    assert used.sum() > 20
    assert stats.chi2.sf(chi2, used.sum()) > 1e-4


@pytest.mark.parametrize("name", SHAPES)
def test_cells_of_any_probabilities_give_what_rays_in_all_directions_find(name):
    assert agree(*samples_of(name).fluence())


@pytest.mark.parametrize("more, voxel", [((), None), (("directional environment",), 0.7)])
def test_in_a_scene_of_all_lights_cells_give_what_rays_in_all_directions_find(more, voxel):
    scene = mixed_scene(*more)
    cells = LightCells(scene, voxel and mi.Vector3f(voxel))
    assert np.bincount(cells.emitter_index, cells.share) == pytest.approx(1)
    rng, numbers = np.random.default_rng(3), mi.PCG32(size=LANES)

    def square():
        return mi.Point2f(numbers.next_float32(), numbers.next_float32())

    p = rng.random(cells.count) + 0.1
    p /= p.sum()
    cell = mi.UInt32(rng.choice(cells.count, LANES, p=p).astype(np.uint32))
    ref = dr.zeros(mi.Interaction3f, LANES)
    ref.p = 0.5 * mi.Point3f(numbers.next_float32(), numbers.next_float32(), numbers.next_float32())
    ds, weight = cells.sample(cell, ref, square(), mi.Bool(True))
    emits = (dr.max(weight) > 0) & (ds.pdf > 0)
    si = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
    hit = mi.DirectionSample3f(scene, si, ref)
    near = dr.abs(si.t - ds.dist) < 3e-5 * ds.dist
    visible = emits & dr.select(si.is_valid(), near, ds.emitter == scene.environment())
    found, pdf = cells.pdf(ref, si, hit, mi.Bool(True))
    seen = (visible & (~si.is_valid() | (dr.abs(dr.dot(ds.d, si.n)) > 0.05))).numpy()
    assert np.mean((found != cell).numpy()[seen]) < 1e-4
    assert np.mean(np.abs((pdf / ds.pdf).numpy()[seen] - 1) > 1e-2) < 1e-4

    chosen = weight.x.numpy() * visible.numpy() / p[cell.numpy()]
    d = mi.warp.square_to_uniform_sphere(square())
    si = scene.ray_intersect(mi.Ray3f(ref.p, d))
    met = 4 * np.pi * si.emitter(scene).eval(si).x.numpy()
    assert agree(chosen, met)


@pytest.mark.parametrize("voxel", [None, VOXEL])
def test_smooth_lights_are_sampled_by_their_true_area(voxel):
    """Mitsuba converts with the interpolated normal (mitsuba3#1952), here with the triangle's."""
    scene = scene_with({"patch": SHAPES["smooth patch"]()})
    cells = LightCells(scene, voxel and mi.Vector3f(voxel))
    rng = mi.PCG32(size=LANES)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ref = dr.zeros(mi.Interaction3f, LANES)
    share = mi.Float(cells.share.astype(np.float32))
    cell = dr.minimum(mi.UInt32(rng.next_float32() * cells.count), cells.count - 1)
    _ds, ours = cells.sample(cell, ref, sample, mi.Bool(True))
    _ds, theirs = scene.emitters()[0].sample_direction(ref, sample)
    met = samples_of("smooth patch")
    rays = met.ray_value * met.ray_angle
    assert len(share) == cells.count
    assert agree((ours.x * cells.count).numpy(), rays)
    assert not agree(theirs.x.numpy(), rays, errors=10)


def test_a_single_triangle_with_vertex_normals_is_sampled_by_its_true_area():
    normals = np.array([[0, 0.6, -0.8], [0.6, 0, -0.8], [0, 0, -1]])
    triangle = mesh(SQUARE[:3], [[0, 2, 1]], normals)
    rng = mi.PCG32(size=LANES)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ref = dr.zeros(mi.Interaction3f, LANES)
    scene = scene_with({"triangle": triangle})
    for voxel in (None, mi.Vector3f(100)):
        cells = LightCells(scene, voxel)
        ds, weight = cells.sample(mi.UInt32(0), ref, sample, mi.Bool(True))
        si = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
        _cell, pdf = cells.pdf(ref, si, mi.DirectionSample3f(scene, si, ref), si.is_valid())
        assert cells.count == 1
        true = dr.square(ds.dist) / (2 * dr.abs(dr.dot(ds.d, si.n)))  # its area is 2.06
        ratio = (pdf / true).numpy()[si.is_valid().numpy()]
        assert ratio.std() < 1e-4 and np.median((pdf / ds.pdf).numpy()) == pytest.approx(1, 1e-4)


def test_lanes_without_a_light_have_the_density_zero():
    """A density that is no number once made MIS weights vanish."""
    alone = mi.load_dict({"type": "scene", "e": {"type": "constant"}})
    single = scene_with({"smooth": SHAPES["smooth"]()})
    for scene in (mixed_scene(), mixed_scene("directional environment"), single, alone):
        for voxel in (None, mi.Vector3f(0.7)):
            cells = LightCells(scene, voxel)
            ref, si = dr.zeros(mi.Interaction3f, 4), dr.zeros(mi.SurfaceInteraction3f, 4)
            ds = dr.zeros(mi.DirectionSample3f, 4)
            ds.d = mi.Vector3f([0, dr.nan, 0, 1], [0, dr.nan, 1, 0], [0, dr.nan, 0, 0])
            _cell, pdf = cells.pdf(ref, si, ds, mi.Bool(False))
            assert bool(dr.all(pdf == 0))
            cell, sample = dr.arange(mi.UInt32, 4), mi.Point2f([0, 0.1, 0.9, 0], [0, 0.7, 0.99, 1])
            ds, weight = cells.sample(cell, ref, sample, mi.Bool(False))
            assert bool(dr.all(ds.pdf == 0)) and bool(dr.all(dr.all(weight == 0)))
