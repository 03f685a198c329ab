"""Light tracing shows the image of ``path`` wherever light paths can be seen."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.emitters_and_materials import (
    EMITTERS,
    MATERIALS,
    UNLIKE_PATH,
    T,
    below_the_lamp,
    stage_with_ball,
)
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_same_quarters,
    batches,
    some,
    z_welch,
)

pytestmark = pytest.mark.usefixtures("variant")


def light_tracer(max_depth: int = 4, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "light_tracer", "max_depth": max_depth, **parameters})


def assert_image_of_path(
    scene: mi.Scene,
    max_depth: int = 3,
    spp: int = 256,
    precision: float = 0.005,
    reference: dict[str, Any] | None = None,
    **parameters: Any,
) -> None:
    """The means of the image and of its quarters agree with ``path``."""
    path = {"type": "path", **(reference or {}), "max_depth": max_depth, **parameters}
    images = batches(scene, light_tracer(max_depth, **parameters), spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, mi.load_dict(path), spp, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision)


# ---- Emitters ----


@pytest.mark.parametrize("name", some("sphere", "mirrored cube", "envmap", of=EMITTERS))
def test_an_emitter_sends_out_what_path_sees(name: str) -> None:
    """Turned lamps too. The scene is not optimized: sky and sun would leak in ``path``."""
    scene = mi.load_dict(stage(light=EMITTERS[name]()), optimize=False)
    assert_image_of_path(scene, 3, 512)


@pytest.mark.parametrize("name", ["spot", "projector", "envmap", "directional"])
def test_a_distorting_transform_of_a_light_is_refused(name: str) -> None:
    """Mirrors and, where they change nothing, scales are not."""
    turn = T().rotate([1, 0, 0], 90)
    scales = {"spot": [1, 1, 1.2], "projector": [2, 1, 1], "envmap": [2, 2, 2],
              "directional": [1, 1, 2]}  # fmt: skip
    harmless = {"spot": [-2, 2, 2], "projector": [-2, 2, 2], "envmap": [-1, 1, 1],
                "directional": [-3, 1, 1]}  # fmt: skip
    for scale, is_refused in ((harmless[name], False), (scales[name], True)):
        light = {**EMITTERS[name](), "to_world": turn.scale(scale)}
        light.pop("direction", None)
        scene = mi.load_dict(stage(light=light), optimize=False)
        if is_refused:
            with pytest.raises(NotImplementedError, match='"light_tracer": .* to_world scales'):
                light_tracer().render(scene, spp=1)
        else:
            light_tracer().render(scene, spp=1)


@pytest.mark.parametrize("name", some("textured cube", of=UNLIKE_PATH))
def test_an_emitter_sends_out_what_camera_rays_see(name: str) -> None:
    scene = mi.load_dict(stage(light=UNLIKE_PATH[name]()), optimize=False)
    by_hits = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
    images = batches(scene, light_tracer(2), 512, SEEDS[:MANY_SEEDS])
    expected = batches(scene, mi.load_dict(by_hits), 2048, REFERENCE_SEEDS[:MANY_SEEDS])
    means = [x.mean(axis=(1, 2, 3)) for x in (images, expected)]
    z = z_welch(*(m[:, None] for m in means))[0]
    assert abs(z) < THRESHOLD, f"z = {z:.2f}, {means[0].mean() / means[1].mean():.4f}"
    assert np.hypot(*(m.std(ddof=1) for m in means)) / MANY_SEEDS**0.5 < 0.01 * means[1].mean()


@pytest.mark.parametrize("light", ["constant", "directional"])
def test_no_light_comes_through_merged_walls_and_none_is_lost(light: str) -> None:
    """Floor, wall and roof of one material are merged: Mitsuba believes that the scene is empty.
    Ours agrees with ``path`` in the scene that is not merged."""
    white = {"type": "twosided", "bsdf": diffuse()}
    things = {
        "floor": rectangle(T().scale([2, 2, 1]), bsdf=white),
        "wall": rectangle(T().translate([0, 1.5, 1]).rotate([1, 0, 0], 90).scale(2), bsdf=white),
        "roof": rectangle(T().translate([0.9, 0, 2]).scale([1, 2, 1]), bsdf=white),
    }
    images = []
    for integrator, optimize in (("light_tracer", True), ("path", False)):
        scene = mi.load_dict(stage(light=EMITTERS[light](), block=None, **things),
                             optimize=optimize)  # fmt: skip
        plugin = mi.load_dict({"type": integrator, "max_depth": 3})
        seeds = (SEEDS if optimize else REFERENCE_SEEDS)[:MANY_SEEDS]
        images.append(batches(scene, plugin, 512, seeds).mean(axis=(1, 2, 3)))
    z = z_welch(*(i[:, None] for i in images))[0]
    assert abs(z) < THRESHOLD, (z, images)


# ---- Materials ----


@pytest.mark.parametrize("name", some("normalmap", of=MATERIALS))
def test_a_material_reflects_light_as_in_path(name: str) -> None:
    scene = mi.load_dict(stage_with_ball(MATERIALS[name]()), optimize=False)
    assert_image_of_path(scene, 4, 512)


@pytest.mark.parametrize(
    "kind", some("dielectric", of=["dielectric", "conductor", "thindielectric"])
)
def test_caustics_agree_with_path(kind: str) -> None:
    """The camera looks at the floor only, and not through the glass above it."""
    lamp = rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180), emitter=area(5.0),
                     bsdf=diffuse(0.0))  # fmt: skip
    ball = {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.5, "bsdf": {"type": kind}}
    view = sensor(to_world=lookat([0, -1.9, 0.3], [0, -1, 0], [0, 0, 1]), fov=12.0)
    scene = mi.load_dict(stage(light=lamp, camera=view, block=ball, wall=None), optimize=False)
    assert_image_of_path(scene, 5, 1024, precision=0.02)


# ---- Sensors and films ----

FILMS = {
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "mitchell, cropped": {"rfilter": {"type": "mitchell"}, "crop_offset_x": 3, "crop_offset_y": 5,
                          "crop_width": 7, "crop_height": 9},
    "odd": {"width": 13, "height": 7},
}  # fmt: skip


@pytest.mark.parametrize("name", FILMS)
def test_every_pixel_of_a_film_has_its_light_up_to_the_edges(name: str) -> None:
    size = {"width": 16, "height": 16, **FILMS[name]}
    scene = mi.load_dict(stage(camera=sensor(film=film(**size))), optimize=False)
    images = batches(scene, light_tracer(3), 512, SEEDS[:MANY_SEEDS])
    path = mi.load_dict({"type": "path", "max_depth": 3})
    expected = batches(scene, path, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    for edge in (np.s_[:, :1], np.s_[:, -1:], np.s_[:, :, :1], np.s_[:, :, -1:], np.s_[:]):
        means = [x[edge].mean(axis=(1, 2, 3))[:, None] for x in (images, expected)]
        assert abs(z_welch(*means)[0]) < THRESHOLD + 0.4, (edge, [m.mean() for m in means])


@pytest.mark.parametrize("changes", [
    {"principal_point_offset_x": 0.2},
    {"near_clip": 4.0},
    {"shutter_open": 0.0, "shutter_close": 1.0},
], ids=["principal point", "near clip", "shutter"])  # fmt: skip
def test_a_sensor_sees_what_it_sees_with_path(changes: dict[str, Any]) -> None:
    scene = mi.load_dict(stage(camera=below_the_lamp(**changes)), optimize=False)
    assert_image_of_path(scene, 3, 1024)


@pytest.mark.parametrize(
    "turns", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["at rest", "moving"]
)
def test_an_orthographic_sensor_sees_what_it_sees_with_path(turns: bool) -> None:
    """Its transform scales and shears, so that rays are not at right angles to the film, and the
    clip planes cut through the scene."""
    shear = mi.ScalarTransform4f([[1, 0, 0.15, 0], [0, 0.8, 0.1, 0], [0, 0, 3, 0], [0, 0, 0, 1]])
    view = lookat([0.1, -4, 1.2], [0, 0, 0.6], [0, 0, 1]) @ shear
    window = film(16, 16, rfilter={"type": "gaussian"}, crop_offset_x=2, crop_offset_y=4,
                  crop_width=11, crop_height=7)  # fmt: skip
    camera = sensor("orthographic", view, film=window, near_clip=0.7, far_clip=4.0)
    if turns:
        times = {"shutter_open": 0.0, "shutter_close": 1.0}
        camera = {"type": "moving_camera", "angle": 20.0, "axis": [0, 1, 1],
                  "translate": [0.3, 0, 0.2], "nested": {**camera, **times}}  # fmt: skip
    scene = mi.load_dict(stage(camera=camera), optimize=False)
    assert_image_of_path(scene, 3, 256, precision=0.05)


def test_a_sensor_that_cannot_be_connected_to_is_named() -> None:
    scene = mi.load_dict(stage(camera=sensor("radiancemeter", film=film(1, 1))))
    with pytest.raises(NotImplementedError, match='"light_tracer": .*perspective'):
        light_tracer().render(scene, spp=1)


def test_a_sampled_border_is_refused() -> None:
    border = film(rfilter={"type": "gaussian"}, sample_border=True)
    scene = mi.load_dict(stage(camera=sensor(film=border)))
    with pytest.raises(NotImplementedError, match='"light_tracer": .*border'):
        light_tracer().render(scene, spp=1)


# ---- Storage, kernels, warnings ----


@pytest.mark.slow
def test_paths_longer_than_a_round_of_storage_lose_nothing() -> None:
    """In a white box, paths have dozens of vertices: they are stored a few at a time."""
    white = {"type": "cube", "to_world": T().translate([0, 0, 1]).scale(5), "flip_normals": True,
             "bsdf": diffuse(0.8)}  # fmt: skip
    scene = mi.load_dict(stage(room=white, wall=None, floor=None, camera=below_the_lamp()),
                         optimize=False)
    assert_image_of_path(scene, -1, 512, precision=0.01)


def test_a_hidden_lamp_does_not_cover_the_wall_behind_it() -> None:
    lamp = rectangle(T().translate([0, -1, 1]).rotate([1, 0, 0], -90).scale(0.3), bsdf=diffuse(),
                     emitter=area(3.0))  # fmt: skip
    scene = mi.load_dict(stage(light=lamp), optimize=False)
    assert_image_of_path(scene, 3, 512, hide_emitters=True)


def test_passes_and_rounds_share_their_kernels() -> None:
    scene, integrator = mi.load_dict(stage()), light_tracer(-1)
    integrator.samples_per_pass = 4
    batches(scene, integrator, 32, [1, 2])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        batches(scene, integrator, 32, [3])
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert integrator.statistics.passes == 8
    # Small ones compile in no time
    compiled = [k for k in kernels if not k["cache_hit"] and k["operation_count"] > 100]
    # The last rounds may have few vertices, for which another kernel is compiled
    assert len(compiled) <= 3, [k["operation_count"] for k in compiled]


def test_light_that_it_cannot_see_is_mentioned_once(capfd: pytest.CaptureFixture) -> None:
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"}}
    integrator = light_tracer()
    for scene in (stage(), stage(ball=ball), stage(ball=ball)):
        integrator.render(mi.load_dict(scene), spp=1)
    out = capfd.readouterr()
    assert (out.out + out.err).count("through glass") == 1
