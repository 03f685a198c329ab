"""Lights that move: each path sees them at the pose of its time."""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_ext.planning.technique import Setting
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.motions import Pose, at, camera, keyed, pair, room, sky, uniform
from tests.support.stage import area, bitmap, diffuse, rectangle, rgb
from tests.support.statistical import (
    SEEDS,
    assert_exact,
    assert_same_image,
    assert_same_pixels_on_average,
    batches,
    two_halves,
)
from tests.support.techniques import REFERENCE, TECHNIQUES

Scene = dict[str, Any]

SPIN = uniform([0.5, -0.3, 0.1], [0, 0.4, 1], 200.0, [0.1, 0, 0.8])


@pytest.fixture(autouse=True)
def quiet(variant: str) -> None:
    mi.set_log_level(mi.LogLevel.Error)


def keys() -> tuple[Scene, Pose]:
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0.5, 1.2], [-0.6, 0.5, 2.9]])
    return keyed([0.1, 0.4, 0.9], rotations, [[-0.3, 0, 0], [0.4, 0, 0.2], [0, -0.3, 0.1]])


# ---- Lights ----


def _area(shape: str, pose: np.ndarray) -> Scene:
    """A light on a shape, at the pose."""
    T = mi.ScalarTransform4f
    place = T().translate([-0.3, 0.1, 1.5]).rotate([0.8, 0.6, 0], 150).scale(0.25)
    light: Scene = {"type": shape, "to_world": at(pose, place), "bsdf": diffuse(0.2),
                    "emitter": area(4.0)}  # fmt: skip
    if shape == "disk":
        pixels = np.random.default_rng(3).uniform(0, 6, (4, 4, 3))
        texture = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
        light["emitter"] = {"type": "area", "radiance": texture}
    if shape == "solid_angle":
        light |= {"type": "rectangle", "emitter": {**area(4.0), "type": "solid_angle_area"}}
    return light


def _point(plugin: str, pose: np.ndarray) -> Scene:
    T = mi.ScalarTransform4f
    place = at(pose, T().look_at([-0.6, -0.8, 1.7], [0, 0.2, 0], [0, 0, 1]))
    if plugin == "point":
        position = (place @ mi.ScalarPoint3f(0)).numpy().ravel().tolist()
        return {"type": "point", "position": position, "intensity": rgb(1.0, 2.0, 1.5)}
    if plugin == "spot":
        return {"type": "spot", "to_world": place, "intensity": rgb(3.0), "cutoff_angle": 35.0}
    texture = {"type": "bitmap", "bitmap": bitmap(np.full((2, 2, 3), 0.8)), "raw": True}
    return {"type": "projector", "to_world": place, "irradiance": texture, "scale": 2.0}


AREAS = ("rectangle", "sphere", "disk", "cube", "cylinder", "solid_angle")
POINTS = ("point", "spot", "projector")


def _moving(light: str, parameters: Scene) -> Scene:
    rest = np.eye(4)
    if light in AREAS:
        return {"type": "moving", **parameters, "lamp": _area(light, rest)}
    return {"type": "moving_light", **parameters, "lamp": _point(light, rest)}


def _resting(light: str, pose: np.ndarray) -> Scene:
    return _area(light, pose) if light in AREAS else _point(light, pose)


#: A dim lamp, so that there is a choice among lights.
def _other() -> Scene:
    T = mi.ScalarTransform4f
    up = T().translate([0.7, 0, 1.9]).rotate([1, 0, 0], 180).scale(0.2)
    return rectangle(up, bsdf=diffuse(0.0), emitter=area(2.0))


def _room(shutter: tuple[float, float], light: Scene, **things: Any) -> mi.Scene:
    things = {"lamp": _other(), **pair(np.eye(4)), **things, "moving_lamp": light}
    # The lights are in the order of the dictionary
    return mi.load_dict(room(camera(*shutter), **things), optimize=False)


# ---- At one time ----


#: For these, equal numbers do not choose equal points in turned frames.
BY_SOLID_ANGLE = ("sphere", "solid_angle")


@pytest.mark.parametrize("light", [
    "rectangle", "spot",
    *(pytest.param(name, marks=pytest.mark.slow) for name in (*AREAS, *POINTS)
      if name not in ("rectangle", "spot", *BY_SOLID_ANGLE)),
])  # fmt: skip
def test_closed_shutter_shows_the_light_of_its_time(light: str) -> None:
    """With the numbers of ``path``."""
    parameters, pose = keys()
    moving = _room((0.35, 0.35), _moving(light, parameters))
    resting = _room((0.0, 0.0), _resting(light, pose(0.35)))
    techniques = [TECHNIQUES["composed_path"]]
    if light in POINTS:  # Mitsuba's own need to meet no surface that moves
        techniques.append(REFERENCE)
    wanted = batches(resting, REFERENCE.make(4), 16, [5])[0]
    for technique in techniques:
        assert_same_image(batches(moving, technique.make(4), 16, [5])[0], wanted)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_closed_shutter_in_variant(variant: str) -> None:
    test_closed_shutter_shows_the_light_of_its_time("cube")


