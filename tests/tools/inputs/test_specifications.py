"""Integrators made from specifications, and the depth that they inherit from a scene."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mitsuba_ext.compare import InputError, load_scene
from mitsuba_ext.inputs.plugin_text import parse_plugin
from mitsuba_ext.inputs.specifications import make_named
from mitsuba_ext.inputs.variants import _import_module as import_plugin
from mitsuba_ext.scene.aovs import AOV_TYPES
from mitsuba_ext.util.errors import one_line
from tests.support.command_line import PATH

import mitsuba as mi  # isort: skip


def test_parameters_of_a_plugin_are_read_with_their_types():
    assert parse_plugin("path") == {"type": "path"}
    plugin = parse_plugin("x:a=1,b=0.5,c=true,d=false,e=1e-3,f=mean")
    assert plugin == {
        "type": "x", "a": 1, "b": 0.5, "c": True, "d": False, "e": 1e-3, "f": "mean"
    }
    kinds = [str, int, float, bool, bool, float, str]
    assert [type(value) for value in plugin.values()] == kinds


def test_comma_begins_a_parameter_only_where_a_key_follows():
    plugin = parse_plugin("neepp:aovs=d:depth,a:albedo,spp=4,n=a,b,c=d=e,f")
    values = {"aovs": "d:depth,a:albedo", "spp": 4, "n": "a,b", "c": "d=e,f"}
    assert plugin == {"type": "neepp", **values}


def test_brackets_hold_nested_plugins_to_any_depth():
    text = "a:x=[b:y=[c:aovs=d:depth,n:uv,z=1],w=[e]],v=f[2],u=3"
    assert parse_plugin(text) == {
        "type": "a",
        "x": {
            "type": "b", "y": {"type": "c", "aovs": "d:depth,n:uv", "z": 1}, "w": {"type": "e"},
        },
        "v": "f[2]",
        "u": 3,
    }


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "expected NAME"), (":", "expected NAME"), ("path:", "expected NAME"),
        ("a b", "expected NAME"), (" ", "expected NAME"), ("path:a", "expected key=value"),
        ("path:=1", "expected key=value"), ("path:a=", "expected key=value"),
        ("path:a=1,", "expected key=value"), ("x:a=1,,b=2", 'found "a=1,"'),
        ("x:a=1,a=2", '"a" is given twice'), ("x:type=y", '"type" is given twice'),
        ("x:n=[y", "without"), ("x:n=y]", "without"), ("x:n=]y[", "without"),
        ("x:n=[]", "expected NAME"), ("x:n=[y:a]", 'found "a"'),
        ("x:n=[y],z", 'after "]"'), ("x:n=[y][z]", 'after "]"'),
    ],
)
def test_malformed_specification_is_refused(text, words):
    with pytest.raises(InputError) as error:
        parse_plugin(text)
    assert f'integrator "{text}": ' in str(error.value) and words in str(error.value)


def test_nested_integrators_take_over_the_settings_and_are_checked(variant):
    named = make_named("variance:nested=[neepp:rr_depth=9,aovs=d:depth,a:albedo],batches=4", DEPTH)
    assert named.name == "variance"
    assert named.parameters == {
        "batches": 4,
        "nested": {"type": "neepp", "max_depth": 3, "rr_depth": 9, "aovs": "d:depth,a:albedo"},
    }
    assert "max_depth = 3" in str(named.integrator) and "rr_depth = 9" in str(named.integrator)
    settings = {**DEPTH, "hide_emitters": True}
    lens = make_named("reweighted_lens:in=[composed_path]", settings)
    assert lens.parameters["in"] == {"type": "composed_path", **settings}
    for text in ("aov:aovs=d:depth,n:uv,image=[path]", "variance:a=[moment:b=[volpathmis]]"):
        assert "max_depth = 3" in str(make_named(text, DEPTH).integrator)
    decision = make_named("composed_path:directions=[guided_directions:bounces=3]", DEPTH)
    nested = {"type": "guided_directions", "bounces": 3}
    assert decision.parameters == {**DEPTH, "directions": nested}
    assert "bounces = 3" in str(decision.integrator)
    for text, message in (
        ("variance:nested=[none]", 'unknown nested plugin "none"'),
        ("variance:nested=[path:x=1]", 'nested plugin "path" has no parameter "x"'),
        ("variance:nested=[path:max_depth=a,b]", 'nested plugin "path": The property "max_depth"'),
        ("path:nested=[path]", 'integrator "path" has no parameter "nested"'),
        ("variance:nested=[independent]", "exactly one integrator must be nested in it"),
        ("variance:nested=path", "found none (nested plugins are in brackets: nested=[path])"),
        ("independent", "not an integrator"),
        ("composed_path:directions=[guided_direction]", 'did you mean "guided_directions"?'),
        ("composed_path:direction=guided", 'no parameter "direction": did you mean "directions"?'),
        ("composed_path:directions=[guided_directions:bonces=3]", 'did you mean "bounces"?'),
        (
            "composed_path:next_event=[guided_directions]",
            'integrator "composed_path": the parameter "next_event" cannot be "guided_directions", '
            "which is for directions",
        ),
        (
            "composed_path:next_event=learned_lights",
            "'learned_lights'; it must be one of uniform, power, spatial, linear, tree, "
            "visibility, contribution, resampled, two_stage, triple_product, portals, or a nested "
            "plugin: "
            '"spatial_lights" or "learned_lights" or "resampled_lights" or "two_stage_lights" or '
            '"portal_lights": nest the plugin (on the command line: next_event=[learned_lights])',
        ),
        ("composed_path:connections=-3", 'the parameter "connections" is -3; it must be at least'),
        ("composed_path:time=latice", "one of sampler, swarm, independent, stratified,"),
        ("composed_path:next_event=[independent]", "is IndependentSampler; it must be one of"),
        ("composed_path:pilot_spp=4", 'nothing here uses the parameter "pilot_spp"'),
        ("pss_guided:nee_first_bounce=false,count=3", 'has no parameter "count"'),
        ("composed_path:wavelength=lattice", 'does not work in the variant "llvm_ad_rgb"'),
    ):
        with pytest.raises(InputError) as error:
            make_named(text, DEPTH)
        assert message in str(error.value) and "\n" not in str(error.value)


def test_values_of_none_which_end_mitsuba_are_refused(variant, tmp_path):
    file = tmp_path / "path.json"
    file.write_text('{"type": "path", "max_depth": null}')
    scene = {"type": "scene", "sensor": {"type": "perspective", "fov": None}}
    for what, key in ((file, "max_depth"), ({"type": "path", "rr_depth": None}, "rr_depth")):
        with pytest.raises(InputError, match=f'"{key}" has no value .None, null.: leave it out'):
            make_named(what)
    with pytest.raises(InputError, match='"fov" has no value'):
        load_scene(scene)


@pytest.mark.parametrize("plugin", ["aov", "composed_path"])
def test_output_variables_are_checked_before_mitsuba_sees_them(variant, tmp_path, plugin):
    for aovs in ("depth", "d:", ":depth", "d:depht", "a:b:depth", "d:depth,x", "a : depth"):
        with pytest.raises(InputError) as error:
            make_named({"type": plugin, "aovs": aovs})
        assert f'"{plugin}": the parameter "aovs" must be a list of name:type' in str(error.value)
        assert "sh_normal, dp_du" in str(error.value)
    with pytest.raises(InputError, match='and not "depth"'):
        make_named(f"{plugin}:aovs=depth")
    with pytest.raises(InputError, match='and not "depth"'):
        load_scene({**SPHERE_SCENE, "integrator": {"type": plugin, "aovs": "depth"}})
    every = ",".join(f"a{index}:{kind}" for index, kind in enumerate(AOV_TYPES))
    assert len(make_named(f"{plugin}:aovs={every}").integrator.aov_names()) == 27


def test_depth_is_inherited_where_the_integrator_knows_it(make_scene):
    mi.set_variant("llvm_ad_rgb")
    loaded = load_scene(make_scene())
    assert loaded.settings == {"max_depth": 3, "rr_depth": 5}
    assert make_named("prb:max_depth=7", loaded.settings).parameters["max_depth"] == 7
    assert make_named("direct", loaded.settings).parameters == {}
    unlimited = load_scene(make_scene("b.xml", integrator='<integrator type="path"/>'))
    assert unlimited.settings["max_depth"] == -1
    nested = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH}</integrator>'
    assert load_scene(make_scene("c.xml", integrator=nested)).settings["max_depth"] == 3


DEPTH = {"max_depth": 3, "rr_depth": 7}

DECISIONS = """<integrator type="composed_path">
  <sampler name="next_event" type="{}"><integer name="grid" value="8"/></sampler>
