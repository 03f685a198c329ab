"""Moving shapes: the image is the average of images at rest, each at the pose of its time."""

from __future__ import annotations

import functools
from typing import Any, Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_ext.scene.motion.rigid_motion import Motion, PoseTable
from mitsuba_ext.transport.path_decisions import SceneQuery
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.motions import LENS, Pose, at, camera, keyed, pair, plate, room, sky, uniform
from tests.support.stage import diffuse, lookat, rectangle
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
    # Spheres say that rotations round
    mi.set_log_level(mi.LogLevel.Error)


# ---- Motions and scenes ----

SPIN = uniform([0.5, -0.3, 0.2], [0, 0.4, 1], 420.0, [0.1, 0, 0.5])
SLIDE = uniform([0, -0.8, 0], [0, 0, 1], 0.0, [0, 0, 0], begin=0.1, end=0.6)


def keys() -> tuple[Scene, Pose]:
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0.5, 1.2], [-0.6, 0.5, 2.9], [0, 1, 2]])
    positions = [[-0.3, 0, 0], [0.4, 0, 0.2], [0.3, -0.6, 0.5], [0, 0.1, 0.3]]
    return keyed([0.1, 0.4, 0.7, 0.9], rotations, positions)


#: Shutter, other parameters of the camera, what else is in the scene (made in the variant), and
#: what moves how.
CASES: dict[str, tuple] = {
    "turns_more_than_once": ((0.0, 1.0), {}, dict, lambda: [(SPIN, pair)]),
    "keys_under_sky": ((0.0, 1.0), {}, lambda: {"lamp": sky()}, lambda: [(keys(), pair)]),
    "two_through_a_lens": (
        (0.2, 0.7), LENS, lambda: {"sky": sky()}, lambda: [(SPIN, pair), (SLIDE, plate)],
    ),
}  # fmt: skip


def moving_scene(case: str) -> mi.Scene:
    shutter, changes, things, movers = CASES[case]
    moving = {
        f"moving_{i}": {"type": "moving", **parameters, **make(np.eye(4))}
        for i, ((parameters, _), make) in enumerate(movers())
    }
    return mi.load_dict(room(camera(*shutter, **changes), **things(), **moving))


def resting_scene(case: str, time: float) -> mi.Scene:
    _, changes, things, movers = CASES[case]
    resting: Scene = {}
    for (_, pose), make in movers():
        resting.update(make(pose(time)))
    return mi.load_dict(room(camera(**changes), **things(), **resting))


@functools.cache
def reference(case: str) -> np.ndarray:
    """Images of ``path``, averaged over 64 times in the middle of strata."""
    (begin, end), *_ = CASES[case]
    images = []
    for i in range(64):
        scene = resting_scene(case, begin + (end - begin) * (i + 0.5) / 64)
        images.append(batches(scene, REFERENCE.make(4), 64, [seed + i for seed in (1001, 2001)]))
    return np.mean(images, axis=0)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        ("turns_more_than_once", "composed_path"),
        ("two_through_a_lens", "composed_path"),
        ("two_through_a_lens", "rejecting"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("keys_under_sky", "composed_path"),
                ("two_through_a_lens", "pss_guided"),
                ("two_through_a_lens", "many_connections"),
            )
        ),
    ],
)
def test_image_is_the_average_of_images_at_rest(case: str, name: str) -> None:
    images = two_halves(moving_scene(case), TECHNIQUES[name].make(4), 4096, SEEDS)
    assert_same_pixels_on_average(images, reference(case), precision=0.003, tile=4)


def test_integrators_that_nest_ours_see_motion() -> None:
    scene = moving_scene("keys_under_sky")
    inner = TECHNIQUES["composed_path"].make(4)
    moment = mi.load_dict({"type": "moment", "image": inner})
    images = [batches(scene, integrator, 16, [5])[0] for integrator in (moment, inner)]
    assert_same_image(images[0][..., :3], images[1])