@pytest.mark.parametrize("light", [
    "sphere", "disk",
    *(pytest.param(name, marks=pytest.mark.slow) for name in AREAS
      if name not in ("sphere", "disk")),
])  # fmt: skip
def test_densities_agree_with_the_light_at_the_pose(light: str) -> None:
    """The densities of connections, and of rays that hit the light there."""
    parameters, pose = keys()
    moving = mi.load_dict({"type": "scene", "lamp": _moving(light, parameters)})
    emitter = moving.emitters()[0]
    rng = np.random.default_rng(2)
    it = dr.zeros(mi.Interaction3f, 1000)
    it.p = mi.Point3f(0.8 * rng.normal(size=(3, 1000)))
    sample = mi.Point2f(rng.uniform(size=(2, 1000)))
    query = scene_query(moving)
    for time in (0.1, 0.55):
        it.time = mi.Float(time)
        resting = mi.load_dict({"type": "scene", "lamp": _resting(light, pose(time))})
        still = resting.emitters()[0]
        ds, weight = emitter.sample_direction(it, sample)
        seen = np.array(ds.pdf > 0) & (np.array(weight).sum(axis=0) > 0)
        assert seen.mean() > 0.1
        of_still = dr.copy(ds)
        of_still.emitter = mi.EmitterPtr(still)
        # The light at rest, asked about the same direction, and a ray that finds it
        pdf = np.array(ds.pdf)[seen]
        wanted = np.array(still.pdf_direction(it, of_still))[seen]
        np.testing.assert_allclose(pdf, wanted, rtol=1e-2)
        radiance = np.array(still.eval_direction(it, of_still))[:, seen]
        np.testing.assert_allclose(np.array(weight)[:, seen] * pdf, radiance, rtol=2e-2)
        ray = mi.Ray3f(it.p, ds.d)
        ray.time = it.time
        si = query.interaction(query.closest(moving, ray, False, mi.Bool(True)), ray)
        hit = mi.DirectionSample3f(moving, si, it)
        hit.emitter = query.emitter(si, hit.emitter)
        seen &= np.abs(np.array(si.t) - np.array(ds.dist)) < 1e-3
        assert seen.mean() > 0.1
        assert np.array(hit.emitter == mi.EmitterPtr(emitter))[seen].all()
        by_hit = np.array(moving.pdf_emitter_direction(it, hit))[seen]
        assert np.isclose(by_hit, np.array(ds.pdf)[seen], rtol=2e-2).mean() > 0.99


# ---- On average ----


@functools.cache
def reference(light: str) -> np.ndarray:
    """Images of ``path``, averaged over 64 times in the middle of strata."""
    images = [
        batches(_room((0.0, 0.0), _resting(light, SPIN[1]((i + 0.5) / 64)), sky=sky()),
                REFERENCE.make(3), 64, [seed + i for seed in (1001, 2001)])
        for i in range(64)
    ]  # fmt: skip
    return np.mean(images, axis=0)


@pytest.mark.parametrize(
    ("light", "name"),
    [
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("rectangle", "composed_path"),
                *(("rectangle", name) for name in (
                    "neepp", "power", "spatial", "linear", "resampled", "pss_guided",
                    "many_connections", "auto_path", "mis_bsdf",
                )),
                ("sphere", "composed_path"),
                *(("point", name) for name in (
                    "composed_path", "neepp", "power", "spatial", "linear", "resampled",
                )),
                ("point", "path"),
            )
        ),
    ],
)  # fmt: skip
def test_image_is_the_average_of_images_at_rest(light: str, name: str) -> None:
    scene = _room((0.0, 1.0), _moving(light, SPIN[0]), sky=sky())
    technique = REFERENCE if name == "path" else TECHNIQUES[name]
    images = two_halves(scene, technique.make(3), 4096, SEEDS)
    assert_same_pixels_on_average(images, reference(light), precision=0.004, tile=4)


