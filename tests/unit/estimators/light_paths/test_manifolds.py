"""Connections through casters: known answers, and scenes without casters."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.manifolds.casters import casters_of
from mitsuba_ext.estimators.light_paths.manifolds.manifold_tracer import ManifoldTracer
from mitsuba_ext.estimators.light_paths.manifolds.parameters import no_effect
from mitsuba_ext.rendering.request import Request
from tests.support.casters import (
    GLASS,
    GREY,
    MIRROR,
    ROUGH_GLASS,
    camera_at,
    lamp_above,
    plane_at,
    scene_of,
    wavy_surface,
)

pytestmark = pytest.mark.usefixtures("variant")


def _render(scene: mi.Scene, spp: int = 64, seed: int = 0, **parameters: Any) -> np.ndarray:
    plugin = {"type": "composed_path", "max_depth": 6, "caustics": "manifold", **parameters}
    return np.array(mi.render(scene, integrator=mi.load_dict(plugin), spp=spp, seed=seed))


def test_a_point_light_in_a_mirror_is_a_light_behind_it() -> None:
    """Its image is as bright as the light itself would be at the mirrored place."""
    camera = camera_at([0, 0, 1.5], [0, 0, 0], fov=2.0)
    point = {"type": "point", "position": [0.3, 0, 0.5], "intensity": {"type": "rgb", "value": 1.0}}
    floor = plane_at(0.0, GREY)
    scene = scene_of(floor=floor, mirror=plane_at(2.0, MIRROR, 4.0), light=point, sensor=camera)
    alone = _render(scene_of(floor=floor, light=point, sensor=camera), 16)
    image = {**point, "position": [0.3, 0, 3.5]}
    expected = alone + _render(scene_of(floor=floor, light=image, sensor=camera), 16)
    # The number of trials is random: the mean of the image is known to 0.5 %
    found = _render(scene, 1024, max_depth=3)
    np.testing.assert_allclose(found.mean(), expected.mean(), rtol=0.02)


@pytest.mark.parametrize("height", [0.2, 0.8])
def test_the_sun_through_flat_water_keeps_its_flux(height: float) -> None:
    """A fraction F0 is reflected; the rest illuminates the floor, at any depth."""
    water = {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.0}
    irradiance = {"type": "rgb", "value": 1.0}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": irradiance}
    camera = camera_at([0.02, 0, 0.1], [0, 0, 0], fov=10.0)
    floor, surface = plane_at(0.0, GREY), plane_at(height, water)
    scene = scene_of(floor=floor, water=surface, sun=sun, sensor=camera)
    transmitted = 1 - (0.33 / 2.33) ** 2
    image = _render(scene, 1024, max_depth=3)
    # The number of trials is random: the mean of the image is known to 0.6 %
    np.testing.assert_allclose(image.mean(), 0.5 / np.pi * transmitted, rtol=0.02)


def test_pilots_learn_seeds(tmp_path) -> None:
    """A render that loads what another one has learned begins with its last stage."""
    scene, file = scene_of(**_statistical()["ball"]), str(tmp_path / "learned.npz")
    integrator = mi.load_dict({
        "type": "composed_path", "max_depth": 6, "caustics": "manifold", "save_learned": file,
    })  # fmt: skip
    mi.render(scene, integrator=integrator, spp=128)
    assert "seeds of chains in" in integrator.statistics.learned
    learned = integrator.learners["caustics"].state()
    assert len(learned["seeds"]) > 1
    again = mi.load_dict({
        "type": "composed_path", "max_depth": 6, "caustics": "manifold", "load_learned": file,
    })  # fmt: skip
    assert np.isfinite(np.array(mi.render(scene, integrator=again, spp=4))).all()
    for key, values in again.learners["caustics"].state().items():
        np.testing.assert_array_equal(values, learned[key])


def _statistical() -> dict[str, dict[str, Any]]:
    floor, lamp, sky = plane_at(0.0, GREY), lamp_above(), {"type": "constant", "radiance": 0.4}
    ball = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.4}
    to_world = mi.ScalarTransform4f().translate([0, 0, 0.7]).scale([1, 1, 0.2])
    box = {"type": "cube", "to_world": to_world}
    wavy = wavy_surface(True)
    inner = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.1, "bsdf": GREY,
             "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}}  # fmt: skip
    return {
        "water": {"floor": floor, "water": plane_at(0.5, GLASS, 3.0), "lamp": lamp, "sky": sky},
        "ball": {"floor": floor, "ball": {**ball, "bsdf": GLASS}, "lamp": lamp},
        "metal_ball": {"floor": floor, "ball": {**ball, "bsdf": MIRROR}, "lamp": lamp},
        # Glass through whose open ends light enters
        "tube": {"floor": floor, "lamp": lamp, "tube": {
            "type": "cylinder", "p0": [-0.8, 0, 0.6], "p1": [0.8, 0, 0.6], "radius": 0.35,
            "bsdf": {**GLASS, "specular_transmittance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}},
        }},
        # A mesh without normals beside one with normals
        "slab": {"floor": floor, "slab": {**box, "bsdf": GLASS}, "wavy": wavy, "lamp": lamp},
        "lamp_in_glass": {"floor": floor, "ball": {**ball, "bsdf": GLASS}, "lamp": inner},
        "rough_water": {"floor": floor, "water": plane_at(0.5, ROUGH_GLASS, 3.0), "lamp": lamp},
        # Beside smooth metal
        "rough_ball": {"floor": floor, "lamp": lamp, "ball": {**ball, "bsdf": ROUGH_GLASS},
                       "metal": {"type": "sphere", "center": [0.7, 0, 0.3], "radius": 0.3,
                                 "bsdf": MIRROR}},
    }  # fmt: skip


def test_the_mean_through_rough_glass_is_the_mean_of_path() -> None:
    """With a lamp so wide that scattering and connections of the water count half of the light."""
    camera = camera_at([0.2, -0.5, 0.4], [0, 0, 0], 4, 45.0)
    water = plane_at(0.5, ROUGH_GLASS, 3.0)
    scene = scene_of(floor=plane_at(0.0, GREY), water=water, lamp=lamp_above(1.0), sensor=camera)
    found = _render(scene, 8192, max_depth=3, pilot_spp=0).mean()
    expected = _render(scene, 1 << 16, max_depth=3, caustics="scattered").mean()
    # Both means are known to 0.5 %
    np.testing.assert_allclose(found, expected, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [3, 4, 6])
@pytest.mark.parametrize("name", [
    "water", "ball", "metal_ball", "tube", "slab", "lamp_in_glass", "rough_water", "rough_ball",
])  # fmt: skip
def test_the_mean_is_the_mean_of_path(name: str, depth: int) -> None:
    scene = scene_of(**_statistical()[name])
    _compare(scene, {"type": "path", "max_depth": depth}, 4096, depth)


@pytest.mark.slow
@pytest.mark.parametrize("light", [
    {"type": "point", "position": [0.3, 0.2, 2]}, {"type": "spot", "cutoff_angle": 30},
    {"type": "directional", "direction": [0.3, 0.2, -1]},
])  # fmt: skip
def test_points_and_directions_of_light_are_seen_as_bdpt_sees_them(light: dict[str, Any]) -> None:
    """No chain of this length has more than two surfaces."""
    if light["type"] == "spot":
        to_world = mi.ScalarTransform4f().look_at([0.3, -0.2, 2.5], [0, 0, 0], [0, 1, 0])
        light = {**light, "to_world": to_world}
    ball = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.4, "bsdf": GLASS}
    scene = scene_of(floor=plane_at(0.0, GREY), ball=ball, light=light)
    # Near focal lines, the variance of such light is infinite: most short renders are 2 % too dark
    _compare(scene, {"type": "bdpt", "max_depth": 4}, 256, 4, 0.03)


@pytest.mark.parametrize("preset", [
    "neepp", "pss_guided", "auto_path", "swarm_path", "two_stage",
])  # fmt: skip
def test_presets_have_the_slot(preset: str) -> None:
    integrator = mi.load_dict({"type": preset, "caustics": "manifold"})
    assert integrator.slots["caustics"].name == "manifold"
    assert "caustics" not in mi.load_dict({"type": preset}).slots


def _compare(
    scene: mi.Scene, reference: dict[str, Any], spp: int, depth: int, tolerance: float = 0.0
) -> None:
    means = []
    plugin = {"type": "composed_path", "caustics": "manifold", "max_depth": depth}
    for count, integrator in ((spp, mi.load_dict(reference)), (256, mi.load_dict(plugin))):
        found = [
            np.array(mi.render(scene, integrator=integrator, spp=count, seed=seed)).mean()
            for seed in range(16)
        ]
        means.append((np.mean(found), np.std(found, ddof=1) / 4))
    (expected, error), (found, own_error) = means
    assert abs(found - expected) < 4 * np.hypot(error, own_error) + tolerance * expected
    assert np.hypot(error, own_error) < 0.1 * expected


# ---- Where nothing is connected ----


@pytest.mark.parametrize("bsdf", [
    GREY, {"type": "roughdielectric", "alpha": 0.3}, {"type": "thindielectric"},
    {"type": "roughconductor", "alpha": 0.05},
    {"type": "mask", "nested": GLASS},
    {"type": "bumpmap", "nested": GLASS},
])  # fmt: skip
def test_without_casters_the_image_is_that_of_scattering(bsdf: dict[str, Any]) -> None:
    if bsdf["type"] == "bumpmap":
        bumps = mi.Bitmap(np.random.default_rng(1).random((4, 4, 1), np.float32))
        bsdf = {**bsdf, "bumps": {"type": "bitmap", "bitmap": bumps, "raw": True}}
    ball = {"type": "sphere", "bsdf": bsdf}
    scene = scene_of(floor=plane_at(0.0, GREY), ball=ball, lamp=lamp_above())
    assert not casters_of(scene)
    np.testing.assert_array_equal(_render(scene, 4), _render(scene, 4, caustics="scattered"))


@pytest.mark.parametrize("parts, depth", [({}, 6), ({"lamp": True}, 2)])
def test_without_lights_or_room_for_a_chain_the_image_is_that_of_scattering(parts, depth) -> None:
    lights = {"lamp": lamp_above()} if parts else {}
    scene = scene_of(floor=plane_at(0.0, GREY), ball={"type": "sphere", "bsdf": GLASS}, **lights)
    expected = _render(scene, 4, max_depth=depth, caustics="scattered")
    found = _render(scene, 4, max_depth=depth, pilot_spp=0)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("parts, max_depth, expected", [
    ({"ball": {"type": "sphere", "bsdf": GLASS}}, 6, "no light"),
    ({"ball": {"type": "sphere", "bsdf": GLASS}, "lamp": True}, 2, '"max_depth" is 2'),
    ({"lamp": True}, 6, "no mesh, sphere"),
    ({"moves": True, "lamp": True, "water": {"type": "rectangle", "bsdf": GLASS}}, 6, "move"),
    ({"ball": {"type": "sphere", "bsdf": GLASS}, "lamp": True}, 6, ""),
])  # fmt: skip
def test_a_warning_says_why_nothing_is_connected(parts, max_depth: int, expected: str) -> None:
    parts = dict(parts)
    if "lamp" in parts:
        parts["lamp"] = lamp_above()
    if parts.pop("moves", False):
        parts["ball"] = {"type": "moving", "translate": [1, 0, 0], "shape": {"type": "sphere"}}
    scene = scene_of(**parts)
    found = no_effect(scene, max_depth)
    assert expected in found and bool(expected) == bool(found)


def test_clamps_bound_the_light_of_connections_too() -> None:
    scene = scene_of(**_statistical()["ball"])
    limits = {"clamp_direct": 1e-3, "clamp_indirect": 1e-3}
    assert _render(scene, 1, **limits).mean(-1).max() < 2.01e-3


def test_light_of_connections_is_in_the_channels_of_its_events() -> None:
    """A floor with two lobes, and light that no camera path finds."""
    metal = {"type": "roughconductor", "alpha": 0.3}
    floor = {"type": "blendbsdf", "weight": 0.5, "a": GREY, "b": metal}
    ball = {"type": "sphere", "id": "ball", "center": [0, 0, 0.6], "radius": 0.4, "bsdf": GLASS}
    point = {"type": "point", "position": [0.3, 0.2, 2.0]}
    scene = scene_of(floor=plane_at(0.0, floor), ball=ball, light=point)
    aovs = "di:C<.D>.*L,gl:C<.[GS]>.*L,through:C<.[DG]><TS'ball'><TS'ball'>L,back:C<.D><RS>L"
    image = _render(scene, 16, max_depth=4)
    found = _render(scene, 16, max_depth=4, aovs=aovs)
    diffuse, glossy, through, mirrored = (found[..., i : i + 3] for i in range(3, 15, 3))
    np.testing.assert_allclose(found[..., :3], image, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(diffuse + glossy, image, rtol=1e-4, atol=1e-5)
    for part in (diffuse, glossy, through, mirrored):
        assert part.mean() > 1e-5
    assert (through <= image + 1e-5).all() and (mirrored <= diffuse + 1e-5).all()


@pytest.mark.slow
def test_channels_hold_what_the_channels_of_path_hold() -> None:
    scene = scene_of(**_statistical()["ball"])
    parameters = {"max_depth": 4, "aovs": "caustics:caustics,others:C.*D.?L"}
    expected, found = (
        np.array([
            _render(scene, spp, seed, caustics=kind, **parameters)[..., 3:].mean((0, 1))
            for seed in range(8)
        ]) for kind, spp in (("scattered", 4096), ("manifold", 256))
    )  # fmt: skip
    error = np.hypot(found.std(0, ddof=1), expected.std(0, ddof=1)) / np.sqrt(8)
    assert (abs(found.mean(0) - expected.mean(0)) < 4 * error).all()


def test_timed_renders_begin_with_connections() -> None:
    """A first sample by a plain walk would not have the light of points through glass."""
    integrator = mi.load_dict({"type": "composed_path", "caustics": "manifold"})
    scene = scene_of(**_statistical()["ball"])
    assert integrator.pace_stage(Request(scene, scene.sensors()[0]), 16) is None


def test_passes_are_recorded(monkeypatch) -> None:
    """Python traces the walk and the search for the first render, once for the pilots and once for
    the last stage."""
    gc.collect()  # Dr.Jit records anew, and may round differently, where other scenes have gone
    traced = []
    trace = ManifoldTracer.trace
    monkeypatch.setattr(ManifoldTracer, "trace", lambda *a: traced.append(1) or trace(*a))
    scene = scene_of(**_statistical()["ball"])
    for seed in range(3):
        _render(scene, 4, seed=seed)
    assert len(traced) == 2


def test_a_pass_traces_its_walk_once() -> None:
    """The state of the sampler is found by the same kernel as the samples."""
    scene = scene_of(**_statistical()["ball"])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history()
        _render(scene, 4, pilot_spp=0)
        kernels = dr.kernel_history((dr.KernelType.JIT,))
    assert sum("loop: walk" in kernel["ir"].getvalue() for kernel in kernels) == 1


def test_the_same_seed_gives_the_same_image() -> None:
    gc.collect()  # as above
    scene = scene_of(**_statistical()["ball"])
    first = _render(scene, 16, seed=3)
    # Up to the order in which two threads add samples to a pixel
    np.testing.assert_allclose(first, _render(scene, 16, seed=3), rtol=1e-5)
    assert (abs(first - _render(scene, 16, seed=4)) > 1e-3 * first).any()


# ---- Refusals ----


def _error(act: Any) -> str:
    with pytest.raises((RuntimeError, NotImplementedError)) as caught:
        act()
    return str(caught.value) + str(caught.value.__cause__)


def test_media_are_refused_in_a_sentence() -> None:
    fog = {"type": "homogeneous", "sigma_t": 0.5}
    ball = {"type": "sphere", "bsdf": GLASS, "interior": fog}
    scene = scene_of(floor=plane_at(0.0, GREY), ball=ball, lamp=lamp_above())
    message = _error(lambda: _render(scene, 1))
    assert '"caustics" is "manifold"' in message and '"scattered"' in message


def test_integrators_that_ask_for_single_samples_are_refused() -> None:
    scene = scene_of(**_statistical()["ball"])
    nested = {"type": "composed_path", "caustics": "manifold"}
    moment = mi.load_dict({"type": "moment", "nested": nested})
    assert '"caustics" is "manifold"' in _error(lambda: mi.render(scene, integrator=moment, spp=1))


@pytest.mark.parametrize("plugin", ["composed_prb", "bdpt"])
def test_integrators_without_the_slot_do_not_know_it(plugin: str) -> None:
    message = _error(lambda: mi.load_dict({"type": plugin, "caustics": "manifold"}))
    assert "caustics" in message