def test_blur_differs_from_the_view_at_any_single_time() -> None:
    """If it did not, the tests of the mean would prove nothing."""
    case = "turns_more_than_once"
    image = batches(resting_scene(case, 0.5), REFERENCE.make(4), 256, [1])[0]
    assert np.abs(image - reference(case).mean(axis=0)).mean() > 0.05 * image.mean()


@pytest.mark.parametrize("time", [-1.0, 0.35, 2.0])
def test_closed_shutter_shows_the_pose_of_its_time(time: float) -> None:
    """With the numbers of ``path``; before the motion and after it, its ends."""
    things = {"moving": {"type": "moving", **keys()[0], **pair(np.eye(4))}}
    moving = mi.load_dict(room(camera(time, time), **things))
    resting = mi.load_dict(room(camera(0.0, 0.0), **pair(keys()[1](time))))
    image = batches(moving, TECHNIQUES["composed_path"].make(4), 16, [5])[0]
    assert_same_image(image, batches(resting, REFERENCE.make(4), 16, [5])[0])


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_closed_shutter_in_variant(variant: str) -> None:
    test_closed_shutter_shows_the_pose_of_its_time(0.35)


@pytest.mark.parametrize("distance", [0.0, 100.0, 3000.0])
def test_moving_things_do_not_shadow_themselves(distance: float) -> None:
    """A convex thing under a uniform sky is as bright as its albedo; acne would be darker."""
    T = mi.ScalarTransform4f
    thing = {"type": "cube", "bsdf": diffuse(0.5), "to_world": T().translate([distance] * 3)}
    around = [distance] * 3
    scene = mi.load_dict({
        "type": "scene",
        "sensor": camera(0.0, 1.0, to_world=lookat([distance + 6, distance + 5, distance + 4],
                                                   [distance + 1] * 3, [0, 0, 1]), fov=8.0),
        "sky": {"type": "constant"},
        "moving": {"type": "moving", "axis": [1, 1, 1], "angle": 700.0, "center": around,
                   "thing": thing},
    })  # fmt: skip
    image = batches(scene, TECHNIQUES["composed_path"].make(6), 64, [1])[0]
    assert image[4:12, 4:12].mean() == pytest.approx(0.5, rel=0.005)


# ---- Interactions ----


FIELDS = ("t", "time", "p", "n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv", "wi", "prim_index")


def test_interactions_agree_with_objects_at_the_pose() -> None:
    parameters, pose = keys()
    time = 0.55

    def things(pose: np.ndarray) -> Scene:
        T = mi.ScalarTransform4f
        group = {"type": "shapegroup", "a": {"type": "cylinder", "radius": 0.2}}
        return {**pair(pose), **plate(pose), "group": {**group, "id": "group"},
                "one": {"type": "instance", "group": {"type": "ref", "id": "group"},
                        "to_world": at(pose, T().translate([0.2, 0.6, 0]).scale(0.7))}}  # fmt: skip

    moving = mi.load_dict({
        "type": "scene", "floor": rectangle(),
        "moving": {"type": "moving", **parameters, **things(np.eye(4))},
    })  # fmt: skip
    resting = mi.load_dict({"type": "scene", "floor": rectangle(), **things(pose(time))})
    rng = np.random.default_rng(1)
    o = rng.normal(size=(3, 20_000)) * 3
    d = rng.uniform(-0.8, 0.8, size=o.shape) + [[0], [0], [0.5]] - o
    ray = mi.Ray3f(mi.Point3f(o), dr.normalize(mi.Vector3f(d)))
    ray.time = mi.Float(time)
    query = scene_query(moving)
    si = query.interaction(query.closest(moving, ray, False, mi.Bool(True)), ray)
    wanted = resting.ray_intersect(ray)

    def agree(a: Any, b: Any) -> np.ndarray:
        same = np.isclose(np.array(a), np.array(b), rtol=2e-3, atol=2e-3)
        return np.broadcast_to(same, (*same.shape[:-1], dr.width(ray)))

    hit = np.array(wanted.is_valid())
    assert 0.2 < hit.mean() < 0.95
    assert (np.array(si.is_valid()) == hit).mean() > 0.999
    # At edges, one finds another face than the other
    for field in FIELDS:
        same = agree(getattr(si, field), getattr(wanted, field))[..., hit]
        assert same.mean() > 0.997, f"{field}: {same.mean()}"
    for axis in "stn":
        same = agree(getattr(si.sh_frame, axis), getattr(wanted.sh_frame, axis))[..., hit]
        assert same.mean() > 0.997, f"sh_frame.{axis}: {same.mean()}"
    assert len(np.unique(np.array(dr.reinterpret_array(mi.UInt32, si.shape)))) > 4


