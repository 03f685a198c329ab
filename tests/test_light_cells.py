"""Cells of emitters: what is sampled is found again, by the density that was said."""

from __future__ import annotations

import functools
import gc
import os
import tempfile
import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.lights.division import divide
from mitsuba_ext.lights.light_cells import LightCells

pytestmark = pytest.mark.usefixtures("variant")

#: All lights lie around here and are about two wide; they are seen from the origin.
CENTER = np.array([0.3, -0.4, 3.0])
VOXEL = 0.4
LANES = 1 << 18

_FOLDER = tempfile.TemporaryDirectory()  # removed when the process ends


# ---- Lights ----


def _ply(vertices, faces, normals=None) -> str:
    """Writes a mesh, which holds vertex normals where they are given."""
    mesh = mi.Mesh("light", len(vertices), len(faces), has_vertex_normals=normals is not None)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ravel(vertices).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    if normals is not None:
        parameters["vertex_normals"] = mi.Float(np.ravel(normals).astype(np.float32))
    parameters.update()
    path = f"{_FOLDER.name}/{len(os.listdir(_FOLDER.name))}.ply"
    mesh.write_ply(path)
    return path


def _ball(columns: int, rows: int, smooth: bool = False) -> dict:
    """A dented sphere; its triangles at the poles have no area."""
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    phi, theta = 2 * np.pi * u.ravel(), np.pi * v.ravel()
    d = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    a, b, c, e = corner, corner + 1, corner + columns + 1, corner + columns + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, e], 1)])
    radius = 1 if smooth else 1 - 0.3 * np.abs(np.sin(2 * phi) * np.sin(theta))[:, None]
    return _mesh(radius * d, faces, d if smooth else None)


def _mesh(vertices, faces, normals=None, **more) -> dict:
    flat = normals is None
    return {"type": "ply", "filename": _ply(vertices, faces, normals), "face_normals": flat, **more}


SQUARE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0.5], [-1, 1, 0]]

#: Shape, and how it is turned before it is placed.
SHAPES = {
    "rectangle": lambda: {"type": "rectangle", "to_world": _turn(180)},
    "slanted": lambda: {"type": "rectangle", "to_world": _turn(230)},
    "flipped": lambda: {"type": "rectangle", "flip_normals": True},
    "disk": lambda: {"type": "disk", "to_world": _turn(210)},
    "ellipse": lambda: {"type": "disk", "to_world": _turn(200) @ _T().scale([0.3, 1.4, 1])},
    "cylinder": lambda: {"type": "cylinder", "to_world": _turn(70) @ _T().scale([0.4, 0.4, 1.5])},
    "tube": lambda: {
        "type": "cylinder", "flip_normals": True,
        "to_world": _T().translate([0, 0, -4]).scale([2, 2, 3]),
    },
    "sphere": lambda: {"type": "sphere"},
    "cube": lambda: {"type": "cube", "to_world": _turn(25).scale(0.6)},
    "two triangles": lambda: _mesh(SQUARE, [[0, 1, 2], [0, 2, 3]], to_world=_turn(160)),
    "flipped mesh": lambda: _mesh(SQUARE, [[0, 1, 2], [0, 2, 3]], flip_normals=True),
    "degenerate": lambda: _mesh(
        SQUARE, [[0, 1, 1], [0, 1, 2], [2, 2, 2], [0, 2, 3], [3, 0, 3]], to_world=_turn(160)
    ),
    "many faces": lambda: _ball(40, 20),
    "smooth": lambda: _ball(7, 4, smooth=True),
    "smooth patch": lambda: _mesh(
        SQUARE, [[0, 2, 1], [0, 3, 2]],
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]] / np.sqrt(3),
    ),
}  # fmt: skip

#: Which of them are not divided.
WHOLE = {"sphere"}


def _T():
    return mi.ScalarTransform4f()


def _turn(degrees: float):
    """Turned by this around x; 180° face the origin."""
    return _T().rotate([1, 0, 0], degrees)


def _scene(shape: dict, scale: float = 1, offset: float = 0, emitter=None) -> mi.Scene:
    place = _T().translate((scale * CENTER + offset).tolist()).scale(scale)
    shape = {**shape, "to_world": place @ shape.get("to_world", _T())}
    return mi.load_dict(
        {"type": "scene", "shape": {**shape, "emitter": emitter or {"type": "area"}}}
    )


# ---- What is sampled and what rays find ----


