"""Functions for typed scenes: names, types and defaults come from the pages of the plugins."""

from __future__ import annotations

import ast
import inspect

import mitsuba as mi
import pytest

from mitsuba_ext import scene_description
from mitsuba_ext.scene_description.arguments import arguments, plugin_names
from mitsuba_ext.scene_description.stub import STUB, stub
from mitsuba_ext.startup.plugin_parameters import parameter_names

STUBS = {
    node.name: node
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body
    if isinstance(node, ast.FunctionDef)
}


def test_the_stub_is_made_from_the_pages() -> None:
    assert STUB.read_text(encoding="utf-8") == stub(), "a page has changed: run make stubs"


def test_every_plugin_has_a_function_with_its_parameters() -> None:
    assert sorted(STUBS) == plugin_names() == scene_description.__dir__()
    for name, node in STUBS.items():
        shown = [argument.arg for argument in node.args.kwonlyargs]
        own = [key for key in parameter_names(name) if key.isidentifier()]
        assert set(own) <= set(shown) and shown[-1] == "id"
        function = getattr(scene_description, name)
        known = [key for key in inspect.signature(function).parameters if key != "numbered"]
        assert (function.__name__, known) == (name, shown)
    assert "Number of pilot samples" in scene_description.auto.__doc__


def test_stub_writes_what_an_editor_shows() -> None:
    text = ast.unparse(STUBS["neepp"].args)
    assert "light_sampling: str='contribution'" in text and "max_depth: int=-1" in text
    assert "keep_learned: bool=False" in text and "grid: int=..." in text
    assert "nested: Plugin=..." in ast.unparse(STUBS["adaptive"].args)
    assert "radiance: Spectrum | Texture=1" in ast.unparse(STUBS["goniometric_area"].args)
    assert {"pose_0", "merging", "connections"} <= {
        argument.arg for name in ("moving", "vcm") for argument in STUBS[name].args.kwonlyargs
    }


@pytest.mark.usefixtures("variant")
def test_dicts_can_be_loaded() -> None:
    made = scene_description.neepp(max_depth=8, rejection=True, id="mine")
    assert made == {"type": "neepp", "id": "mine", "max_depth": 8, "rejection": True}
    assert "max_depth = 8" in str(mi.load_dict(made))
    nested = scene_description.adaptive(nested=made, pass_spp=4)
    assert nested == {"type": "adaptive", "pass_spp": 4, "nested": made}
    assert "neepp" in str(mi.load_dict(nested))


#: Parameters that are refused where nothing uses them.
_CONDITIONAL = {"checkpoint_every", "law", "slope", "floor", "refine", "tile"}


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "name", ["auto", "bdpt", "neepp", "pss_guided", "sppm", "swarm_path", "vcm"]
)
def test_the_defaults_shown_are_those_of_the_plugin(name) -> None:
    function, compared = getattr(scene_description, name), 0
    plain = str(mi.load_dict(function()))
    for argument in arguments(name):
        if argument.default == "..." or argument.name in _CONDITIONAL:
            continue
        given = function(**{argument.name: ast.literal_eval(argument.default)})
        assert str(mi.load_dict(given)) == plain, argument.name
        compared += 1
    assert compared >= 7


def test_a_misspelled_parameter_is_named() -> None:
    with pytest.raises(TypeError, match='"auto" has no parameter "max_deph": did you mean "max_de'):
        scene_description.auto(max_deph=8)
    with pytest.raises(TypeError, match='"neepp" has no parameter "pose_0"'):
        scene_description.neepp(pose_0=1)
    with pytest.raises(AttributeError, match="pathh"):
        scene_description.pathh  # noqa: B018


class _Described:
    """As in mitsuba-scene-description."""

    def to_dict(self) -> dict:
        return {"type": "sphere"}


class _Transformed:
    def to_mi(self) -> str:
        return "a transform"


def test_objects_of_mitsuba_scene_description_are_accepted() -> None:
    made = scene_description.moving(
        nested=_Described(), pose_0=_Transformed(), pose_12=_Transformed(), time_12=0.5
    )
    assert made == {
        "type": "moving", "nested": {"type": "sphere"}, "pose_0": "a transform",
        "pose_12": "a transform", "time_12": 0.5,
    }  # fmt: skip
    lit = {"type": "twosided", "inner": _Described()}
    several = scene_description.heightfield(nested=[lit, {"type": "diffuse"}])
    assert several["nested_0"] == {"type": "twosided", "inner": {"type": "sphere"}}
    assert several["nested_1"] == {"type": "diffuse"}


def test_parameters_that_are_none_are_left_out() -> None:
    assert scene_description.auto(max_depth=None) == {"type": "auto"}
