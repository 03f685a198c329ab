"""Slots of ``composed_path``: the decisions that a scene can use, and errors for the others."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.bases.slots import SLOTS as WORDS
from tests.support.stage import film, sensor, stage
from tests.support.statistical import batches, one_thread

pytestmark = pytest.mark.usefixtures("variant")

SLOTS = (
    "directions", "next_event", "connections", "mis", "shadow_test", "aperture", "time",
    "wavelength",
)  # fmt: skip

GUIDED = {"type": "guided_directions", "always_guide": True}


def _refusal(**slots: Any) -> str:
    with pytest.raises((RuntimeError, TypeError, ValueError)) as caught:
        mi.load_dict({"type": "composed_path", **slots})
    return str(caught.value)


# ---- Errors ----


@pytest.mark.parametrize("slot, plugin, belongs", [
    ("directions", "learned_lights", "next_event"),
    ("next_event", "guided_directions", "directions"),
    ("next_event", "visibility_roulette", "shadow_test"),
    ("connections", "weighted_numbers", "aperture, time, wavelength"),
    ("shadow_test", "spatial_lights", "next_event"),
    ("directions", "focal_points", "scattering"),
    ("aperture", "weighted_connections", "connections"),
])  # fmt: skip
def test_an_error_names_the_right_slot_of_a_decision(slot: str, plugin: str, belongs: str) -> None:
    message = _refusal(**{slot: {"type": plugin}})
    assert f'"composed_path": the parameter "{slot}"' in message and belongs in message


def test_any_two_words_go_together_or_are_refused_in_a_sentence() -> None:
    refused = {}
    for (slot, words), (other, others) in itertools.combinations(WORDS.items(), 2):
        for word, another in itertools.product(words, others):
            try:
                mi.load_dict({"type": "composed_path", slot: word, other: another})
            except RuntimeError as error:
                sentence = str(error).strip().splitlines()[-1]
                named = rf'Error: "composed_path": the parameter "({slot}|{other})" .+'
                assert re.search(named, sentence)
                refused[slot, word, other, another] = sentence
    # In a variant without wavelengths, the maps of these do not go with anything
    left = {key: sentence for key, sentence in refused.items() if "wavelength" not in key}
    # Connections through casters know the densities of BSDFs only
    connected = ("automatic", "manifold", "bounded_manifold")
    for word, another in itertools.product(("focal", "swarm"), connected):
        sentence = left.pop(("scattering", word, "caustics", another))
        assert 'leave "scattering" out' in sentence
    learned = ("visibility", "contribution", "triple_product")
    assert set(left) == {("next_event", word, "light_numbers", "swarm") for word in learned}
    assert all('"next_event" is' in sentence for sentence in left.values())


@pytest.mark.parametrize("slot, value", [
    ("directions", "guded"), ("next_event", "all"), ("connections", "many"), ("connections", 2.5),
    ("mis", "best"), ("shadow_test", "never"), ("shadow_test", 1), ("aperture", "uniform"),
    ("time", True),
])  # fmt: skip
def test_the_error_for_an_unknown_word_lists_the_known_words(slot: str, value: Any) -> None:
    message = _refusal(**{slot: value})
    words = {
        "directions": "uniform, guided", "next_event": "power, spatial, linear, tree",
        "connections": "one", "mis": "balance, cutoff", "shadow_test": "visibility_roulette",
        "aperture": "sobol", "time": "sampler",
    }  # fmt: skip
    assert f'"{slot}" is {value!r}' in message and words[slot] in message


@pytest.mark.parametrize("slot", SLOTS)
@pytest.mark.parametrize("kind", ["independent", "diffuse"])
def test_plugins_that_are_no_decisions_are_refused_in_any_slot(slot: str, kind: str) -> None:
    message = _refusal(**{slot: {"type": kind}})
    assert f'"{slot}"' in message and '"composed_path"' in message


def test_parameters_of_nested_decisions_are_checked() -> None:
    message = _refusal(next_event={"type": "learned_lights", "grid": 0})
    assert '"learned_lights": the parameter "grid" is 0; it must be at least 1' in message
    message = _refusal(next_event={"type": "learned_lights", "gird": 3})
    assert '"learned_lights" has no parameter "gird": did you mean "grid"?' in message


def test_a_map_of_a_roulette_beside_learned_lights_has_no_effect_and_is_refused() -> None:
    roulette = {"type": "visibility_roulette", "grid": 8}
    message = _refusal(next_event="contribution", shadow_test=roulette)
    assert '"composed_path"' in message and '"grid" of "shadow_test"' in message
    mi.load_dict({"type": "composed_path", "next_event": "power", "shadow_test": roulette})


def test_wavelengths_are_refused_where_there_are_none() -> None:
    assert "llvm_ad_spectral" in _refusal(wavelength={"type": "weighted_numbers"})


def test_weights_that_a_purpose_cannot_have_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(mi, "is_spectral", True)
    message = _refusal(wavelength={"type": "weighted_numbers", "weights": "unbiased"})
    assert '"wavelength" has weights = unbiased' in message and "voronoi" in message


@pytest.mark.parametrize("plugin, slot", [
    ("guided_directions", "directions"), ("learned_lights", "next_event"),
    ("visibility_roulette", "shadow_test"), ("weighted_connections", "connections"),
    ("mis_heuristic", "mis"), ("resampled_lights", "next_event"),
    ("two_stage_lights", "next_event"), ("portal_lights", "next_event"),
    ("weighted_numbers", "aperture"),
])  # fmt: skip
def test_a_decision_is_no_sampler_of_a_sensor(plugin: str, slot: str) -> None:
    camera = {**sensor(), "sampler": {"type": plugin}}
    with pytest.raises(Exception) as caught:
        scene = mi.load_dict(stage(camera=camera))
        mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1)
    message, cause = "", caught.value
    while cause is not None:
        message, cause = message + str(cause), cause.__cause__ or cause.__context__
    assert f'"{plugin}" is not a sampler for sensors' in message and f'"{slot}"' in message


# ---- Scene files ----

_SAMPLERS = """
    <sampler name="directions" type="guided_directions">
        <boolean name="always_guide" value="true"/>
    </sampler>
    <sampler name="next_event" type="learned_lights"><integer name="grid" value="3"/></sampler>
    <sampler name="aperture" type="weighted_numbers">
        <string name="pattern" value="sobol"/>
    </sampler>
    <sampler name="time" type="weighted_numbers"><string name="pattern" value="sobol"/></sampler>
