"""Moving cameras: each ray agrees with a camera that rests at the pose of the ray's time."""

from __future__ import annotations

import functools
from typing import Any, Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_ext.scene.movers import is_moving_camera
from mitsuba_ext.transport.path_decisions import SceneQuery
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.motions import LENS, Pose, at, camera, keyed, pair, room, sky, uniform
from tests.support.stage import diffuse, film, rectangle
from tests.support.statistical import (
    SEEDS,
    assert_same_image,
    assert_same_pixels_on_average,
    batches,
    two_halves,
)
from tests.support.techniques import REFERENCE, TECHNIQUES

Scene = dict[str, Any]


@pytest.fixture(autouse=True)
def quiet(variant: str) -> None:
    mi.set_log_level(mi.LogLevel.Error)


def keys() -> tuple[Scene, Pose]:
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0.1, 0.2], [-0.15, 0, -0.1]])
    return keyed([0.1, 0.4, 0.9], rotations, [[-0.3, 0, 0], [0.4, 0.2, 0.2], [0, -0.3, 0.1]])


PAN = uniform([0.3, 0, 0.1], [0.1, 0, 1], 12.0, [0, -4, 1.2])

#: Plugins of sensors, their parameters, and whether they have differentials of their own.
SENSORS: dict[str, Scene] = {
    "perspective": {"principal_point_offset_x": 0.2},
    "thinlens": {"aperture_radius": 0.15, "focus_distance": 4.0},
    "orthographic": {},
    "radiancemeter": {"film": film(1, 1)},
}


def _moved(parameters: Scene, **nested: Any) -> Scene:
    """A camera that moves from its place in the room, as the parameters say."""
    return {"type": "moving_camera", **parameters, "camera": camera(**nested)}


def _placed(pose: np.ndarray, begin: float = 0.0, end: float = 0.0, **changes: Any) -> Scene:
    """The same camera at rest."""
    still = camera(begin, end, **changes)
    return {**still, "to_world": at(pose, still["to_world"])}


# ---- Rays ----


@pytest.mark.parametrize("plugin", SENSORS)
def test_rays_agree_with_the_camera_at_the_pose(plugin: str) -> None:
    parameters, pose = keys()
    sensor = mi.load_dict(_moved(parameters, plugin=plugin, **SENSORS[plugin]))
    rng = np.random.default_rng(1)
    numbers = [mi.Point2f(rng.uniform(size=(2, 100))) for _ in range(2)]
    for time in (-1.0, 0.1, 0.33, 0.6, 2.0):
        still = mi.load_dict(_placed(pose(time), plugin=plugin, **SENSORS[plugin]))
        for method in ("sample_ray", "sample_ray_differential"):
            one, other = (
                getattr(s, method)(mi.Float(time), mi.Float(0.3), *numbers)[0]
                for s in (sensor, still)
            )
            fields = ["o", "d", "maxt", "time"]
            if method == "sample_ray_differential" and plugin != "radiancemeter":
                fields += ["o_x", "o_y", "d_x", "d_y", "has_differentials"]
            for field in fields:
                a, b = (np.array(getattr(ray, field)) for ray in (one, other))
                np.testing.assert_allclose(*np.broadcast_arrays(a, b), atol=2e-6, err_msg=field)