@pytest.mark.parametrize("moves", [True, False])
def test_spatial_choice_knows_where_lights_are_at_the_time_of_the_path(moves: bool) -> None:
    """Two lamps that change places above a floor: the one overhead is chosen."""
    lamps = {
        f"lamp_{x}": {"type": "moving", "translate": [-2.0 * x * moves, 0, 0],
                      "lamp": {"type": "sphere", "center": [x, 0, 0.2], "radius": 0.05,
                               "bsdf": diffuse(0.0), "emitter": area(1.0)}}
        for x in (-1, 1)
    }  # fmt: skip
    floor = rectangle(mi.ScalarTransform4f().scale(2), bsdf=diffuse(0.5))
    view = {"type": "perspective", "shutter_open": 0.0, "shutter_close": 1.0}
    scene = mi.load_dict({"type": "scene", "sensor": view, "floor": floor, **lamps})
    choice = mi.load_dict({"type": "composed_path", "next_event": "spatial"}).slots["next_event"]
    table = choice.decision(Setting(scene, scene.sensors()[0], 0, 3, 5, 16))
    si = dr.zeros(mi.SurfaceInteraction3f, 4)
    si.p = mi.Point3f([-1, 1, -1, 1], 0, 0)
    si.time = mi.Float(0.03, 0.03, 0.97, 0.97)
    row = table.visit(table.begin(None, None), scene, si, mi.Bool(True))
    at_rest = [e.nested if moves else e for e in scene.emitters()]
    left = mi.UInt32(next(i for i, e in enumerate(at_rest) if e.bbox().min.x < 0))
    chosen = table.probability(row, scene, si, left, mi.Bool(True)).numpy()
    overhead = np.array([1, 0, 0, 1] if moves else [1, 0, 1, 0])
    assert np.abs(chosen - overhead).max() < 0.1


@pytest.mark.parametrize("depth", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_furnace_that_moves_around_the_camera(depth: int) -> None:
    """All walls of a closed cube emit 1 and reflect a half, wherever they are."""
    walls = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "emitter": area(1.0)}
    scene = mi.load_dict({
        "type": "scene",
        "sensor": camera(0.0, 1.0, to_world=mi.ScalarTransform4f().rotate([1, 0, 0], 30)),
        "walls": {"type": "moving", "translate": [0.4, 0.2, 0], "axis": [1, 2, 3], "angle": 300.0,
                  "cube": {**walls, "to_world": mi.ScalarTransform4f().scale(3)}},
    })  # fmt: skip
    images = batches(scene, TECHNIQUES["composed_path"].make(depth), 64, range(16))
    assert_exact(images, sum(0.5**k for k in range(depth)))


# ---- What it is, and what it refuses ----


XML = """<scene version="3.0.0">
    <emitter type="moving_light" id="lantern">
        <vector name="translate" value="1, 0, 0"/>
        <emitter type="spot"><float name="sampling_weight" value="3"/></emitter>
    </emitter>
    <shape type="moving" id="lamp">
        <vector name="translate" value="0, 0, 1"/>
        <shape type="sphere">
            <emitter type="area"><rgb name="radiance" value="2"/></emitter>
        </shape>
        <shape type="cube"/>
    </shape>
</scene>"""


@pytest.mark.parametrize("light", POINTS)
def test_bounds_enclose_the_motion(light: str) -> None:
    box = mi.load_dict(_moving(light, {"translate": [1, 0, -1]})).bbox()
    expected = [-0.6, -0.8, 0.7, 0.4, -0.8, 1.7]
    np.testing.assert_allclose([*box.min, *box.max], expected, atol=1e-5)


def test_lights_of_a_file(tmp_path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(XML)
    scene = mi.load_file(str(file))
    flags = sorted(int(emitter.flags()) for emitter in scene.emitters())
    assert flags == sorted(map(int, (mi.EmitterFlags.Surface, mi.EmitterFlags.DeltaPosition)))
    lantern = next(e for e in scene.emitters() if e.id() == "lantern")
    assert lantern.sampling_weight() == 3 and "segments = 1" in str(lantern)
    np.testing.assert_allclose([*lantern.bbox().min, *lantern.bbox().max], [0, 0, 0, 1, 0, 0])
    values = mi.traverse(lantern)
    assert "cutoff_angle" in values
    values["sampling_weight"] = 2.0
    with pytest.raises(NotImplementedError, match="cannot be changed after loading"):
        values.update()


@pytest.mark.parametrize(
    ("nested", "message"),
    [
        ({}, "exactly one emitter .* found none"),
        ({"a": {"type": "point"}, "b": {"type": "point"}}, "exactly one emitter"),
        ({"a": {"type": "constant"}}, "found ConstantBackgroundEmitter"),
        ({"a": {"type": "area"}}, "found AreaLight"),
        ({"a": {"type": "moving_light", "translate": [1, 0, 0], "b": {"type": "point"}}},
         "another one"),
        ({"a": {"type": "point"}, "intensity": 3.0}, "intensity"),
    ],
)  # fmt: skip
def test_objects_that_cannot_move_are_refused(nested: Scene, message: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": "moving_light", "translate": [1, 0, 0], **nested})


@pytest.mark.parametrize("light", ["sphere", "point"])
def test_light_paths_from_moving_lights_are_refused(light: str) -> None:
    scene = _room((0.0, 1.0), _moving(light, SPIN[0]))
    for integrator in (
        {"type": "bdpt"}, {"type": "light_tracer"}, {"type": "mlt"},
        {"type": "pssmlt", "bidirectional": True}, {"type": "erpt", "mutations": "path"},
    ):  # fmt: skip
        with pytest.raises(NotImplementedError, match="cannot start from lights that move"):
            mi.load_dict({"max_depth": 3, **integrator}).render(scene, spp=1)