"""

_XML = """
<scene version="3.0.0">
    <integrator type="composed_path"><integer name="max_depth" value="3"/>{samplers}</integrator>
    <sensor type="thinlens">
        <float name="aperture_radius" value="0.05"/> <float name="focus_distance" value="4"/>
        <float name="shutter_close" value="0.5"/> <float name="fov" value="45"/>
        <transform name="to_world">
            <lookat origin="0, -4, 1.2" target="0, 0, 0.6" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"/>
        <film type="hdrfilm">
            <integer name="width" value="12"/> <integer name="height" value="12"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="2"/></transform></shape>
    <emitter type="point"><point name="position" value="0, 0, 2"/></emitter>
    <emitter type="point"><point name="position" value="1, -1, 1"/></emitter>
</scene>
"""


def _file(folder: Path) -> str:
    file = folder / "scene.xml"
    file.write_text(_XML.format(samplers=_SAMPLERS))
    return str(file)


@pytest.mark.parametrize("optimize", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_nested_decisions_are_loaded_from_a_file(tmp_path: Path, optimize: bool) -> None:
    """Two of them are equal: Mitsuba's parser makes one object of both."""
    scene = mi.load_file(_file(tmp_path), optimize=optimize)
    integrator = scene.integrator()
    shown = str(integrator)
    assert re.search(r"directions = .*always_guide = True", shown)
    assert re.search(r"next_event = .*grid = 3", shown)
    assert len(re.findall("pattern = sobol", shown)) == 2
    written_out = mi.load_dict({
        "type": "composed_path", "max_depth": 3, "directions": GUIDED,
        "next_event": {"type": "learned_lights", "grid": 3},
        "aperture": {"type": "weighted_numbers", "pattern": "sobol"},
        "time": {"type": "weighted_numbers", "pattern": "sobol"},
    })  # fmt: skip
    with one_thread():
        images = [batches(scene, each, 16, [3])[0] for each in (integrator, written_out)]
    assert images[0].any()
    np.testing.assert_array_equal(*images)
    assert integrator.learners["directions"].guide is not None


# ---- State ----


def test_renders_of_one_object_share_no_state() -> None:
    """Integrators that nest the same decision share none either."""
    lights = mi.load_dict({"type": "learned_lights", "grid": 3})
    roulette = mi.load_dict({"type": "visibility_roulette"})
    one, other = (
        mi.load_dict({"type": "composed_path", "max_depth": 3, "next_event": lights,
                      "shadow_test": roulette})
        for _ in range(2)
    )  # fmt: skip
    scene = mi.load_dict(stage())
    elsewhere = mi.load_dict(stage(camera=sensor(film=film(9, 7)), lamp={"type": "constant"}))
    with one_thread():
        first = batches(scene, one, 32, [3])[0]
        batches(elsewhere, one, 16, [8])
        learners = dict(other.learners), dict(one.learners)
        second = batches(scene, other, 32, [3])[0]
        again = batches(scene, one, 32, [3])[0]
    assert learners[0] == {} and set(learners[1]) == {"next_event", "shadow_test"}
    np.testing.assert_array_equal(second, first)
    np.testing.assert_array_equal(again, first)