@pytest.mark.parametrize("plugin", ["perspective", "thinlens"])
def test_connections_lead_to_the_camera_at_the_pose(plugin: str) -> None:
    parameters, pose = keys()
    sensor = mi.load_dict(_moved(parameters, plugin=plugin, **SENSORS[plugin]))
    rng = np.random.default_rng(1)
    it = dr.zeros(mi.Interaction3f, 200)
    it.p = mi.Point3f(rng.normal(size=(3, 200)))
    lens = mi.Point2f(rng.uniform(size=(2, 200)))
    for time in (0.1, 0.6):
        it.time = mi.Float(time)
        still = mi.load_dict(_placed(pose(time), plugin=plugin, **SENSORS[plugin]))
        (ds, weight), (wanted, theirs) = (s.sample_direction(it, lens) for s in (sensor, still))
        seen = np.array(wanted.pdf) > 0
        assert seen.mean() > 0.3
        np.testing.assert_array_equal(np.array(ds.pdf) > 0, seen)
        for field in ("p", "d", "n", "uv", "pdf", "dist"):
            a, b = (np.array(getattr(x, field)) for x in (ds, wanted))
            np.testing.assert_allclose(*np.broadcast_arrays(a, b)[:2], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(weight, theirs, rtol=2e-4)


# ---- Images ----


def test_closed_shutter_shows_the_view_of_its_time() -> None:
    """With the numbers of ``path``, by ours and by Mitsuba's, on a part of an odd film."""
    parameters, pose = keys()
    changes = {"film": film(37, 21, crop_offset_x=5, crop_offset_y=3, crop_width=20,
                            crop_height=15, rfilter={"type": "gaussian"})}  # fmt: skip
    things = pair(np.eye(4))
    moving = mi.load_dict(
        room(_moved(parameters, begin=0.35, end=0.35, **changes), **things, light=sky())
    )
    still = mi.load_dict(room(_placed(pose(0.35), **changes), **things, light=sky()))
    wanted = batches(still, REFERENCE.make(4), 16, [5])[0]
    for technique in (REFERENCE, TECHNIQUES["composed_path"]):
        assert_same_image(batches(moving, technique.make(4), 16, [5])[0], wanted)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_closed_shutter_in_variant(variant: str) -> None:
    test_closed_shutter_shows_the_view_of_its_time()


def _view(case: str) -> tuple[tuple[Scene, Pose], Scene, tuple[float, float]]:
    """Motion, changes of the camera, and shutter."""
    motion, changes, shutter = {
        "pan": (PAN, {}, (0.0, 1.0)),
        "keys_through_a_lens": (keys(), LENS, (0.2, 1.0)),
    }[case]
    return motion, changes, shutter


def _things() -> Scene:
    """No caustics: not all techniques of light paths find the caustics of the ball in the
    mirror."""
    return {**pair(np.eye(4)), "mirror": rectangle(mi.ScalarTransform4f().translate([0, 0, -9]))}


@functools.cache
def reference(case: str) -> np.ndarray:
    """Images of ``path`` with cameras at rest, averaged over 64 times in the middle of strata."""
    (_parameters, pose), changes, (begin, end) = _view(case)
    scenes = (
        mi.load_dict(room(_placed(pose(begin + (end - begin) * (i + 0.5) / 64), **changes),
                          **_things()))
        for i in range(64)
    )  # fmt: skip
    images = [
        batches(scene, REFERENCE.make(4), 64, [seed + i for seed in (1001, 2001)])
        for i, scene in enumerate(scenes)
    ]
    return np.mean(images, axis=0)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        *(
            pytest.param(case, name, marks=pytest.mark.slow)
            for case, name in (
                ("pan", "composed_path"),
                ("keys_through_a_lens", "bdpt"),
                ("keys_through_a_lens", "composed_path"),
                ("keys_through_a_lens", "light_tracer"),
                ("keys_through_a_lens", "light_tracer_visibility"),
                ("keys_through_a_lens", "path"),
                ("pan", "ptracer"),
                ("pan", "bdpt"),
                ("pan", "neepp"),
                ("pan", "pss_guided"),
                ("pan", "mlt"),
                ("pan", "bidirectional_chains"),
            )
        ),
    ],
)
def test_image_is_the_average_of_views_at_rest(case: str, name: str) -> None:
    (parameters, _pose), changes, (begin, end) = _view(case)
    scene = mi.load_dict(
        room(_moved(parameters, begin=begin, end=end, **changes), **_things())
    )
    images = two_halves(scene, _integrator(name), 4096, SEEDS)
    precision = 0.02 if name in ("mlt", "bidirectional_chains") else 0.004
    assert_same_pixels_on_average(images, reference(case), precision=precision, tile=4)


def _integrator(name: str) -> mi.Integrator:
    makers: dict[str, Callable[[], mi.Integrator]] = {
        "path": lambda: REFERENCE.make(4),
        "ptracer": lambda: mi.load_dict({"type": "ptracer", "max_depth": 4}),
        "light_tracer_visibility": lambda: mi.load_dict(
            {"type": "light_tracer", "max_depth": 4, "lens_sampling": "visibility"}
        ),
        "light_tracer": lambda: mi.load_dict({"type": "light_tracer", "max_depth": 4}),
        "bdpt": lambda: mi.load_dict({"type": "bdpt", "max_depth": 4}),
    }
    return makers[name]() if name in makers else TECHNIQUES[name].make(4)


