"""Errors for misspelt names suggest the intended name, wherever a user writes them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import pytest

from mitsuba_ext.inputs.names import MITSUBA_INTEGRATORS
from mitsuba_ext.util.errors import one_line

pytestmark = pytest.mark.usefixtures("variant")

_SCENE = """<scene version="3.0.0">
    <default name="res" value="4"/>
    <integrator type="{integrator}">{inside}</integrator>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="$res"/><integer name="height" value="$res"/>
        </film>
        <sampler type="{sampler}"/>
    </sensor>
</scene>
"""


def _complaint(run, tmp_path: Path, *arguments: str, **parts: str) -> str:
    """The line that ends a render of a scene with ``parts``."""
    parts = {"integrator": "path", "inside": "", "sampler": "independent", **parts}
    scene = tmp_path / "scene.xml"
    scene.write_text(_SCENE.format(**parts))
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", *arguments)
    assert code == 2 and err.count("\n") == 1, err
    return err


@pytest.mark.parametrize(("parts", "meant"), [
    ({"integrator": "bdtp"}, "bdpt"),
    ({"integrator": "volpth"}, "volpath"),
    ({"sampler": "sobol_oven"}, "sobol_owen"),
    ({"sampler": "multijiter"}, "multijitter"),
    ({"integrator": "neepp", "inside": '<integer name="max_dpth" value="3"/>'}, "max_depth"),
    ({"integrator": "path", "inside": '<integer name="max_dpth" value="3"/>'}, "max_depth"),
    ({"integrator": "vcm", "inside": '<string name="next_event" value="visibilty"/>'},
     "visibility"),
])  # fmt: skip
def test_in_scene_files(run, tmp_path: Path, parts: dict[str, str], meant: str) -> None:
    assert f'did you mean "{meant}"?' in _complaint(run, tmp_path, **parts)


@pytest.mark.parametrize(("text", "meant"), [
    ("path:max_dept=8", "max_depth"),
    ("direct:emitter_sample=2", "emitter_samples"),
    ("variance:nested=[path:max_dept=8]", "max_depth"),
    ("variance:nested=[neepp:gird=8]", "grid"),
    ("composed_path:next_event=visibilty", "visibility"),
    ("composed_path:directions=guidd", "guided"),
    ("composed_path:roulette=automatc", "automatic"),
    ("composed_path:mis=balanced", "balance"),
    ("composed_path:time=sobl", "sobol"),
    ("composed_path:mis=[mis_heuristic:heuristic=ballance]", "balance"),
])  # fmt: skip
def test_in_integrators_on_the_command_line(run, tmp_path: Path, text: str, meant: str) -> None:
    assert f'did you mean "{meant}"?' in _complaint(run, tmp_path, "--integrator", text)


def test_in_parameters_of_the_scene_file(run, tmp_path: Path) -> None:
    assert 'no parameter $ress: did you mean "res"?' in _complaint(
        run, tmp_path, "-D", "res=8", "-D", "ress=8"
    )
    assert "no parameter $spp (it has $res)" in _complaint(run, tmp_path, "-D", "spp=8")


@pytest.mark.parametrize(("plugin", "key", "meant"), [
    ("neepp", "max_dpth", "max_depth"),
    ("sobol_owen", "sample_counts", "sample_count"),
    ("guided_directions", "bounce", "bounces"),
])  # fmt: skip
def test_in_dicts_for_mitsuba(plugin: str, key: str, meant: str) -> None:
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": plugin, key: 4})
    assert one_line(caught.value).endswith(f'"{plugin}" has no parameter "{key}": '
                                           f'did you mean "{meant}"?')  # fmt: skip


def test_errors_in_traced_code_keep_their_sentence() -> None:
    with pytest.raises(RuntimeError) as caught:
        try:
            raise ValueError("the light needs a shape")
        except ValueError as error:
            raise RuntimeError("dr.while_loop(): encountered an exception (see above).") from error
    assert one_line(caught.value) == "the light needs a shape"


def test_the_error_for_a_nested_decision_without_a_name_names_its_slot(run, tmp_path: Path) -> None:
    err = _complaint(
        run, tmp_path, integrator="composed_path", inside='<sampler type="mis_heuristic"/>'
    )
    assert '"mis_heuristic" needs the name of what it decides: name="mis"' in err


def test_inherited_settings_that_a_plugin_does_not_have_are_left_out(run, tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    inside = '<integer name="max_depth" value="3"/><integer name="rr_depth" value="2"/>'
    scene.write_text(_SCENE.format(integrator="path", inside=inside, sampler="independent"))
    text = "composed_path:mis=[mis_heuristic:heuristic=balance]"
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", "--integrator", text)
    assert code == 0, err


@pytest.mark.parametrize("name", sorted({*MITSUBA_INTEGRATORS} - {"stokes"}))  # it is polarized
def test_the_table_of_parameters_of_mitsuba(name: str) -> None:
    values = {"aovs": "d:depth", "guiding": "octree", "project_seed": "both", "timeout": -1.0}
    switches = {"hide_emitters", "use_spectral_mis", "srgb_primitives", "guiding_proj"}
    for key in MITSUBA_INTEGRATORS[name]:
        properties = mi.Properties(name)
        if name == "aov":
            properties["aovs"] = "d:depth"
        properties[key] = key in switches or values.get(key, 4)
        made = mi.PluginManager.instance().create_object(properties)
        made.expand()
        assert key not in properties.unqueried()
