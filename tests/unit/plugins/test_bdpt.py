"""``bdpt`` shows the image of ``path``: emitters, materials, sensors, parameters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.device import SampleBytes, device_of
from tests.support.bdpt import assert_image_of_path, bdpt
from tests.support.emitters_and_materials import (
    EMITTERS,
    MATERIALS,
    T,
    below_the_lamp,
    stage_with_ball,
)
from tests.support.stage import area, diffuse, film, octahedron, rectangle, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_quarters,
    batches,
    load,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", some("sphere", of=EMITTERS))
def test_every_emitter_lights_the_scene_as_in_path(name: str) -> None:
    assert_image_of_path(stage(light=EMITTERS[name](), camera=below_the_lamp()))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bdpt", "light_tracer"])
def test_beams_and_lamps_of_any_texture_light_the_same_scene(name: str) -> None:
    """Mitsuba cannot choose points of a checkerboard."""
    down = T().translate([0.5, 0, 3]).rotate([1, 0, 0], 180).scale(0.5)
    lights = {
        "beam": rectangle(down, emitter={"type": "directionalarea"}),
        "lamp": rectangle(down, T().translate([2, 0, 0]), bsdf=diffuse(0.0),
                          emitter={"type": "area", "radiance": {"type": "checkerboard"}}),
    }
    integrator = mi.load_dict({"type": name, "max_depth": 3})
    alone = [
        batches(mi.load_dict(stage(light=light)), integrator, 512, [1]).mean()
        for light in lights.values()
    ]
    both = batches(mi.load_dict(stage(light={}, **lights)), integrator, 512, [2]).mean()
    assert min(alone) > 0.01 * both
    assert both == pytest.approx(sum(alone), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bdpt", "light_tracer"])
def test_a_lamp_with_interpolated_normals_sends_out_what_camera_rays_see(name: str) -> None:
    """Where next event estimation of ``path`` errs."""
    lamp = octahedron(0.3, (-0.3, 0, 1.5), bsdf=diffuse(0.0), emitter=area(5.0))
    scene = mi.load_dict(stage(light=lamp, camera=below_the_lamp()), optimize=False)
    by_hits = mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1})
    integrator = mi.load_dict({"type": name, "max_depth": 2})
    images = batches(scene, integrator, 512, SEEDS[:MANY_SEEDS])
    expected = batches(scene, by_hits, 4096, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.005)


@pytest.mark.parametrize("name", some(of=MATERIALS))
def test_a_material_reflects_light_as_in_path(name: str) -> None:
    assert_image_of_path(stage_with_ball(MATERIALS[name]()))


@pytest.mark.parametrize("kind", some("dielectric", of=["dielectric", "conductor", "plastic"]))
def test_caustics_agree_with_path(kind: str) -> None:
    assert_image_of_path(stage_with_ball({"type": kind}), 5, precision=0.01)


CAMERAS = {
    "orthographic": {"plugin": "orthographic"},
    "cropped": {"film": film(31, 29, crop_offset_x=5, crop_offset_y=9, crop_width=13,
                             crop_height=11, rfilter={"type": "gaussian"})},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_a_sensor_sees_what_it_sees_with_path(name: str) -> None:
    camera = below_the_lamp(**CAMERAS[name])
    if name == "orthographic":
        del camera["fov"]
        camera["to_world"] = camera["to_world"] @ T().scale([2, 2, 1])
    assert_image_of_path(stage(camera=camera), precision=0.01)


_HALF = {"type": "visibility_roulette", "slope": 0.0, "floor": 0.5}

PARAMETERS = {
    "no light image": {"light_image": False},
    "three connections": {"connections": 3},
    "guided": {"directions": "guided"},
    "spatial": {"next_event": "spatial"},
    "linear": {"next_event": "linear"},
    "half of the shadow rays": {"shadow_test": _HALF},
    "all decisions": {
        "directions": {"type": "guided_directions", "always_guide": True},
        "next_event": {"type": "learned_lights", "grid": 8},
        "shadow_test": _HALF, "connections": 2, "pilot_spp": 32,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", some(of=PARAMETERS))
def test_parameters_do_not_change_the_mean(name: str) -> None:
    assert_image_of_path(stage(camera=below_the_lamp(), sky={"type": "constant"}),
                         **PARAMETERS[name])  # fmt: skip


def test_early_roulette_keeps_the_mean_of_paths_of_any_length() -> None:
    assert_image_of_path(stage(camera=below_the_lamp()), -1, precision=0.03, both={"rr_depth": 2})


@pytest.mark.slow
def test_hidden_emitters_are_looked_through() -> None:
    lamp = rectangle(T().translate([0, -1, 1]).rotate([1, 0, 0], -90).scale(0.3),
                     emitter=EMITTERS["rectangle"]()["emitter"])  # fmt: skip
    assert_image_of_path(stage(light=lamp, sky={"type": "constant"}), both={"hide_emitters": True})


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"], indirect=True)
def test_three_connections_in_other_variants_show_the_image_of_path(variant: str) -> None:
    assert_image_of_path(stage(camera=below_the_lamp()), connections=3)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_dispersed_light_agrees_with_the_path_tracer(variant: str) -> None:
    scene = load("flint", width=24, height=24)
    assert_image_of_path(scene, 4, 256, 0.01, reference="composed_path")


def test_parts_of_the_film_share_the_light_of_all_light_paths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = mi.load_dict(stage(camera=below_the_lamp(film=film(48, 48))))
    half = SampleBytes(device_of(mi.Float).pass_bytes / (48 * 48 // 2))
    monkeypatch.setattr(type(bdpt()), "sample_bytes", half)
    assert_image_of_path(scene, spp=8)


def test_shadow_rays_are_counted() -> None:
    """At most one for each connection: to a light and to a light path from each of 3 vertices, and
    to the sensor from each of 3."""
    integrator = bdpt(4)
    batches(mi.load_dict(stage(camera=below_the_lamp())), integrator, 16, [1])
    rays = integrator.statistics.rays
    assert rays["camera"] < rays["shadow"] < 9 * rays["camera"]


def test_a_pass_traces_each_walk_once() -> None:
    """What is read while the camera walk waits for its evaluation would evaluate it twice."""
    scene = mi.load_dict(stage(camera=below_the_lamp(film=film(32, 32))))
    lanes = 16 * 32 * 32
    bdpt(8).render(scene, spp=16)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        bdpt(8).render(scene, spp=16, seed=1)
        kernels = [k for k in dr.kernel_history() if k["size"] == lanes and "hash" in k]
    # The light walk, the camera walk. The kernel of splats has a quarter of their operations; all
    # have more where other scenes are in memory
    most = max(k["operation_count"] for k in kernels)
    assert len({k["hash"] for k in kernels if k["operation_count"] > most / 2}) == 2


@pytest.mark.parametrize("shape", ["bsplinecurve", "sdfgrid"])
def test_a_shape_whose_light_paths_cannot_leave_is_named(shape: str, tmp_path) -> None:
    if shape == "sdfgrid":
        values = np.linspace(-1, 1, 8, dtype=np.float32).reshape(2, 2, 2, 1)
        lamp = {"type": shape, "grid": mi.TensorXf(values)}
    else:
        (tmp_path / "curve.txt").write_text("".join(f"{i} 0 3 0.1\n" for i in range(5)))
        lamp = {"type": shape, "filename": str(tmp_path / "curve.txt")}
    scene = mi.load_dict(stage(light={**lamp, "emitter": {"type": "area"}}))
    with pytest.raises(NotImplementedError, match='"bdpt": .*give the light to a rectangle'):
        bdpt().render(scene, spp=1)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_a_light_that_paths_cannot_leave_is_named(variant: str) -> None:
    beam = rectangle(T().translate([0, 0, 3]).rotate([1, 0, 0], 180),
                     emitter={"type": "directionalarea"})  # fmt: skip
    with pytest.raises(NotImplementedError, match='"bdpt": .*directionalarea'):
        bdpt().render(mi.load_dict(stage(light=beam)), spp=1)