def test_a_turning_camera_sees_the_image_of_a_world_that_turns_the_other_way() -> None:
    """Ray by ray: a motion of the camera is the inverse motion of all things."""
    T = mi.ScalarTransform4f
    turn = {"axis": [0.2, 0.1, 1], "center": [0.1, -1, 0.3], "begin": 0.2, "end": 0.9}
    things = {
        "floor": rectangle(T().scale([2, 2, 1]), bsdf=diffuse()),
        "wall": rectangle(T().translate([0, 1.5, 1]).rotate([1, 0, 0], 90), bsdf=diffuse(0.8)),
        **pair(np.eye(4)),
    }
    light = {"type": "constant"}
    turning = mi.load_dict({"type": "scene", "light": light, **things,
                            "sensor": _moved({**turn, "angle": 30.0}, end=1.0)})  # fmt: skip
    turned = {"type": "moving", **turn, "angle": -30.0, **things}
    standing = mi.load_dict({"type": "scene", "light": light, "world": turned,
                             "sensor": camera(0.0, 1.0)})  # fmt: skip
    # Connections to the sky would be the same in the world, and not relative to the things
    integrator = mi.load_dict({"type": "composed_path", "mis": "bsdf", "max_depth": 3})
    images = [batches(scene, integrator, 64, [3])[0] for scene in (turning, standing)]
    # At edges, rounding decides what is hit
    difference = np.abs(images[0] - images[1])
    assert (difference < 1e-4).mean() > 0.75
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=1e-3)
    blur = batches(standing, integrator, 64, [4])[0] - images[1]
    assert difference.mean() < 0.1 * np.abs(blur).mean()


# ---- What it is, and what it refuses ----


XML = """<scene version="3.0.0">
    <sensor type="moving_camera" id="pan">
        <transform name="pose_0"><lookat origin="0,-4,1" target="-0.3,0,1" up="0,0,1"/></transform>
        <float name="time_0" value="0"/>
        <transform name="pose_1"><lookat origin="0,-4,1" target="0.3,0,1" up="0,0,1"/></transform>
        <float name="time_1" value="0.5"/>
        <sensor type="thinlens">
            <float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>
            <float name="shutter_open" value="0.25"/><float name="shutter_close" value="1"/>
            <sampler type="independent"><integer name="sample_count" value="7"/></sampler>
            <film type="hdrfilm">
                <integer name="width" value="5"/><integer name="height" value="4"/>
            </film>
        </sensor>
    </sensor>
    <sensor type="perspective"/>
    <shape type="sphere"/>
</scene>"""


def test_camera_of_a_file(tmp_path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(XML)
    scene = mi.load_file(str(file))
    first, second = scene.sensors()
    assert is_moving_camera(first) and not is_moving_camera(second) and first.id() == "pan"
    assert (first.shutter_open(), first.shutter_open_time()) == (0.25, 0.75)
    assert list(first.film().size()) == [5, 4] and first.sampler().sample_count() == 7
    assert first.needs_aperture_sample() and "segments = 1" in str(first)
    assert type(scene_query(scene)) is SceneQuery
    box = first.bbox()
    np.testing.assert_allclose([*box.min, *box.max], [0, -4, 1] * 2, atol=1e-5)


def test_parameters_of_the_camera_can_be_changed() -> None:
    parameters, pose = keys()
    sensor = mi.load_dict(_moved(parameters, begin=0.35, end=0.35))
    values = mi.traverse(sensor)
    values["x_fov"] = 10.0
    values.update()
    still = mi.load_dict({**_placed(pose(0.35)), "fov": 10.0})
    rays = [s.sample_ray(0.35, 0.5, mi.Point2f(0.1, 0.2), mi.Point2f(0.5))[0]
            for s in (sensor, still)]  # fmt: skip
    np.testing.assert_allclose(rays[0].d, rays[1].d, atol=1e-6)
    values["shutter_open"] = 0.5
    with pytest.raises(NotImplementedError, match="shutter interval cannot be changed"):
        values.update()


@pytest.mark.parametrize(
    ("nested", "message"),
    [
        ({}, "exactly one sensor .* found none"),
        ({"film": film()}, "exactly one sensor"),
        ({"a": {"type": "perspective"}, "b": {"type": "perspective"}}, "exactly one sensor"),
        ({"a": {"type": "distant", "film": film(1, 1)}}, "no place that could move"),
        ({"a": {"type": "moving_camera", "translate": [1, 0, 0], "b": {"type": "perspective"}}},
         "moves already"),
        ({"a": {"type": "perspective"}, "scale": 3.0}, "scale"),
    ],
)
def test_objects_that_cannot_move_are_refused(nested: Scene, message: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": "moving_camera", "translate": [1, 0, 0], **nested})


def test_depth_of_field_by_layers_is_refused() -> None:
    scene = mi.load_dict(room(_moved(PAN[0], **LENS)))
    integrator = mi.load_dict({"type": "ecoc_dof", "nested": {"type": "composed_path"}})
    with pytest.raises(NotImplementedError, match="the sensor moves"):
        integrator.render(scene, spp=1)
