"""Rays that leave a surface start where Mitsuba's rays start, but closer to it in small scenes and
between surfaces close to each other. Shadow rays do not rely on Mitsuba's bounds of scenes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.bounds import scene_bounds
from mitsuba_ext.transport.queries.scene import scene_query
from mitsuba_ext.transport.scene_query import RayStarts, ray_starts
from tests.support.stage import area, diffuse, film, lookat, sensor, stage
from tests.support.statistical import batches, some

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
def test_rays_agree_with_mitsuba_in_scenes_that_are_not_small(factor):
    assert scene_query(_scaled(factor)).starts == RayStarts()
    si, target = _interaction(), mi.Point3f(1e-3, 3e-3, 5e-3)
    starts = RayStarts()
    ray, expected = starts.towards(si, target), si.spawn_ray_to(target)
    assert dr.all(ray.o == expected.o) and dr.all(ray.maxt == expected.maxt)
    assert dr.all(starts.along(si, mi.Vector3f(0, 0, 1)).o == si.spawn_ray(mi.Vector3f(0, 0, 1)).o)


def test_rays_of_a_small_scene_start_as_close_as_rays_of_its_enlarged_copy():
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
def test_objects_seen_or_lit_from_afar_keep_mitsubas_offset(far):
    """Its points are rounded too much."""
    view = lookat([0, -4, 1.2], [0, 0, 0], [0, 0, 1])
    changes = {"camera": sensor(to_world=view)} if far == "camera" else {
        "projector": {"type": "projector", "to_world": view, "irradiance": 1.0}}  # fmt: skip
    assert ray_starts(_scaled(1e-3, **changes)) == RayStarts()


# ---- Small objects with close surfaces, in larger scenes ----

GLASS = {"type": "dielectric", "int_ior": 1.3}


def _coated(
    factor: float = 1, coat: dict = GLASS, kind: str = "sphere", gap: float = 2e-3, **more
) -> mi.Scene:
    """A thing of radius 0.03 in a coat, 0.2 % of the radius away, in a scene of radius 1.
    ``factor`` enlarges all."""
    T = mi.ScalarTransform4f
    inner, outer = (T().scale(0.03 * factor * (1 + x)) for x in (0, gap))
    if kind == "disk":
        outer = T().translate([0, 0, 0.03 * factor * gap]).scale(0.03 * factor)
    view = T().look_at([0, -0.1 * factor, 0.1 * factor], [0, 0, 0], [0, 0, 1])
    lamp = T().translate([0, 0, 0.3 * factor]).rotate([1, 0, 0], 180).scale(0.1 * factor)
    floor = T().translate([0, 0, -0.05 * factor]).scale(factor)
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant"},
        "sensor": sensor(to_world=view, fov=25, near_clip=1e-2 * factor, film=film(8, 8)),
        "thing": {"type": kind, "to_world": inner, "bsdf": diffuse(0.7)},
        "coat": {"type": kind, "to_world": outer, "bsdf": coat},
        "floor": {"type": "rectangle", "to_world": floor},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": area(5.0)}, **more,
    })  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), some(
    ("composed_path", "sphere"), ("bdpt", "disk"),
    of=[(name, kind) for name in ("composed_path", "bdpt", "instant_radiosity")
        for kind in ("sphere", "cube", "disk")],
))  # fmt: skip
def test_small_things_in_a_thin_coat_are_as_bright_as_their_enlarged_copy(name, kind) -> None:
    """Rays of Mitsuba's ``path`` start behind both surfaces: 10 to 50 % of the light is lost."""
    def mean(factor: float, name: str) -> float:
        integrator = mi.load_dict({"type": name, "max_depth": 8})
        return batches(_coated(factor, kind=kind), integrator, 512, [1]).mean()

    assert mean(1, name) == pytest.approx(mean(100, name), rel=2e-3)
    assert mean(1, "path") < 0.95 * mean(100, "path")


def test_offsets_agree_with_mitsuba_where_no_ray_would_skip_a_surface() -> None:
    exact = RayStarts(1.0, exact=True)
    mask = {"type": "mask", "opacity": 0.5, "bsdf": diffuse()}
    assert ray_starts(_coated()) == ray_starts(_coated(coat=mask)) == exact
    assert ray_starts(_coated(coat={"type": "twosided", "bsdf": diffuse()})) == RayStarts()
    assert ray_starts(_coated(gap=1e-2)) == RayStarts()
    assert ray_starts(_coated(100)) == RayStarts()


def test_offsets_agree_with_mitsuba_where_intersections_are_less_exact() -> None:
    """Intersections with a cylinder are rounded by the square of the distance."""
    T = mi.ScalarTransform4f
    pipe = {"type": "cylinder", "to_world": T().translate([0.5, 0, 0]).scale(1e-2)}
    assert ray_starts(_coated(pipe=pipe)) == RayStarts()
    far = sensor(to_world=lookat([0, -90, 0], [0, 0, 0], [0, 0, 1]))
    assert ray_starts(_coated(far=far)) == RayStarts()


