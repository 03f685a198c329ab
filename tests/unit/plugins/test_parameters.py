"""Parameters that would have no effect, or are out of range, are refused when a scene is loaded."""

from __future__ import annotations

import math

import mitsuba as mi
import pytest

pytestmark = pytest.mark.usefixtures("variant")

_REJECTED = "shadow rays that are rejected"


@pytest.mark.parametrize(
    ("parameters", "key", "needs"),
    [
        ({"law": "paper"}, "law", _REJECTED),
        ({"slope": 3.0}, "slope", _REJECTED),
        ({"floor": 0.5}, "floor", _REJECTED),
        ({"rejection": True, "law": "paper", "slope": 3.0}, "slope", "by the affine law"),
        ({"rejection": True, "law": "paper", "floor": 0.5}, "floor", "by the affine law"),
        ({"rejection": True, "refine": 3}, "refine", "lights not learned"),
        ({"light_sampling": "uniform", "grid": 3}, "grid", _REJECTED),
        ({"light_sampling": "linear", "max_memory": 3.0}, "max_memory", _REJECTED),
        ({"light_sampling": "spatial", "pilot_spp": 3}, "pilot_spp", _REJECTED),
    ],
)
def test_parameter_without_effect_is_refused(parameters, key, needs):
    with pytest.raises(RuntimeError, match=f'"neepp": the parameter "{key}" needs .*{needs}'):
        mi.load_dict({"type": "neepp", **parameters})


@pytest.mark.parametrize(("key", "other"), [
    ("save_map", "save_learned"), ("load_map", "load_learned"),
])  # fmt: skip
@pytest.mark.parametrize("plugin", ["neepp", "learned_lights"])
def test_a_parameter_of_earlier_versions_says_what_replaces_it(plugin, key, other):
    words = f'"{plugin}" has no parameter "{key}" any more: .*"{other}" of the integrator$'
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": plugin, key: "map.npz"})


def test_only_parameters_with_an_effect_are_shown():
    assert "law" not in str(mi.load_dict({"type": "neepp"}))
    paper = str(mi.load_dict({"type": "neepp", "rejection": True, "law": "paper"}))
    assert "law = paper" in paper and "slope" not in paper and "refine" not in paper
    spatial = {"type": "spatial_lights", "grid": 7}
    composed = {"type": "composed_path", "shadow_test": "visibility_roulette", "aovs": "d:depth"}
    text = str(mi.load_dict({"type": "composed_path", "next_event": spatial, "aovs": "d:depth"}))
    assert "grid = 7" in text and "pilot_spp" not in text and "aovs = d:depth" in text
    assert "refine = 16" in str(mi.load_dict(composed))
    # Beside learned lights, the roulette has no map of its own
    assert "refine" not in str(mi.load_dict({**composed, "next_event": "contribution"}))


@pytest.mark.parametrize(
    ("plugin", "parameters", "message"),
    [
        ("dispersive_roughdielectric", {"alpha": -1.0}, '"alpha" is -1; it must be not negative'),
        ("dispersive_roughdielectric", {"alpha_u": 0.1, "alpha_v": math.inf}, '"alpha_v" is inf'),
        ("dispersive_dielectric", {"specular_reflectance": -0.1}, "must be 0 to 1"),
        ("dispersive_dielectric", {"specular_transmittance": 1.5}, "must be 0 to 1"),
        ("reweighted_direct", {"light_samples": 10**9}, "at most 4096"),
        ("reweighted_direct", {"light_samples": 1025, "pattern": "poisson_disk"}, "at most 1024"),
        ("variance", {"batches": 10**9, "nested": {"type": "path"}}, "at most 65536"),
    ],
)
def test_value_out_of_range_is_refused(plugin, parameters, message):
    constant = {"int_ior": 1.5} if plugin.startswith("dispersive") else {}
    with pytest.raises((RuntimeError, ValueError), match=f'"{plugin}".*{message}'):
        mi.load_dict({"type": plugin, **constant, **parameters})


def test_largest_and_smallest_values_are_accepted():
    mi.load_dict({"type": "dispersive_roughdielectric", "int_ior": 1.5, "alpha": 0.0,
                  "specular_reflectance": 0.0, "specular_transmittance": 1.0})  # fmt: skip
    mi.load_dict({"type": "reweighted_direct", "light_samples": 4096})
