"""The parameters of ``moving`` shapes: their meaning, and their errors."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare.timing import timed_render
from mitsuba_ext.scene.movers import refuse_movers
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.stage import area, diffuse, film, sensor

pytestmark = pytest.mark.usefixtures("variant")

Scene = dict[str, Any]


def test_scene_is_as_large_as_the_motion() -> None:
    shape = {"type": "moving", "translate": [0, 5, 0], "cube": {"type": "cube"}}
    box = mi.load_dict({"type": "scene", "moving": shape}).bbox()
    np.testing.assert_allclose([list(box.min), list(box.max)], [[-1] * 3, [1, 6, 1]], atol=1e-5)


# ---- Scenes as files, and errors ----


def test_motion_is_refused_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    shape = {"type": "moving", "translate": [0, 5, 0], "cube": {"type": "cube"}}
    scene = mi.load_dict({"type": "scene", "moving": shape})
    monkeypatch.setattr(mi, "variant", lambda: "cuda_ad_rgb")
    with pytest.raises(NotImplementedError, match="llvm_"):
        scene_query(scene)


XML = """<scene version="3.0.0">
    <bsdf type="diffuse" id="paint"/>
    <shape type="shapegroup" id="group"><shape type="sphere"/></shape>
    <shape type="moving" id="a">
        <vector name="axis" value="0, 0, 2"/><float name="angle" value="90"/>
        <point name="center" value="1, 2, 3"/><vector name="translate" value="0, 0, 1"/>
        <shape type="cube"><ref id="paint"/></shape>
        <shape type="cube"><ref id="paint"/></shape>
        <ref id="group"/><shape type="instance"><ref id="group"/></shape>
    </shape>
    <shape type="moving" id="b">
        <transform name="pose_0"><rotate z="1" angle="20"/></transform>
        <float name="time_0" value="0.5"/>
        <transform name="pose_1"><translate x="1"/></transform><float name="time_1" value="2"/>
        <shape type="cube"><ref id="paint"/></shape>
    </shape>
    <shape type="cube"><ref id="paint"/></shape>
</scene>"""


def test_files_and_dictionaries_say_the_same(tmp_path) -> None:
    """With all of Mitsuba's optimisations: nothing that moves is merged with anything."""
    T = mi.ScalarTransform4f
    file = tmp_path / "scene.xml"
    file.write_text(XML)
    scene = mi.load_file(str(file))
    assert len(scene.shapes()) == 3
    shapes = {shape.id(): shape for shape in scene.shapes()}
    assert len(shapes["a"].at_rest.shapes()) == 3 and len(shapes["b"].at_rest.shapes()) == 1
    cube = {"type": "cube"}
    dictionaries = {
        "a": {"axis": [0, 0, 2], "angle": 90, "center": [1, 2, 3], "translate": [0, 0, 1]},
        "b": {"pose_0": T().rotate([0, 0, 1], 20), "time_0": 0.5,
              "pose_1": T().translate([1, 0, 0]), "time_1": 2.0},
    }  # fmt: skip
    for name, parameters in dictionaries.items():
        motion = mi.load_dict({"type": "moving", **parameters, "cube": cube}).motion
        for key, value in vars(motion).items():
            np.testing.assert_allclose(getattr(shapes[name].motion, key), value, atol=1e-7)
    assert "segments = 1" in str(shapes["b"])


def _errors() -> dict[str, tuple[Scene, str]]:
    T = mi.ScalarTransform4f
    cube = {"type": "cube"}
    line = {"translate": [1, 0, 0]}
    poses = {"pose_0": T(), "time_0": 0.0, "pose_1": T(), "time_1": 1.0, "cube": cube}
    return {
        "typo": ({**line, "cube": cube, "angel": 3.0}, "angel"),
        "to_world": ({**line, "cube": cube, "to_world": T()}, "to_world"),
        "no_motion": ({"cube": cube}, "no motion is given"),
        "no_angle": ({"axis": [0, 0, 1], "cube": cube}, '"angle"'),
        "no_axis": ({**line, "angle": 3.0, "cube": cube}, "angle"),
        "zero_axis": ({"axis": [0, 0, 0], "angle": 1.0, "cube": cube}, "must not be zero"),
        "backwards": ({**line, "begin": 2.0, "cube": cube}, '"begin" is 2'),
        "not_a_number": ({"translate": [float("nan"), 0, 0], "cube": cube}, "finite"),
        "mixed": ({**line, **poses}, "cannot be combined"),
        "gap": ({**poses, "pose_3": T(), "time_3": 4.0}, "pose_3"),
        "one_pose": ({"pose_0": T(), "time_0": 0.0, "cube": cube}, "two at least"),
        "order": ({**poses, "time_1": 0.0}, '"time_1" is 0'),
        "scale": ({**poses, "pose_1": T().scale(2)}, "must be rigid"),
        "mirror": ({**poses, "pose_1": T().scale([-1, 1, 1])}, "must be rigid"),
        "nothing": (line, "nothing is nested"),
        "material": ({**line, "cube": cube, "paint": {"type": "diffuse"}}, "must be a shape"),
        "lights": ({**line, "a": {**cube, "light": area(1.0)}, "b": {**cube, "light": area(1.0)}},
                   "2 of the nested shapes are lights"),
        "sensor": ({**line, "meter": {"type": "rectangle", "sensor": {"type": "irradiancemeter"}}},
                   "sensors of shapes cannot move"),
        "nested": ({**line, "inner": {"type": "moving", **line, "cube": cube}}, "another one"),
        "attribute": ({**line, "mesh": _coloured_mesh()}, '"vertex_color"'),
    }  # fmt: skip


