"""Integrators as they are named, and the depth that they take over from a scene."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import PATH

from mitsuba_ext.compare import InputError, load_scene
from mitsuba_ext.specifications import make_integrator, make_named, parse_integrator

import mitsuba as mi  # isort: skip


def test_integrator_specification():
    assert parse_integrator("path") == ("path", {})
    name, parameters = parse_integrator("x:a=1,b=0.5,c=true,d=false,e=1e-3,f=mean")
    assert name == "x"
    assert parameters == {"a": 1, "b": 0.5, "c": True, "d": False, "e": 1e-3, "f": "mean"}
    assert [type(value) for value in parameters.values()] == [int, float, bool, bool, float, str]


@pytest.mark.parametrize(
    "text", ["", ":", "path:", "path:a", "path:=1", "path:a=", "a b", "x:a=1,a=2"]
)
def test_malformed_specification_is_refused(text):
    with pytest.raises(InputError, match="integrator"):
        parse_integrator(text)


def test_depth_is_inherited_where_the_integrator_knows_it(make_scene):
    mi.set_variant("llvm_ad_rgb")
    loaded = load_scene(make_scene())
    assert loaded.settings == {"max_depth": 3, "rr_depth": 5}
    assert make_integrator("prb", {"max_depth": 7}, loaded.settings)[1]["max_depth"] == 7
    assert make_integrator("direct", {}, loaded.settings)[1] == {}
    unlimited = load_scene(make_scene("b.xml", integrator='<integrator type="path"/>'))
    assert unlimited.settings["max_depth"] == -1
    nested = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH}</integrator>'
    assert load_scene(make_scene("c.xml", integrator=nested)).settings["max_depth"] == 3


DEPTH = {"max_depth": 3, "rr_depth": 7}

AOV = """<integrator type="aov">
  <string name="aovs" value="d:depth"/>
  <integrator type="neepp"><integer name="rr_depth" value="9"/></integrator>
