"""Large lights with a texture are divided where their cells are about even, and whole otherwise."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lights.light_cells import LightCells
from tests.support.statistical import assert_same_pixels_on_average, batches

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 18


def _texture(spots: bool) -> dict:
    """A gradient in two directions that differs by colour, or a few bright texels on black."""
    y, x = np.mgrid[0:32, 0:64]
    image = np.stack([x / 64, y / 32, 1 - x / 64], axis=-1) + 0.1
    if spots:
        image *= ((x % 13 == 5) & (y % 11 == 3))[..., None]
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(image.astype(np.float32))}


@pytest.fixture(params=["rectangle", "mesh"])
def surface(request: pytest.FixtureRequest, tmp_path) -> dict:
    """A rectangle, or the same as four triangles with texture coordinates."""
    if request.param == "rectangle":
        return {"type": "rectangle"}
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1), (0.2, -0.1)]
    lines = [f"v {x} {y} 0" for x, y in corners]
    lines += [f"vt {(x + 1) / 2} {(y + 1) / 2}" for x, y in corners]
    lines += [f"f {a}/{a} {b}/{b} 5/5" for a, b in ((1, 2), (2, 3), (3, 4), (4, 1))]
    (tmp_path / "light.obj").write_text("\n".join(lines) + "\n")
    return {"type": "obj", "filename": str(tmp_path / "light.obj"), "face_normals": True}


def _scene(surface: dict, spots: bool = False, **more) -> mi.Scene:
    """A light of 6 by 4 above the origin, tilted."""
    T = mi.ScalarTransform4f
    to_world = T().translate([0.5, 0, 2]).rotate([0, 1, 0], 165).scale([3, 2, 1])
    emitter = {"type": "area", "radiance": _texture(spots)}
    light = {**surface, "to_world": to_world, "emitter": emitter}
    return mi.load_dict({"type": "scene", "light": light, **more})


def test_a_texture_with_spots_is_sampled_by_mitsuba(surface: dict):
    scene = _scene(surface, spots=True)
    assert LightCells(scene, mi.Vector3f(1.0)).count == 1
    assert LightCells(_scene(surface), None).count == 1, "what is not divided samples its texture"


def test_cells_of_a_gradient_bring_the_light_that_rays_find(surface: dict):
    scene = _scene(surface)
    cells = LightCells(scene, mi.Vector3f(1.0))
    assert cells.count >= 20 and cells.share.sum() == pytest.approx(1)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, LANES)
    ref = dr.zeros(mi.Interaction3f, LANES)
    ref.p = mi.Point3f(0.1, -0.2, 0)

    # All directions; the cells that they run into
    ray = mi.Ray3f(ref.p, mi.warp.square_to_uniform_sphere(sampler.next_2d()))
    si = scene.ray_intersect(ray)
    ds = mi.DirectionSample3f(scene, si, ref)
    hit, pdf = cells.pdf(ref, si, ds, si.is_valid())
    value = mi.luminance(si.emitter(scene).eval(si)) * 4 * np.pi
    rays = np.bincount(hit.numpy(), np.where(si.is_valid().numpy(), value.numpy(), 0), cells.count)

    # Each cell sampled by itself: the same light, the same density, and found again
    cell = dr.arange(mi.UInt32, LANES) % cells.count
    ds, weight = cells.sample(cell, ref, sampler.next_2d(), mi.Bool(True))
    samples = np.bincount(cell.numpy(), mi.luminance(weight).numpy())
    share = np.bincount(cell.numpy())
    assert samples / share == pytest.approx(rays / LANES, rel=0.08, abs=2e-3)
    assert samples.sum() / share.mean() == pytest.approx(rays.sum() / LANES, rel=0.01)
    met = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
    again, density = cells.pdf(ref, met, mi.DirectionSample3f(scene, met, ref), met.is_valid())
    assert (again == cell).numpy().mean() > 0.9999
    assert np.median(np.abs((density / ds.pdf).numpy() - 1)) < 1e-4


def test_divided_textures_work_beside_shapes_and_emitters_that_cannot_be_sampled(tmp_path):
    """Neither in their scene nor in another one: Dr.Jit asks all that exist."""
    T = mi.ScalarTransform4f
    (tmp_path / "curve.txt").write_text("-1 0 0.3 0.1\n0 0 0.4 0.1\n0.3 0 0.3 0.1\n1 0 0.5 0.1\n")
    curve = {"filename": str(tmp_path / "curve.txt")}
    others = {
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.3}},
        "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        "curve": {"type": "bsplinecurve", **curve},
        "line": {"type": "linearcurve", **curve, "to_world": T().translate([0, 1, 0])},
        "beam": {"type": "rectangle", "to_world": T().translate([0, 0, 3]).rotate([1, 0, 0], 180),
                 "emitter": {"type": "directionalarea"}},
    }  # fmt: skip
    lamp = {"type": "sphere", "radius": 0.2, "center": [-2, 1, 1], "emitter": {"type": "area"}}
    among_them, alone = (
        _scene({"type": "rectangle"}, lamp=lamp, **more) for more in (others, {})
    )
    for scene in (among_them, alone):
        cells = LightCells(scene, mi.Vector3f(1.0))
        light = next(i for i, e in enumerate(scene.emitters()) if "Bitmap" in str(e))
        chosen = np.flatnonzero(cells.emitter_index == light)
        assert len(chosen) >= 20
        cell = mi.UInt32(chosen.astype(np.uint32))
        ref = dr.zeros(mi.Interaction3f, len(chosen))
        ref.p = mi.Point3f(0, 0, 1)
        ds, weight = cells.sample(cell, ref, mi.Point2f(0.5), mi.Bool(True))
        assert bool(dr.all(weight.x > 0))
        si = scene.ray_intersect(mi.Ray3f(ref.p, ds.d))
        found, pdf = cells.pdf(ref, si, mi.DirectionSample3f(scene, si, ref), mi.Bool(True))
        assert bool(dr.all(found == cell)) and bool(dr.all(dr.abs(pdf / ds.pdf - 1) < 1e-4))


@pytest.mark.parametrize(
    "surface", ["rectangle", pytest.param("mesh", marks=pytest.mark.slow)], indirect=True
)
def test_the_mean_agrees_with_path(surface: dict):
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}}
    scene = _scene(
        surface,
        floor={"type": "rectangle", "to_world": T().scale(3)},
        ball={"type": "sphere", "radius": 0.5, "center": [0, 0, 0.6]},
        # A light without a texture is another branch
        lamp={"type": "sphere", "radius": 0.2, "center": [-2, 1, 1],
              "emitter": {"type": "area", "radiance": 3.0}},
        sensor={"type": "perspective", "fov": 50, "film": film,
                "to_world": T().look_at([0, -6, 3], [0, 0, 1], [0, 0, 1])},
    )  # fmt: skip
    assert LightCells(scene, mi.Vector3f(1.0)).count > 3, "the light is divided"
    neepp = mi.load_dict({"type": "neepp", "max_depth": 3, "grid": 8})
    images = batches(scene, neepp, 512, [1, 2])
    path = mi.load_dict({"type": "path", "max_depth": 3})
    reference = batches(scene, path, 2048, [101, 102])
    assert_same_pixels_on_average(images, reference, precision=0.01)