</integrator>"""

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


def test_fragments_can_nest_decisions(variant, tmp_path):
    file = tmp_path / "composed.xml"
    file.write_text(DECISIONS.format("learned_lights"))
    named = make_named(str(file), DEPTH)
    assert "max_depth = 3" in str(named.integrator)
    assert "learned_lights[target = contribution, grid = 8" in str(named.integrator)
    assert make_named(str(file), DEPTH).identity == named.identity
    file.write_text(DECISIONS.format("learned_light"))
    with pytest.raises(InputError, match='Plugin "learned_light" not found'):
        make_named(str(file))


def test_dicts_and_integrators_are_accepted(variant):
    named = make_named({"type": "neepp", "grid": 8, "max_depth": 4}, DEPTH)
    assert named.label == "neepp:grid=8,max_depth=4"
    nested = {"type": "composed_path", "next_event": {"type": "learned_lights", "grid": 8}}
    assert make_named(nested).label == "composed_path:next_event=[learned_lights:grid=8]"
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


USERS = """
import mitsuba as mi

class Silent(mi.SamplingIntegrator):  # to_string() is optional
    def __init__(self, props):
        super().__init__(props)
        self.grid = props.get("grid", 1)

class Talking(Silent):
    def to_string(self):
        return f"Talking[{object()}]"