@pytest.mark.parametrize("kind", ["sphere", "disk", "cube", "rectangle"])
def test_offsets_computed_from_rounding_errors_are_large_enough(kind: str) -> None:
    """Rays that leave a surface do not hit it again, and rays to one do not hit it: for things of
    any size, at a thousand sizes from the origin, seen from up to a hundred sizes."""
    T, count = mi.ScalarTransform4f, 1 << 16
    sampler = mi.load_dict({"type": "independent"})
    for scale in (1e-3, 1.0, 1e4):
        for moved in (0.0, 1e3):
            c = np.array([1, -0.7, 0.3]) * moved * scale
            place = T().translate(list(c)).rotate(list(np.array([1, 2, 2]) / 3), 33).scale(scale)
            if kind == "sphere":  # Mitsuba's samples of turned ones have wrong normals
                place = T().translate(list(c)).scale(scale)
            scene = mi.load_dict({"type": "scene", "thing": {"type": kind, "to_world": place}})
            starts = RayStarts(scale * (moved + 100), exact=True)
            sampler.seed(1, count)
            away = mi.warp.square_to_uniform_sphere(sampler.next_2d())
            o = mi.Point3f(c) + away * (2 * scale * dr.power(50, sampler.next_1d()))
            inside = mi.warp.square_to_uniform_sphere(sampler.next_2d()) * sampler.next_1d()
            ray = mi.Ray3f(o, dr.normalize(mi.Point3f(c) + inside * scale - o))
            si = scene.ray_intersect(ray)
            # Many leave at grazing angles
            cosine = dr.maximum(dr.power(sampler.next_1d(), 4), 1e-6)
            sine, (y, x) = dr.sqrt(1 - cosine * cosine), dr.sincos(6.28 * sampler.next_1d())
            d = mi.Frame3f(si.n).to_world(mi.Vector3f(sine * x, sine * y, cosine))
            leaving = starts.along(si, dr.mulsign(d, -dr.dot(ray.d, si.n)))
            again = si.is_valid() & scene.ray_intersect_preliminary(leaving).is_valid()
            assert dr.count(si.is_valid())[0] > count / 2 and not dr.any(again)
            target = scene.shapes()[0].sample_position(0, sampler.next_2d())
            it = dr.zeros(mi.SurfaceInteraction3f, count)
            it.p, it.n = o, mi.Normal3f(away)
            towards = starts.towards(it, target.p, target.n)
            faces = dr.dot(target.n, o - target.p) > 0
            blocked = faces & scene.ray_intersect_preliminary(towards).is_valid()
            assert dr.count(blocked)[0] < 5e-4 * dr.count(faces)[0]


# ---- The bounds of scenes, which Mitsuba 3.9.1 misjudges ----


def test_bounds_hold_merged_rectangles():
    T = mi.ScalarTransform4f()
    sides = {f"side_{z}": {"type": "rectangle", "to_world": T.translate([0, 0, z]).scale(9),
                          "bsdf": diffuse()}
             for z in (0, 5)}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 0.2}, **sides})
    assert len(scene.shapes()) == 2  # Mitsuba has merged shapes
    box = scene_bounds(scene)
    np.testing.assert_allclose([list(box.min), list(box.max)], [[-9, -9, -0.2], [9, 9, 5]])
    assert not scene_bounds(mi.load_dict({"type": "scene"})).valid()


@pytest.mark.parametrize("moves", [False, True])
def test_shadow_rays_end_at_the_light_or_never(moves):
    """A roof that Mitsuba merges with the floor, a sky, and a lamp under the roof: the lamp lights
    (its shadow rays end), the sky does not (its shadow rays do not end before the roof)."""
    T = mi.ScalarTransform4f()
    sides = {f"side_{z}": {"type": "rectangle", "to_world": T.translate([0, 0, z]).scale(100),
                           "bsdf": {"type": "twosided", "bsdf": diffuse()}} for z in (0, 5)}
    camera = sensor(to_world=lookat([0, -4, 1.2], [0, 0, 0], [0, 0, 1]), film=film(8, 8), fov=20.0)
    thing = {"type": "sphere", "radius": 0.1, "center": [0, 0, 3]}
    if moves:
        thing = {"type": "moving", "translate": [0.1, 0, 0], "thing": thing}
    lamp = {"type": "rectangle", "to_world": T.translate([0, 0, 4]).rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": 3.0}}  # fmt: skip

    integrator = mi.load_dict({"type": "composed_path", "max_depth": 2})

    def mean(**lights: dict) -> float:
        scene = mi.load_dict({"type": "scene", "sensor": camera, **sides, "thing": thing, **lights})
        return batches(scene, integrator, 64, [1]).mean()

    sky = {"type": "constant"}
    assert mean(sky=sky) < 0.01
    assert mean(sky=sky, lamp=lamp) == pytest.approx(mean(lamp=lamp), rel=0.1)