@dataclass
class Samples:
    """Choices by random probabilities, and rays in all directions towards the light.

    Attributes:
        share: Of the cells. (The cells themselves would keep the scene in all later kernels.)
        probability: Of each cell; some are zero if there are several.
        cell, pdf, value, d: What was chosen, the density without that choice's probability, the
            unoccluded radiance / pdf, the direction.
        visible: Does the point emit towards the origin, with nothing in between?
        cosine: Between that direction and the light.
        found_cell, found_pdf: What a ray towards the point finds.
        ray_cell, ray_pdf, ray_value, ray_d: What rays in other directions find; those that do not
            meet the light have the density 0.
        ray_angle: The solid angle from which these are drawn.
    """

    share: np.ndarray
    probability: np.ndarray
    cell: np.ndarray
    pdf: np.ndarray
    value: np.ndarray
    d: np.ndarray
    visible: np.ndarray
    cosine: np.ndarray
    found_cell: np.ndarray
    found_pdf: np.ndarray
    ray_cell: np.ndarray
    ray_pdf: np.ndarray
    ray_value: np.ndarray
    ray_d: np.ndarray
    ray_angle: float

    def fluence(self) -> tuple[np.ndarray, np.ndarray]:
        """Two estimates of what arrives from cells that can be chosen: of samples, and of rays."""
        chosen = self.value * self.visible / self.probability[self.cell]
        met = self.ray_value * (self.probability[self.ray_cell] > 0) * self.ray_angle
        return chosen, met


@functools.lru_cache(maxsize=100)
def _samples(name: str, scale: float = 1, offset: float = 0) -> Samples:
    scene = _scene(SHAPES[name](), scale, offset)
    cells = LightCells(scene, mi.Vector3f(scale * VOXEL))
    rng, numbers = np.random.default_rng(7), mi.PCG32(size=LANES)

    def square():
        return mi.Point2f(numbers.next_float32(), numbers.next_float32())

    probability = rng.random(cells.count)
    if cells.count > 2:
        probability[rng.random(cells.count) < 0.3] = 0
    probability *= 1 / probability.sum()
    cell = rng.choice(cells.count, LANES, p=probability)
    ref = dr.zeros(mi.Interaction3f, LANES)
    ref.p += offset
    ds, weight = cells.sample(mi.UInt32(cell.astype(np.uint32)), ref, square(), mi.Bool(True))

    # Rays towards what was sampled; then rays in a cone that holds the light
    axis = dr.normalize(mi.Vector3f(CENTER.tolist()))
    edge = float(dr.min(dr.dot(ds.d, axis))[0])
    edge = edge - 0.02 if edge > 0 else -1.0
    cone = mi.warp.square_to_uniform_cone(square(), edge)
    found = []
    for d in (ds.d, mi.Frame3f(axis).to_world(cone)):
        si = scene.ray_intersect(mi.Ray3f(ref.p, d))
        hit = mi.DirectionSample3f(scene, si, ref)
        value = hit.emitter.eval(si)
        found_cell, found_pdf = cells.pdf(ref, si, hit, si.is_valid())
        found.append((found_cell.numpy(), found_pdf.numpy(), mi.luminance(value).numpy()))
        visible = si.is_valid() & (dr.abs(si.t - ds.dist) < (1e-3 if offset else 3e-5) * ds.dist)
        visible &= mi.luminance(weight) > 0
        found[-1] += (visible.numpy(), dr.abs(dr.dot(ds.d, si.n)).numpy(), d.numpy().T)
    to_cell, to_pdf, _, visible, cosine, d = found[0]
    ray_cell, ray_pdf, ray_value, _, _, ray_d = found[1]
    return Samples(
        cells.share, probability, cell, ds.pdf.numpy(), mi.luminance(weight).numpy(), d,
        visible, cosine, to_cell, to_pdf,
        ray_cell, ray_pdf, ray_value, ray_d, 2 * np.pi * (1 - edge),
    )  # fmt: skip


def _agree(a: np.ndarray, b: np.ndarray, errors: float = 4) -> bool:
    error = np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b)))
    return abs(a.mean() - b.mean()) < errors * error


@pytest.mark.parametrize("name", SHAPES)
def test_the_cells_of_a_light_share_all_of_it(name):
    share = _samples(name).share
    assert share.sum() == pytest.approx(1) and (share > 0).all()
    assert len(share) == 1 if name in WHOLE else 4 < len(share) <= 64


@pytest.mark.parametrize("name", SHAPES)
def test_a_sampled_point_is_found_in_its_cell_with_its_density(name):
    _assert_found(_samples(name), wrong_cell=1e-4, wrong_pdf=1e-4)