</integrator>"""


def test_fragments_inherit_the_depth_at_every_node_that_knows_it(variant, tmp_path):
    (tmp_path / "aov.xml").write_text(AOV)
    (tmp_path / "aov.json").write_text(
        json.dumps({"type": "aov", "aovs": "d:depth", "in": {"type": "neepp", "rr_depth": 9}})
    )
    for name in ("aov.xml", "aov.json"):
        named = make_named(str(tmp_path / name), DEPTH)
        assert (named.label, named.name) == (str(tmp_path / name), "aov")
        assert "max_depth = 3" in str(named.integrator) and "rr_depth = 9" in str(named.integrator)


def test_dicts_and_integrators_are_accepted(variant):
    named = make_named({"type": "neepp", "grid": 8, "max_depth": 4}, DEPTH)
    assert named.label == "neepp:grid=8,max_depth=4"
    assert named.parameters == {"grid": 8, "max_depth": 4, "rr_depth": 7}
    made = mi.load_dict({"type": "path", "max_depth": 2})
    named = make_named(made, DEPTH, label="mine")
    assert named.label == "mine" and named.integrator is made
    assert make_named(named.integrator).label == "PathIntegrator"


def test_plugins_that_are_made_in_two_steps_are_known_by_name(variant):
    assert "max_depth = 3" in str(make_named("volpathmis", DEPTH).integrator)


def test_hidden_emitters_are_inherited(variant):
    integrator = {"type": "path", "hide_emitters": True, "max_depth": 2}
    loaded = load_scene({**SPHERE_SCENE, "integrator": integrator})
    assert loaded.settings == {"max_depth": 2, "rr_depth": 5, "hide_emitters": True}
    assert make_named("neepp", loaded.settings).integrator.hide_emitters
    assert make_named("direct", loaded.settings).parameters == {"hide_emitters": True}


def test_code_without_a_file_and_live_objects_are_never_the_same_again(variant):
    def identity(specification):
        return make_named(specification, DEPTH).identity

    namespace = {"Base": type(mi.load_dict({"type": "prb"})), "__name__": "notebook"}
    exec("class InNotebook(Base): pass", namespace)
    mi.register_integrator("in_notebook", namespace["InNotebook"])
    live = mi.load_dict({"type": "path"})
    nested = {"type": "aov", "aovs": "d:depth", "image": live}
    for specification in ("in_notebook", live, nested):
        assert identity(specification) != identity(specification)


def test_identity_tells_parameters_and_plugins_apart(variant):
    def identity(specification):
        return make_named(specification, DEPTH).identity

    assert identity("neepp") == identity("neepp")
    different = [identity(name) for name in ("path", "neepp", "composed_path", "neepp:grid=8")]
    assert len(set(different)) == 4


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("a.xml", "<scene/>", "expected an <integrator>, found <scene>"),
        ("a.xml", "<integrator", "unreadable"),
        ("a.xml", '<integrator type="none"/>', 'Plugin "none" not found'),
        ("a.xml", '<integrator type="path"><float name="x" value="1"/></integrator>', "unref"),
        ("a.json", "[]", 'expected an object with a "type"'),
        ("a.json", "{", "unreadable"),
        ("a.json", '{"type": "diffuse"}', "not an integrator"),
        ("b.json", None, "no such file"),
    ],
)
def test_broken_fragment_is_one_line_that_names_the_file(variant, tmp_path, name, text, message):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as error:
        make_named(str(path))
    assert message in str(error.value) and name in str(error.value)
    assert "\n" not in str(error.value)


SPHERE_SCENE = {
    "type": "scene",
    "integrator": {"type": "neepp", "max_depth": 4},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 6}},
    "emitter": {"type": "constant"},
    "shape": {"type": "sphere"},
}


def test_scene_from_a_dict(variant):
    loaded = load_scene(SPHERE_SCENE, keep_integrator=False)
    assert (loaded.path, loaded.size, loaded.settings["max_depth"]) == (None, (8, 6), 4)
    assert not isinstance(loaded.scene.integrator(), type(make_named("neepp").integrator))
    with pytest.raises(InputError, match="no \\$parameters"):
        load_scene(SPHERE_SCENE, parameters={"x": 1})


def test_scene_from_a_dict_with_an_integrator_object(variant):
    scene = {**SPHERE_SCENE, "integrator": mi.load_dict({"type": "path"})}
    assert load_scene(scene, keep_integrator=False).scene is not None


def test_hash_of_a_dict_follows_its_content(variant):
    def hash_of(**changes):
        return load_scene({**SPHERE_SCENE, **changes}).content_hash

    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 30)
    texture, other = (
        mi.load_dict({"type": "bitmap", "data": mi.TensorXf([grey] * 12, (2, 2, 3)), "raw": True})
        for grey in (0.5, 0.6)
    )
    bitmaps = [mi.Bitmap(np.full((2, 2, 3), grey, np.float32)) for grey in (0.5, 0.6)]
    bsdfs = [{"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
             for bitmap in bitmaps]
    assert hash_of(shape={"type": "sphere", "bsdf": bsdfs[0]}) != hash_of(
        shape={"type": "sphere", "bsdf": bsdfs[1]}
    )
    hashes = {
        hash_of(),
        hash_of(shape={"type": "sphere", "radius": 2.0}),
        hash_of(shape={"type": "sphere", "to_world": turned}),
        hash_of(shape={"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}),
        hash_of(shape={"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": other}}),
    }
    assert len(hashes) == 5
    assert hash_of() == hash_of()


def test_hash_of_a_file_follows_its_meshes(variant, tmp_path):
    mesh = tmp_path / "mesh.ply"
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><sensor type="perspective"/>'
        '<shape type="ply"><string name="filename" value="mesh.ply"/></shape></scene>'
    )
    hashes = set()
    for scale in (1.0, 2.0):
        flat = mi.Mesh("mesh", 3, 1)
        parameters = mi.traverse(flat)
        parameters["vertex_positions"] = [0, 0, 0, scale, 0, 0, 0, 1, 0]
        parameters["faces"] = [0, 1, 2]
        parameters.update()
        flat.write_ply(str(mesh))
        hashes.add(load_scene(scene).content_hash)
    assert len(hashes) == 2