mi.register_integrator("silent", lambda props: Silent(props))
mi.register_integrator("talking", lambda props: Talking(props))
"""


def test_name_parameters_and_code_identify_integrators_without_to_string(variant, tmp_path):
    file = tmp_path / "users_plugin.py"
    file.write_text(USERS)
    import_plugin(str(file))
    (tmp_path / "wrapped.json").write_text(
        json.dumps({"type": "variance", "nested": {"type": "silent", "grid": 3}})
    )
    forms = [
        "silent", "silent:grid=2", "talking", "variance:nested=[silent]",
        "variance:nested=[silent:grid=2]",
        "aov:aovs=d:depth,image=[silent]", {"type": "variance", "nested": {"type": "silent"}},
        str(tmp_path / "wrapped.json"),
    ]
    first = [make_named(form, DEPTH).identity for form in forms]
    assert len(set(first)) == len(forms)
    assert [make_named(form, DEPTH).identity for form in forms] == first
    file.write_text(USERS + "\n# changed\n")
    changed = [make_named(form, DEPTH).identity for form in forms]
    assert not set(changed) & set(first)
    assert make_named("aov:aovs=d:depth,image=[path]").identity.count('""') == 1  # no Python in it


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


def test_only_the_message_of_a_traceback_that_mitsuba_quotes_is_shown(variant, scenes):
    with pytest.raises(InputError) as error:
        load_scene(scenes / "prism.xml")
    message = str(error.value)
    assert message.startswith(f"At {scenes / 'prism.xml'} (line ") and "\n" not in message
    assert '"dispersive_dielectric" cannot disperse light in the variant "llvm_ad_rgb"' in message
    assert "Traceback" not in message and "File" not in message and "RuntimeError" not in message
    traceback = 'Traceback (most recent call last):\n  File "a.py", line 1, in f\n    g()\n    ^\n'
    for text, line in (
        (f"[x.cpp:1] failed: {traceback}ValueError: no\n  light: here", "failed: no light: here"),
        (f"{traceback}KeyError: 1\n\nDuring it:\n\n{traceback}a.B: two", "two"),
        (f"failed: {traceback}AssertionError", "failed: AssertionError"),
        ("one\n  - two", "one two"),
    ):
        assert one_line(RuntimeError(text)) == line


def test_scenes_of_another_variant_and_objects_that_are_no_scenes_are_refused(variant):
    mi.set_variant("scalar_rgb")
    scene = mi.load_dict({**SPHERE_SCENE, "integrator": {"type": "path"}})
    sphere, path = mi.load_dict({"type": "sphere"}), mi.load_dict({"type": "path"})
    mi.set_variant(variant)
    for source in ({**SPHERE_SCENE, "shape": sphere}, {"type": "scene", "in": {"x": sphere}}):
        with pytest.raises(InputError, match='"Sphere" was made in the variant "scalar_rgb"'):
            load_scene(source)
    for source in (scene, 3):
        with pytest.raises(InputError, match="a scene must be an XML file or a dict, found an obj"):
            load_scene(source)
    for specification in (path, {"type": "variance", "nested": path}):
        with pytest.raises(InputError, match='was made in the variant "scalar_rgb"'):
            make_named(specification)
    with pytest.raises(InputError, match="an integrator must be named by text"):
        make_named(3)