@pytest.mark.parametrize("scale, offset", [(1e-3, 0), (1e4, 0), (1, 1e3)])
@pytest.mark.parametrize("name", ["slanted", "disk", "cylinder", "two triangles", "smooth"])
def test_cells_are_found_in_small_large_and_distant_scenes(name, scale, offset):
    s = _samples(name, scale, offset)
    assert len(s.share) == len(_samples(name).share)
    # A thousand times its size from the origin, the light's own points are rounded
    _assert_found(s, *((2e-3, 1e-2) if offset else (1e-4, 1e-4)))


def _assert_found(s: Samples, wrong_cell: float, wrong_pdf: float) -> None:
    # Where the light is seen at a grazing angle, rounding moves points and their cosines
    seen = s.visible & (s.cosine > 0.05)
    assert seen.mean() > 0.05
    assert np.mean(s.found_cell[seen] != s.cell[seen]) < wrong_cell
    assert np.mean(np.abs(s.found_pdf[seen] / s.pdf[seen] - 1) > 1e-2) < wrong_pdf


@pytest.mark.parametrize("name", SHAPES)
def test_directions_are_distributed_by_the_density(name):
    """A chi² test: samples are counted in bins, rays integrate the density over these."""
    s = _samples(name)
    lowest, highest = s.d[s.visible].min(axis=0), s.d[s.visible].max(axis=0)
    axes = np.argsort(lowest - highest)[:2]  # those along which the directions differ most
    edges = [np.linspace(lowest[k] - 1e-6, highest[k] + 1e-6, 17) for k in axes]
    density = s.ray_pdf * s.probability[s.ray_cell] * (s.ray_value > 0) * s.ray_angle
    x, y = s.ray_d[:, axes].T
    observed = np.histogram2d(*s.d[s.visible][:, axes].T, edges)[0]
    expected = np.histogram2d(x, y, edges, weights=density)[0]
    square = np.histogram2d(x, y, edges, weights=density**2)[0]
    assert observed[square == 0].sum() < 1e-4 * LANES
    used = expected > 25
    variance = expected + square - expected**2 / LANES
    chi2 = np.sum((observed - expected)[used] ** 2 / variance[used])
    assert used.sum() > 20
    assert stats.chi2.sf(chi2, used.sum()) > 1e-4


@pytest.mark.parametrize("name", SHAPES)
def test_cells_of_any_probabilities_give_what_rays_in_all_directions_find(name):
    assert _agree(*_samples(name).fluence())


@pytest.mark.parametrize("voxel", [None, VOXEL])
def test_smooth_lights_are_sampled_by_their_true_area(voxel):
    """Mitsuba converts with the interpolated normal (mitsuba3#1952), here with the triangle's."""
    scene = _scene(SHAPES["smooth patch"]())
    cells = LightCells(scene, voxel and mi.Vector3f(voxel))
    rng = mi.PCG32(size=LANES)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ref = dr.zeros(mi.Interaction3f, LANES)
    share = mi.Float(cells.share.astype(np.float32))
    cell = dr.minimum(mi.UInt32(rng.next_float32() * cells.count), cells.count - 1)
    _ds, ours = cells.sample(cell, ref, sample, mi.Bool(True))
    _ds, theirs = scene.emitters()[0].sample_direction(ref, sample)
    met = _samples("smooth patch")
    rays = met.ray_value * met.ray_angle
    assert len(share) == cells.count
    assert _agree((ours.x * cells.count).numpy(), rays)
    assert not _agree(theirs.x.numpy(), rays, errors=10)


# ---- Lights that stay whole, and many lights ----

TEXTURE = np.linspace(0, 1, 48).reshape(4, 4, 3).astype(np.float32)