def test_shadow_rays_carry_the_time() -> None:
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.time = mi.Float(0.25, 0.75)
    assert np.array(si.spawn_ray_to(mi.Point3f(1, 2, 3)).time).tolist() == [0.25, 0.75]


def test_scene_at_rest_gets_the_default_query() -> None:
    """So that nothing of all this is in its kernels."""
    assert type(scene_query(mi.load_dict(room(camera(), **pair(np.eye(4)))))) is SceneQuery


# ---- Poses and bounds ----


MOTIONS = {
    "turn": Motion.uniform(0.2, 1.5, [1, 2, 3], [9, 1, 2], [1, -1, 0.5]),
    "keys": Motion.keyed([0, 0.5, 0.7, 2], [
        np.block([[Rotation.from_rotvec(turn).as_matrix(), np.array([position]).T],
                  [np.zeros((1, 3)), np.ones((1, 1))]])
        for turn, position in [([0, 0, 0], [0, 1, 0]), ([1, 2, 0], [1, 1, 1]),
                               ([0, -1, 2], [0, 3, 0]), ([3, 0, 0], [2, 2, 2])]
    ]),
    "line": Motion.uniform(-1, 1, [1, 0, 0]),
}  # fmt: skip


@pytest.mark.parametrize("make", [lambda: SPIN, lambda: SLIDE, keys], ids=["spin", "slide", "keys"])
def test_poses_agree_with_poses_computed_by_hand(make: Callable) -> None:
    parameters, pose = make()
    shape = mi.load_dict({"type": "moving", **parameters, "cube": {"type": "cube"}})
    points = np.random.default_rng(2).normal(size=(5, 3))
    for time in np.linspace(-0.2, 1.2, 29):
        wanted = points @ pose(time)[:3, :3].T + pose(time)[:3, 3]
        np.testing.assert_allclose(shape.motion.move(points, time), wanted, atol=1e-5)


def test_device_knows_the_poses() -> None:
    motions = list(MOTIONS.values())
    table = PoseTable(motions)
    times = np.linspace(-2, 3, 101)
    p = np.array([[0.3, 0.2, 0.1]])
    for index, motion in enumerate(motions):
        pose = table.pose(mi.UInt32(index), mi.Float(times))
        si = dr.zeros(mi.SurfaceInteraction3f, len(times))
        si.p = mi.Point3f(*p[0].tolist())
        wanted = np.concatenate([motion.move(p, time) for time in times])
        moved = pose.to_world(si).p
        np.testing.assert_allclose(np.array(moved).T, wanted, atol=5e-6)
        ray = pose.to_rest(mi.Ray3f(moved, mi.Vector3f(0, 0, 1)))
        np.testing.assert_allclose(np.array(ray.o).T, np.tile(p, (len(times), 1)), atol=5e-6)


@pytest.mark.parametrize("name", MOTIONS)
def test_bounds_hold_all_poses_tightly(name: str) -> None:
    motion = MOTIONS[name]
    corners = np.random.default_rng(3).normal(size=(8, 3))
    low, high = motion.bounds(corners)
    moved = np.concatenate([motion.move(corners, time) for time in np.linspace(-2, 3, 3001)])
    assert (moved >= low - 1e-9).all() and (moved <= high + 1e-9).all()
    assert np.abs(np.concatenate([moved.min(0) - low, high - moved.max(0)])).max() < 0.01
