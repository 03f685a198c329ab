"""Light paths leave surfaces with all the light that ``path`` finds in the reverse direction."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.light_directions import NOT_RECIPROCAL, LightDirections
from mitsuba_ext.estimators.light_paths.scattering import adjoint_value
from mitsuba_ext.scene import bsdfs
from mitsuba_ext.scene.bsdfs import bsdf_table
from tests.support.stage import area, bitmap, diffuse, film, lookat, rectangle, sensor
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_same_quarters,
    batches,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")

_LANES = 1 << 17


def _tilted() -> dict[str, Any]:
    pixels = np.full((2, 2, 3), [0.75, 0.4, 0.85])
    return {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}


def _bumps() -> dict[str, Any]:
    pixels = np.random.default_rng(2).uniform(0, 0.3, (8, 8, 1))
    return {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}


def _thin(**more: Any) -> dict[str, Any]:
    colour = {"type": "rgb", "value": [0.8, 0.5, 0.3]}
    return {"type": "principledthin", "base_color": colour, "roughness": 0.4, **more}


BSDFS = {
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.4},
    "all normals": lambda: {"type": "roughdielectric", "alpha": 0.4, "sample_visible": False},
    "principled": lambda: {"type": "principled", "spec_trans": 0.3, "roughness": 0.4,
                           "metallic": 0.3, "clearcoat": 1.0, "sheen": 1.0},
    "principledthin": lambda: _thin(spec_trans=0.6, diff_trans=1.0),
    "thin, almost without a diffuse part": lambda: _thin(spec_trans=0.999, diff_trans=2.0),
    "thin, without a diffuse part": lambda: _thin(spec_trans=1.0),
    "normalmap": lambda: {"type": "normalmap", "normalmap": _tilted(), "bsdf": diffuse(0.8)},
    "normalmap of metal": lambda: {"type": "normalmap", "normalmap": _tilted(),
                                   "bsdf": {"type": "roughconductor", "alpha": 0.3}},
    "bumpmap": lambda: {"type": "bumpmap", "arbitrary": _bumps(), "bsdf": diffuse(0.8)},
    "bumpmap, masked": lambda: {"type": "mask", "opacity": 0.7,
                                "bsdf": {"type": "bumpmap", "arbitrary": _bumps(),
                                         "bsdf": diffuse(0.8)}},
    "hair": lambda: {"type": "hair", "longitudinal_roughness": 0.4, "azimuthal_roughness": 0.4},
}  # fmt: skip


def _directions(bsdf: mi.BSDF) -> LightDirections:
    sphere = {"type": "sphere", "bsdf": bsdf}
    return LightDirections(bsdf_table(mi.load_dict({"type": "scene", "ball": sphere}),
                                      NOT_RECIPROCAL))  # fmt: skip


def _arriving(rng: np.random.Generator, wi: list[float]) -> mi.SurfaceInteraction3f:
    """Light from ``wi``, on a surface with a geometric normal of its own."""
    si = dr.zeros(mi.SurfaceInteraction3f, _LANES)
    si.t, si.n = mi.Float(1), dr.normalize(mi.Normal3f(0.1, -0.05, 1))
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(rng.random((2, _LANES)).astype(np.float32))
    si.wi = dr.normalize(mi.Vector3f(wi))
    return si


@pytest.mark.parametrize(
    "name", some("roughdielectric", "thin, almost without a diffuse part", "normalmap", of=BSDFS)
)
def test_samples_carry_on_all_light_with_little_noise(name: str) -> None:
    rng, bsdf, ctx = np.random.default_rng(4), mi.load_dict(BSDFS[name]()), mi.BSDFContext()
    directions, pointer = _directions(bsdf), mi.BSDFPtr(bsdf)
    importance = mi.BSDFContext()
    importance.mode = mi.TransportMode.Importance
    for wi in ([0.3, 0.2, 0.93], [0.9, 0.1, 0.4], [-0.6, 0.3, -0.74], [0.1, -0.9, -0.4]):
        si = _arriving(rng, wi)
        number = mi.Float(rng.random(_LANES).astype(np.float32))
        numbers = mi.Point2f(rng.random((2, _LANES)).astype(np.float32))
        bs, _weight = directions.sample(pointer, importance, si, number, numbers, mi.Bool(True))
        is_smooth = (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        value, _pdf = adjoint_value(ctx, pointer, si, bs.wo, is_smooth)
        found = dr.select(is_smooth, mi.luminance(value) / bs.pdf, 0).numpy()
        # The integral over all directions, by samples of a Lambertian lobe on both sides
        d = mi.Frame3f(si.to_local(si.n)).to_world(mi.warp.square_to_cosine_hemisphere(numbers))
        sides = [adjoint_value(ctx, pointer, si, x, mi.Bool(True))[0] for x in (d, -d)]
        cosine = dr.abs(dr.dot(si.n, si.to_world(d)))
        expected = (dr.pi * mi.luminance(sides[0] + sides[1]) / cosine).numpy()
        means, errors = zip(*((x.mean(), x.std() / _LANES**0.5) for x in (found, expected)))
        z = (means[0] - means[1]) / max(np.hypot(*errors), 1e-12)
        assert abs(z) < THRESHOLD, (wi, z, means)
        assert found.std() < 3 * max(means[1], 0.1), (wi, found.std(), found.max())


def test_a_bsdf_in_an_instance_is_found_whatever_its_index() -> None:
    others = [mi.load_dict({"type": "diffuse"}) for _ in range(1100)]
    bump = {"type": "bumpmap", "texture": {"type": "checkerboard"}, "bsdf": diffuse()}
    scene = mi.load_dict({
        "type": "scene",
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": bump}},
        "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
    })  # fmt: skip
    others.clear()
    gc.collect()
    assert bsdf_table(scene, NOT_RECIPROCAL) is not None


def test_a_mirror_under_a_normal_map_has_the_weight_that_a_camera_path_finds() -> None:
    """The map darkens what comes from steep directions: seen from the camera, that is the light."""
    mirror = {"type": "conductor", "material": "none"}
    bsdf = mi.load_dict({"type": "normalmap", "normalmap": _tilted(), "mirror": mirror})
    rng, directions = np.random.default_rng(5), _directions(bsdf)
    si = _arriving(rng, [0.9, -0.1, 0.4])
    numbers = mi.Point2f(rng.random((2, _LANES)).astype(np.float32))
    bs, weight = directions.sample(
        mi.BSDFPtr(bsdf), mi.BSDFContext(), si, numbers.x, numbers, mi.Bool(True)
    )
    n = np.array([0.5, -0.2, 0.7])
    slope = min((n[0] ** 2 + n[1] ** 2) / n[2] ** 2 / 8, 1)
    darkening = 2 / (1 + (1 + slope * (0.82 / 0.16)) ** 0.5)
    assert dr.all(bs.pdf == 1)
    np.testing.assert_allclose(weight.numpy(), darkening, rtol=1e-3)


def _caustic(bsdf: dict[str, Any]) -> mi.Scene:
    """A floor that a lamp lights by way of a mirror alone."""
    place = mi.ScalarTransform4f().translate
    view = lookat([0, -0.9, 0.6], [0, 0.3, 0], [0, 0, 1])
    black = {"type": "twosided", "bsdf": diffuse(0.0)}
    return mi.load_dict({
        "type": "scene", "sensor": sensor(film=film(16, 16), to_world=view, fov=60.0),
        "floor": rectangle(mi.ScalarTransform4f().scale([3, 3, 1]), bsdf=diffuse(0.8)),
        "mirror": rectangle(place([0, 1, 1]).rotate([1, 0, 0], 90), bsdf=bsdf),
        "plate": rectangle(place([0, -1, 1.2]).scale([3, 0.9, 1]), bsdf=black),
        "lamp": rectangle(place([0, -1.5, 1.5]).rotate([1, 0, 0], -90).scale(0.2),
                          bsdf=diffuse(0.0), emitter=area(20.0)),
    }, optimize=False)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("bsdf", ["conductor", "plastic"])
def test_caustics_of_bumps_agree_with_path(bsdf: str) -> None:
    """Where the map does not turn towards the viewer: docs/mitsuba_faults.md."""
    scene = _caustic({"type": "bumpmap", "arbitrary": _bumps(), "flip_invalid_normals": False,
                      "bsdf": {"type": bsdf}})  # fmt: skip
    light_tracer, path = (
        mi.load_dict({"type": x, "max_depth": 3}) for x in ("light_tracer", "path")
    )
    images = batches(scene, light_tracer, 2048, SEEDS[:MANY_SEEDS])
    expected = batches(scene, path, 16384, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.03)


def _ball(bsdf: dict[str, Any]) -> mi.Scene:
    lamp = mi.ScalarTransform4f().translate([0.5, -0.3, 2.2]).rotate([1, 0, 0], 180).scale(0.3)
    view = lookat([0, -4, 1.2], [0, 0, 0.3], [0, 0, 1])
    return mi.load_dict({
        "type": "scene", "sensor": sensor(film=film(24, 24), to_world=view, fov=35.0),
        "floor": rectangle(mi.ScalarTransform4f().scale([2, 2, 1]), bsdf=diffuse()),
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": 0.2},
        "lamp": rectangle(lamp, bsdf=diffuse(0.0), emitter=area(6.0)),
    }, optimize=False)  # fmt: skip


def _shell(bsdf: dict[str, Any]) -> mi.Scene:
    """A lamp in a hollow sphere."""
    view = lookat([0, -0.85, 0.1], [0, 0, 0], [0, 0, 1])
    return mi.load_dict({
        "type": "scene", "sensor": sensor(film=film(24, 24), to_world=view, fov=70.0),
        "shell": {"type": "sphere", "radius": 1.0, "flip_normals": True, "bsdf": bsdf},
        "lamp": {"type": "sphere", "center": [0.2, 0.3, 0.4], "radius": 0.1,
                 "bsdf": diffuse(0.0), "emitter": area(6.0)},
    }, optimize=False)  # fmt: skip


SCENES = {"ball": _ball, "shell": _shell}


@pytest.mark.parametrize(("where", "name", "integrator", "spp"), some(
    ("shell", "normalmap", "light_tracer", 128),
    of=[
        ("shell", "normalmap", "light_tracer", 128),
        ("shell", "normalmap", "instant_radiosity", 256),
        ("shell", "normalmap", "bdpt", 128),
        ("shell", "bumpmap", "light_tracer", 512),
        ("shell", "bumpmap", "instant_radiosity", 512),
        ("ball", "thin, almost without a diffuse part", "light_tracer", 512),
        ("ball", "thin, almost without a diffuse part", "sppm", 512),
        ("ball", "thin, almost without a diffuse part", "photon_map", 256),
        ("ball", "thin, almost without a diffuse part", "bdpt", 256),
        ("ball", "thin, almost without a diffuse part", "vcm", 256),
        ("ball", "roughdielectric", "light_tracer", 1024),
        ("ball", "roughdielectric", "photon_map", 256),
        ("ball", "roughdielectric", "mlt", 2048),
    ],
))  # fmt: skip
def test_the_image_agrees_with_path(where: str, name: str, integrator: str, spp: int) -> None:
    scene = SCENES[where](BSDFS[name]())
    ours = mi.load_dict({"type": integrator, "max_depth": 5})
    path = mi.load_dict({"type": "path", "max_depth": 5})
    images = batches(scene, ours, spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, path, 1024, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.006)


def test_freed_bsdfs_are_not_among_the_bsdfs_in_memory() -> None:
    kept = [mi.load_dict(diffuse(0.5)) for _ in range(20)]
    del kept[3:17]
    gc.collect()
    assert all(isinstance(bsdf, mi.BSDF) for bsdf in bsdfs.all_in_memory(mi.BSDFPtr))