WHOLE_LIGHTS = {
    "textured": lambda: _emitting(
        {"type": "area", "radiance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(TEXTURE)}}
    ),
    "directionalarea": lambda: _emitting({"type": "directionalarea", "radiance": 3.0}),
    "point": lambda: {"type": "point", "position": [0, 0, 3]},
    "spot": lambda: {"type": "spot", "to_world": _facing_origin()},
    "projector": lambda: {
        "type": "projector", "to_world": _facing_origin(),
        "irradiance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(TEXTURE)},
    },
    "directional": lambda: {"type": "directional", "direction": [0, 0, 1]},
    "directional environment": lambda: {"type": "constant"},
}  # fmt: skip


def _emitting(emitter: dict) -> dict:
    return {"type": "rectangle", "to_world": _T().translate([0, 0, 3]) @ _turn(180), "e": emitter}


def _facing_origin():
    return _T().look_at([0.1, 0.2, 3], [0, 0, 0], [0, 1, 0])


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


def _mixed(*more: str) -> mi.Scene:
    """One light of each kind around the origin, and a small ball that casts shadows."""
    lights = {"type": "scene", "ball": {"type": "sphere", "radius": 0.4, "center": [1, 0, 0.5]}}
    names = ["sphere", "slanted", "many faces", "disk", "smooth", "two triangles", "cylinder"]
    for k, name in enumerate(names):
        place = _T().rotate([0, 1, 0], 360 / len(names) * k).translate([0, 0, 4])
        shape = SHAPES[name]()
        shape["to_world"] = place @ shape.get("to_world", _T())
        radiance = {"type": "rgb", "value": 1.0 + k}
        lights[f"light_{k}"] = {**shape, "emitter": {"type": "area", "radiance": radiance}}
    return mi.load_dict({**lights, **{name: WHOLE_LIGHTS[name]() for name in more}})


@pytest.mark.parametrize("voxel", [None, 0.7])
@pytest.mark.parametrize("more", [(), ("directional environment",)])
def test_in_a_scene_of_all_lights_cells_give_what_rays_in_all_directions_find(more, voxel):
    scene = _mixed(*more)
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
    assert _agree(chosen, met)


def test_lanes_without_a_light_have_the_density_zero():
    """A density that is no number once made MIS weights vanish."""
    alone = mi.load_dict({"type": "scene", "e": {"type": "constant"}})
    single = _scene(SHAPES["smooth"]())
    for scene in (_mixed(), _mixed("directional environment"), single, alone):
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


def test_a_single_triangle_with_vertex_normals_is_sampled_by_its_true_area():
    normals = np.array([[0, 0.6, -0.8], [0.6, 0, -0.8], [0, 0, -1]])
    triangle = _mesh(SQUARE[:3], [[0, 2, 1]], normals)
    rng = mi.PCG32(size=LANES)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ref = dr.zeros(mi.Interaction3f, LANES)
    scene = _scene(triangle)
    for voxel in (None, mi.Vector3f(100)):
        cells = LightCells(scene, voxel)
        ds, weight = cells.sample(mi.UInt32(0), ref, sample, mi.Bool(True))
        si = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
        _cell, pdf = cells.pdf(ref, si, mi.DirectionSample3f(scene, si, ref), si.is_valid())
        assert cells.count == 1
        true = dr.square(ds.dist) / (2 * dr.abs(dr.dot(ds.d, si.n)))  # its area is 2.06
        ratio = (pdf / true).numpy()[si.is_valid().numpy()]
        assert ratio.std() < 1e-4 and np.median((pdf / ds.pdf).numpy()) == pytest.approx(1, 1e-4)


@pytest.mark.parametrize("name", ["slanted", "two triangles", "tube", "many faces"])
def test_cells_are_not_much_longer_than_a_voxel(name):
    voxel = 1.0
    scene = _scene(SHAPES[name]())
    cells = LightCells(scene, mi.Vector3f(voxel))
    n = 4096
    rng = mi.PCG32(size=n * cells.count)
    ref = dr.zeros(mi.Interaction3f, n * cells.count)
    cell = dr.arange(mi.UInt32, n * cells.count) // n
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    p = cells.sample(cell, ref, sample, mi.Bool(True))[0].p.numpy().reshape(3, cells.count, n)
    assert 1 < cells.count < 64 and np.ptp(p, axis=2).max() < 1.5 * voxel


def test_cells_keep_their_scene_alive():
    """An emitter that outlives its shape ends the process in any scene's next call of emitters."""
    cells = [LightCells(_scene(SHAPES["slanted"]()), v) for v in (None, mi.Vector3f(0.5))]
    gc.collect()
    mixed = LightCells(_mixed(), None)
    for c in (*cells, mixed):
        ref = dr.zeros(mi.Interaction3f, 10)
        sample = mi.Point2f(dr.linspace(mi.Float, 0.1, 0.9, 10), 0.5)
        assert bool(dr.all(c.sample(mi.UInt32(0), ref, sample, mi.Bool(True))[0].pdf > 0))


def test_a_thousand_lights_are_not_divided():
    T = _T()
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    lamps = {
        f"lamp_{k}": {**lamp, "to_world": T.translate([3 * k, 0, 0])} for k in range(1000)
    }
    cells = LightCells(mi.load_dict({"type": "scene", **lamps}), mi.Vector3f(0.1))
    assert cells.count == 1000 and cells.emitter_index.tolist() == list(range(1000))


def test_a_large_mesh_is_divided_fast_and_into_few_cells():
    scene = _scene(_ball(320, 160))
    assert scene.shapes()[0].face_count() > 100_000
    start = time.perf_counter()
    division = divide(scene, np.full(3, 0.01))[0]
    assert time.perf_counter() - start < 1
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