def _coloured_mesh() -> mi.Mesh:
    mesh = mi.Mesh("mesh", 3, 1)
    mesh.add_attribute("vertex_color", 3, [0.0] * 9)
    return mesh


@pytest.mark.parametrize("case", [
    "typo", "to_world", "no_motion", "no_angle", "no_axis", "zero_axis", "backwards",
    "not_a_number", "mixed", "gap", "one_pose", "order", "scale", "mirror", "nothing", "material",
    "lights", "sensor", "nested", "attribute",
])  # fmt: skip
def test_objects_that_cannot_move_are_refused(case: str) -> None:
    parameters, message = _errors()[case]
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": "moving", **parameters})


def test_shape_cannot_be_in_two_places() -> None:
    cube = mi.load_dict({"type": "cube"})
    moving = {"type": "moving", "translate": [1, 0, 0], "cube": cube}
    for other in (cube, moving):
        scene = mi.load_dict({"type": "scene", "moving": moving, "other": other}, optimize=False)
        with pytest.raises(ValueError, match="elsewhere in the scene"):
            scene_query(scene)


def test_instance_needs_its_group() -> None:
    group = mi.load_dict({"type": "shapegroup", "cube": {"type": "cube"}})
    instance = {"type": "instance", "group": group}
    scene = mi.load_dict({
        "type": "scene", "group": group,
        "moving": {"type": "moving", "translate": [1, 0, 0], "instance": instance},
    })  # fmt: skip
    with pytest.raises(ValueError, match="its shapegroup must be nested too"):
        scene_query(scene)


def test_integrators_that_do_not_see_motion_are_refused() -> None:
    moving = {"type": "moving", "translate": [1, 0, 0], "cube": {"type": "cube"}}
    scene = mi.load_dict({"type": "scene", "moving": moving, "sensor": sensor(film=film(4, 4))})
    variance = mi.load_dict({"type": "variance", "nested": {"type": "path"}})
    with pytest.raises(NotImplementedError, match='"PathIntegrator".*: use "composed_path"'):
        variance.render(scene, spp=4)
    with pytest.raises(NotImplementedError, match='"PathIntegrator".*: use "composed_path"'):
        timed_render(mi.load_dict({"type": "path"}), scene, seed=0, spp=1)
    with pytest.raises(NotImplementedError, match='"PRBIntegrator".*: use "composed_path"'):
        timed_render(mi.load_dict({"type": "prb"}), scene, seed=0, spp=1)
    for seeing in ({"type": "composed_path"}, {"type": "variance", "nested": {"type": "neepp"}}):
        timed_render(mi.load_dict(seeing), scene, seed=0, spp=2)
    with pytest.raises(NotImplementedError, match="X does not see .*: do Y"):
        refuse_movers(scene, "X", "do Y")
    refuse_movers(mi.load_dict({"type": "scene"}), "X", "do Y")


def test_the_box_of_moving_shapes_holds_merged_ones():
    T = mi.ScalarTransform4f()
    paint = {"type": "twosided", "id": "paint", "bsdf": diffuse()}
    ref = {"type": "ref", "id": "paint"}
    parts = {"low": {"type": "cube", "to_world": T.translate([0, 0, -0.6]).scale(0.1), "bsdf": ref},
             "high": {"type": "rectangle", "to_world": T.translate([0, 0, 0.6]), "bsdf": ref}}
    moving = {"type": "moving", "translate": [1, 0, 0]}
    apart, merged = (
        mi.load_dict({"type": "scene", "paint": paint, "m": {**moving, **things}}).bbox()
        for things in (parts, {"merged": {"type": "merge", **parts}})
    )
    np.testing.assert_allclose([list(merged.min), list(merged.max)],
                               [list(apart.min), list(apart.max)], atol=1e-5)  # fmt: skip


def test_a_group_without_an_instance_does_not_move():
    group = {"type": "shapegroup", "id": "g", "a": {"type": "sphere", "center": [0, 0, 50]}}
    moving = {"type": "moving", "translate": [1, 0, 0], "group": group}
    with pytest.raises(Exception, match="nothing is nested"):
        mi.load_dict(moving)
    there = mi.ScalarTransform4f().translate([0, 0, -50])
    one = {"type": "instance", "group": {"type": "ref", "id": "g"}, "to_world": there}
    box = mi.load_dict({"type": "scene", "m": {**moving, "one": one}}).bbox()
    np.testing.assert_allclose(list(box.max), [2, 1, 1], atol=1e-5)
