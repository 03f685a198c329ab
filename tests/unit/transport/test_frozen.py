"""Recorded kernels render the same images without tracing, and never use stale data."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.render import Job
from mitsuba_ext.transport import call_description, frozen
from mitsuba_ext.transport.walk import Walk
from tests.support.stage import area, film, lookat, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")

INTEGRATORS = ["composed_path", "auto_path", "bdpt", "mlt", "pssmlt", "erpt"]

#: So few chains that each makes several mutations; pilots, which short renders do not have.
_CHAINS = {"mlt": {"chains": 256}, "pssmlt": {"chains": 256}, "auto_path": {"pilot_spp": 8}}


@pytest.fixture(autouse=True)
def nothing_recorded():
    frozen.forget_recordings()
    yield
    frozen.forget_recordings()


def _scene(**changes: Any) -> mi.Scene:
    lamp = {"type": "sphere", "center": [1, -1, 1.5], "radius": 0.2, "emitter": area(3.0)}
    return mi.load_dict(stage(second=lamp, **changes), optimize=False)


def _image(scene: mi.Scene, integrator: mi.Integrator, seed: int = 1, spp: int = 8) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp))


def _traced(scene: mi.Scene, integrator: mi.Integrator, seed: int = 1, spp: int = 8) -> np.ndarray:
    """Without recordings."""
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        return _image(scene, integrator, seed, spp)


def _recorded() -> list[str]:
    """The names of the functions that are recorded."""
    kept = frozen._process.scenes.values()
    return [key[0].__qualname__ for each in kept for key in each.recordings]


def _assert_same(image: np.ndarray, other: np.ndarray) -> None:
    # Threads add in any order
    np.testing.assert_allclose(image, other, rtol=1e-3, atol=1e-4 * other.mean())


@pytest.mark.parametrize("name", INTEGRATORS)
def test_images_agree_with_traced_kernels(name: str) -> None:
    parameters = {"type": name, "max_depth": 4, **_CHAINS.get(name, {})}
    scene, integrator = _scene(), mi.load_dict(parameters)
    for seed in (1, 2):
        _assert_same(_image(scene, integrator, seed), _traced(scene, integrator, seed))


_THIN_LENS = {"plugin": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}


@pytest.mark.parametrize(
    ("camera", "known", "renders"),
    [
        (_THIN_LENS, True, [1, 2]),
        (_THIN_LENS, False, [2, 3]),
        ({"plugin": "orthographic"}, True, [1, 2]),
    ],
)
def test_sensors_with_hidden_arrays(monkeypatch, camera: dict, known: bool, renders: list) -> None:
    """Camera rays are traced, and what follows is recorded. Where these sensors are not known, the
    first render begins twice, and nothing is recorded after that."""
    if not known:
        monkeypatch.setattr(call_description, "SENSORS_WITH_HIDDEN_ARRAYS", frozenset())
    jobs, start = [], Job.run
    monkeypatch.setattr(Job, "run", lambda job, *more: jobs.append(job) or start(job, *more))
    scene = _scene(camera=sensor(**camera))
    images, counts = [], []
    for _ in renders:
        images.append(_image(scene, mi.load_dict({"type": "composed_path", "max_depth": 3})))
        counts.append(len(jobs))
    assert counts == renders
    _assert_same(*images)
    _assert_same(images[0], _traced(scene, mi.load_dict({"type": "composed_path", "max_depth": 3})))
    assert _recorded() == (["_estimated"] if known else [])


@pytest.mark.parametrize(
    "name", ["auto_path", "bdpt", pytest.param("pssmlt", marks=pytest.mark.slow)]
)
def test_images_of_a_thin_lens_agree_with_traced_kernels(name: str) -> None:
    """Light paths and chains use the sensor, and are not recorded."""
    parameters = {"type": name, "max_depth": 4, **_CHAINS.get(name, {})}
    scene, integrator = _scene(camera=sensor(**_THIN_LENS)), mi.load_dict(parameters)
    for seed in (1, 2):
        _assert_same(_image(scene, integrator, seed, 32), _traced(scene, integrator, seed, 32))


@pytest.mark.parametrize("camera", [{}, _THIN_LENS])
def test_gradients_are_refused_before_anything_is_learned(camera: dict) -> None:
    scene = _scene(camera=sensor(**camera))
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["light.emitter.radiance.value"])
    parameters.update()
    integrator = mi.load_dict({"type": "auto_path", "max_depth": 3, "pilot_spp": 8})
    with pytest.raises(NotImplementedError, match='"auto_path" does not compute gradients'):
        integrator.render(scene, scene.sensors()[0], seed=1, spp=32)


def test_a_trial_of_light_paths_is_recorded() -> None:
    """The trial finds the same: its observer remembers the values of the pass that is observed."""
    scene = _scene(ball={"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}})
    integrator = mi.load_dict({"type": "vcm", "max_depth": 4, "light_paths": "auto"})

    def effect(image: Callable, seed: int) -> dict[str, Any]:
        image(scene, integrator, seed, 32)
        return integrator.statistics.effects["light_paths"]

    found = [effect(_image, seed) for seed in (1, 2)]
    assert {"_walked", "LightImage._connect"} <= set(_recorded())
    expected = [effect(_traced, seed) for seed in (1, 2)]
    assert [e["light_paths"] for e in found] == [e["light_paths"] for e in expected]
    for e, other in zip(found, expected):
        assert e["variance"] == pytest.approx(other["variance"], rel=1e-3)
        assert e["time"] == pytest.approx(other["time"], rel=1e-3)


def test_light_paths_with_learned_lights_begin_once(monkeypatch) -> None:
    """This includes scenes with point lights, whose probabilities only light paths need."""
    jobs, start = [], Job.run
    monkeypatch.setattr(Job, "run", lambda job, *more: jobs.append(job) or start(job, *more))
    intensity = {"type": "rgb", "value": 2.0}
    bulb = {"type": "point", "position": [-1.0, -1.0, 1.5], "intensity": intensity}
    scene = _scene(bulb=bulb)
    for seed in range(2):
        integrator = {"type": "bdpt", "max_depth": 3, "next_event": {"type": "learned_lights"}}
        _image(scene, mi.load_dict(integrator), seed, 32)
    assert len(jobs) == 2


def test_a_batch_of_sensors_is_not_recorded() -> None:
    """It loads a table of its sensors while it is traced, at which Dr.Jit ends the process."""
    film = {"type": "hdrfilm", "width": 64, "height": 36}
    views = {f"view_{i}": sensor(film={**film, "width": 32}, fov=30.0 + i) for i in range(2)}
    scene = _scene(camera={"type": "batch", "film": film, **views})
    integrator = mi.load_dict({"type": "auto_path", "max_depth": 3, "pilot_spp": 8})
    _assert_same(_image(scene, integrator, spp=32), _traced(scene, integrator, spp=32))
    assert not frozen._process.scenes


def test_parameters_without_a_value_are_no_error() -> None:
    """``sigma_a`` of hair is ``None`` where the pigments are given, and Mitsuba raises."""
    scene = _scene(hair={"type": "sphere", "radius": 0.3, "bsdf": {"type": "hair"}})
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    for seed in (1, 2):
        _assert_same(_image(scene, integrator, seed), _traced(scene, integrator, seed))


def test_a_second_render_traces_nothing(monkeypatch) -> None:
    calls = []
    trace = Walk._trace
    monkeypatch.setattr(Walk, "_trace", lambda *a: calls.append(1) or trace(*a))
    scene = _scene()
    _image(scene, mi.load_dict({"type": "composed_path", "max_depth": 3}))
    assert len(calls) == 1
    # Another integrator with the same decisions, and another seed
    _image(scene, mi.load_dict({"type": "composed_path", "max_depth": 3}), seed=5)
    assert len(calls) == 1
    # An equal scene is another one
    _image(_scene(), mi.load_dict({"type": "composed_path", "max_depth": 3}))
    assert len(calls) == 2


def test_a_result_that_no_recording_knows_is_refused() -> None:
    """Dr.Jit returns it as it was when it was recorded."""

    class Numbers:
        def __init__(self, values: mi.Float) -> None:
            self.values = values

    @frozen.frozen
    def next_ones(values: mi.Float) -> Numbers:
        return Numbers(values + 1)

    scene = _scene()
    with pytest.raises(TypeError, match=r"next_ones is frozen, and returns a .*Numbers"):
        frozen.with_recordings(
            scene, scene.sensors()[0], lambda: next_ones(dr.opaque(mi.Float, 1, 4))
        )


def _updated(key: str, value: Callable[[Any], Any]) -> Callable[[mi.Scene], None]:
    def change(scene: mi.Scene) -> None:
        parameters = mi.traverse(scene)
        keys = [k for k in parameters.keys() if k.endswith(key)]
        assert keys, list(parameters.keys())
        parameters[keys[0]] = value(parameters[keys[0]])
        parameters.update()

    return change


CHANGES = {
    "eta": _updated("glass.bsdf.eta", lambda x: 1.8),
    "place": _updated(
        "glass.to_world",
        lambda x: mi.Transform4f().translate([0.5, 0.3, 0.2]) @ mi.Transform4f(x).scale(0.7),
    ),
    "bitmap": _updated("picture.bsdf.reflectance.data", lambda x: mi.TensorXf(
        np.random.default_rng(2).random((7, 3, 3), dtype=np.float32))),
    "to_uv": _updated("to_uv", lambda x: mi.ScalarTransform3f().scale([3.0, 9.0])),
    "reflectance": _updated("reflectance.value", lambda x: x * 0.5),
    "radiance": _updated("radiance.value", lambda x: x * 3),
    "vertices": _updated("vertex_positions", lambda x: x + 0.1),
    "near_clip": _updated("near_clip", lambda x: 3.5),
    "sampling_weight": _updated("emitter.sampling_weight", lambda x: 7.0),
    "crop": _updated("film.crop_offset", lambda x: mi.ScalarPoint2u(2, 1)),
    "camera": _updated(
        "sensor.to_world", lambda x: mi.Transform4f().translate([0.3, 0, 0]) @ mi.Transform4f(x)
    ),
}


@pytest.mark.parametrize("name", ["composed_path", "bdpt"])
@pytest.mark.parametrize("change", CHANGES)
def test_changes_of_a_scene_are_seen(change: str, name: str) -> None:
    squares = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([4, 4, 1])}
    scene = _scene(
        glass={"type": "sphere", "center": [-0.8, -0.6, 0.4], "radius": 0.4,
               "bsdf": {"type": "dielectric"}},
        tile={"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.01]),
              "bsdf": {"type": "diffuse", "reflectance": squares}},
        picture={"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([1, 0, 0.02]),
                 "bsdf": {"type": "diffuse", "reflectance": {
                     "type": "bitmap", "bitmap": mi.Bitmap(np.ones((4, 4, 3), np.float32))}}},
    )  # fmt: skip
    integrator = mi.load_dict({"type": name, "max_depth": 4})
    before = _image(scene, integrator)
    if change == "crop":
        parameters = mi.traverse(scene.sensors()[0])
        size = parameters["film.size"]
        parameters["film.crop_size"] = mi.ScalarVector2u(size[0] - 4, size[1] - 4)
        parameters.update()
        _image(scene, integrator)
    CHANGES[change](scene)
    after = _image(scene, integrator)
    _assert_same(after, _traced(scene, integrator))
    assert after.shape != before.shape or np.abs(after - before).max() > 1e-3 * before.mean()


@pytest.mark.parametrize("opaque", [False, True])
def test_changes_of_a_phase_function_are_seen(opaque: bool) -> None:
    """Mitsuba hides its arrays from Dr.Jit."""
    fog = {"type": "homogeneous", "sigma_t": 4.0, "phase": {"type": "hg", "g": 0.5}}
    scene = _scene(fog={"type": "sphere", "center": [0, -0.6, 0.5], "radius": 0.5,
                        "bsdf": {"type": "null"}, "interior": fog})  # fmt: skip
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    before = _image(scene, integrator)
    for g in (-0.9, 0.9):
        value = dr.opaque(mi.Float, g) if opaque else mi.Float(g)
        _updated("phase_function.g", lambda _, g=value: g)(scene)
        after = _image(scene, integrator)
        _assert_same(after, _traced(scene, integrator))
        assert np.abs(after - before).max() > 0.01 * before.mean()


@pytest.mark.parametrize("name", ["composed_path", "bdpt"])
def test_perspective_cameras_with_equal_films_share_recordings(name: str) -> None:
    """An optimization may have a camera for each of a hundred photographs."""
    scene, integrator = _scene(), mi.load_dict({"type": name, "max_depth": 3})
    views = [([0, -4, 1.2], {}), ([2, -3, 1], {"fov": 30}), ([1, -4, 2], {"near_clip": 3.0})]
    counts = []
    for origin, more in views:
        view = lookat(origin, [0, 0, 0.6], [0, 0, 1])
        camera = mi.load_dict(sensor(to_world=view, **more))
        found = np.array(mi.render(scene, sensor=camera, integrator=integrator, seed=1, spp=8))
        counts.append(len(_recorded()))
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            again = mi.render(scene, sensor=camera, integrator=integrator, seed=1, spp=8)
        _assert_same(found, np.array(again))
    assert counts[0] == counts[1] < counts[2]


def test_recordings_know_all_that_cameras_differ_in() -> None:
    """Cameras take turns, one of which changes between its renders. The scene has no sensor of its
    own: Dr.Jit would record each camera anew."""
    described = stage()
    del described["sensor"]
    scene = mi.load_dict(described, optimize=False)
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 2})
    gaussian = {"type": "gaussian", "stddev": 0.4}
    views = [
        {}, {"sampler": "stratified"},
        {"fov": 30, "near_clip": 3.0, "far_clip": 9.0, "principal_point_offset_x": 0.2,
         "shutter_close": 1.0, "to_world": lookat([2, -3, 1], [0, 0, 0.6], [0, 0, 1]),
         "film": film(24, 20, crop_width=16, crop_height=16, crop_offset_x=3, rfilter=gaussian)},
        _THIN_LENS,
    ]  # fmt: skip
    views = [sensor(**view) for view in views]
    views.append({**views[1], "sampler": {"type": "stratified", "jitter": False}})
    cameras = list(map(mi.load_dict, views))
    for x_fov in (45.0, 60.0):
        parameters = mi.traverse(cameras[0])
        parameters["x_fov"] = x_fov
        parameters.update()
        for camera in cameras:
            images = []
            for flag in (True, False):
                with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, flag):
                    images.append(
                        mi.render(scene, sensor=camera, integrator=integrator, seed=1, spp=9)
                    )
            _assert_same(*map(np.array, images))


def test_recordings_know_the_number_of_strata() -> None:
    """The last pass of four has as many samples as a render with a quarter of the samples."""
    scene = _scene(camera=sensor(sampler="stratified", film=film(8, 8)))
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 2, "samples_per_pass": 4})
    for spp in (4, 16):
        _assert_same(_image(scene, integrator, 1, spp), _traced(scene, integrator, 1, spp))


def test_scenes_that_share_their_sensor_are_two() -> None:
    """They differ in what no parameter tells."""
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    camera = mi.load_dict(sensor())
    for distribution in ("ggx", "beckmann"):
        metal = {"type": "roughconductor", "alpha": 0.3, "distribution": distribution}
        ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5, "bsdf": metal}
        scene = mi.load_dict({**stage(block=None, ball=ball), "sensor": camera}, optimize=False)
        _assert_same(_image(scene, integrator), _traced(scene, integrator))
        # Its successor may get its address
        del scene
        gc.collect()
    assert len(frozen._process.scenes) == 2


def test_parameters_of_the_integrator_are_seen() -> None:
    scene = _scene()
    for parameters in ({"max_depth": 2}, {"max_depth": 4}, {"max_depth": 4, "rr_depth": 1},
                       {"max_depth": 4, "hide_emitters": True}):  # fmt: skip
        integrator = mi.load_dict({"type": "composed_path", **parameters})
        _assert_same(_image(scene, integrator), _traced(scene, integrator))


def test_frozen_kernels_read_the_tables_that_the_render_learned() -> None:
    """The tables have other sizes and other contents, and the kernels are the same."""
    scene = _scene()
    for spp, seed in ((16, 1), (16, 2), (64, 3), (16, 1)):
        integrator = mi.load_dict({"type": "neepp", "max_depth": 4, "grid": 4})
        _assert_same(
            _image(scene, integrator, seed, spp), _traced(scene, integrator, seed, spp)
        )


def test_the_number_of_threads_is_seen() -> None:
    """Kernels that add from several threads have memory for the current number of threads."""
    scene, integrator = _scene(), mi.load_dict({"type": "composed_path", "max_depth": 3})
    expected, count = _traced(scene, integrator), dr.thread_count()
    try:
        for threads in (1, 2, 1, 3):
            dr.set_thread_count(threads)
            _assert_same(_image(scene, integrator), expected)
    finally:
        dr.set_thread_count(count)


def _lit_by_a_plugin() -> mi.Scene:
    place = mi.ScalarTransform4f().translate([0, 0, 1.9]).rotate([1, 0, 0], 180).scale(0.3)
    lamp = {"type": "solid_angle_area", "radiance": 5.0}
    return mi.load_dict(stage(light={"type": "rectangle", "to_world": place, "emitter": lamp}))


def test_plugins_in_python_are_traced_each_time() -> None:
    """Plugins of other scenes too, because Dr.Jit traces all plugins of a kind. If a plugin freed
    memory while a kernel is recorded, the process would end."""
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    other = _lit_by_a_plugin()
    for scene in (other, _scene()):
        for seed in (1, 2):
            _assert_same(_image(scene, integrator, seed), _traced(scene, integrator, seed))
    assert not frozen._process.scenes
    scene = _scene()
    del other
    gc.collect()
    _image(scene, integrator)
    assert len(frozen._process.scenes) == 1


class _ReadingWalk(Walk):
    """Reads an array while it is traced."""

    def __call__(self, scene, sampler, rays, active):
        sample = super().__call__(scene, sampler, rays, active)
        sample.L *= float(dr.opaque(mi.Float, 2.0)[0])
        return sample


class _CopyingWalk(Walk):
    """Fails as Dr.Jit does on a GPU, where it cannot record that memory is copied."""

    def __call__(self, scene, sampler, rays, active):
        if dr.flag(dr.JitFlag.FreezingScope):
            raise RuntimeError("record(): Tried to record a memcpy_async operation")
        sample = super().__call__(scene, sampler, rays, active)
        sample.L *= 2
        return sample


@pytest.mark.parametrize("kind", [_ReadingWalk, _CopyingWalk])
def test_walks_that_cannot_be_recorded_render_the_same_image(kind: type[Walk]) -> None:
    scene, integrator = _scene(), mi.load_dict({"type": "composed_path", "max_depth": 3})
    expected = 2 * _traced(scene, integrator)
    integrator.walk = lambda decisions, observer=None: kind(3, 5, **decisions.of_walk())
    for _ in range(2):
        _assert_same(_image(scene, integrator), expected)


def test_recordings_keep_no_scene_alive() -> None:
    scene, integrator = _scene(), mi.load_dict({"type": "composed_path"})
    _image(scene, integrator)
    things = [scene, *scene.shapes(), *scene.sensors(), *scene.emitters()]
    counts = [sys.getrefcount(thing) for thing in things]
    frozen.forget_recordings()
    assert [sys.getrefcount(thing) for thing in things] == counts


def test_the_walk_is_recorded_beside_masks_and_variables_of_mitsuba() -> None:
    scene = _scene()
    integrator = mi.load_dict({
        "type": "composed_path", "max_depth": 3, "aovs": "d:depth,o:object_id,c:C<R>L",
    })  # fmt: skip
    images = [_image(scene, integrator, seed) for seed in (1, 2)]
    assert _recorded() == ["_estimated"]
    for seed, image in zip((1, 2), images):
        _assert_same(image, _traced(scene, integrator, seed))
