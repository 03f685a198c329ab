"""The techniques whose pixels have samples of their own: paths from the camera."""

from __future__ import annotations

from typing import Any

from tests.support.furnaces import FURNACES
from tests.support.hard_cases import HARD_CASES
from tests.support.technique import DEPTHS, EVERY_VARIANT, SCENES, Checks, Technique

EVERYTHING = Checks(SCENES, EVERY_VARIANT, FURNACES, DEPTHS, tuple(HARD_CASES))

#: Furnaces with specular surfaces, unequal walls, or lamps.
_NOT_DIFFUSE = ("furnace_glass", "furnace_isothermal", "furnace_lamps")
_WITH_LIGHTS = ("furnace_isothermal", "furnace_lamps")

#: Cases that have made learners fail: no light, one pixel, lights of all kinds and sizes.
_FEW_FOR_LEARNERS = (
    "plain", "scaled_by_1e4", "no_light", "light_that_nothing_sees", "delta_lights",
    "sun_of_one_texel", "materials", "empty", "film_of_one_pixel", "one_sample", "max_depth_0",
)  # fmt: skip
_LEARNERS = (
    *_FEW_FOR_LEARNERS, "lamp_of_radius_1e-4", "constant_environment", "textured_two_sided_lights",
    "closed_box", "degenerate_light", "instances", "cropped_film", "max_depth_unlimited",
    "hidden_environment",
)  # fmt: skip

#: Cases for the heuristics of multiple importance sampling.
_WEIGHED = ("plain", "delta_lights", "constant_environment", "materials")

_SEVERAL_LIGHTS = ("delta_lights", "textured_two_sided_lights", "materials", "no_light")

# Settings that learn more, or reject more shadow rays: these must be unbiased too. The films of the
# tests are small, and the default pilot learns little from them.
_TRAINED = {"pilot_spp": 32, "grid": 8}
_REJECTING = {**_TRAINED, "rejection": True}
_MAPPED = {**_REJECTING, "light_sampling": "uniform"}
#: Traces the shadow ray of every connection with the same small probability.
_FLOOR = {"slope": 0.0, "floor": 0.1}


def _neepp(scene: str, **parameters: Any) -> Technique:
    return Technique("neepp", parameters, checks=Checks([scene]))


def _slow_neepp(scene: str, **parameters: Any) -> Technique:
    return Technique("neepp", parameters, thorough=Checks([scene]))


CAMERA_TECHNIQUES: dict[str, Technique] = {
    "composed_path": Technique(
        "composed_path", is_plugin=True, draws_like_path=True,
        checks=Checks(SCENES, EVERY_VARIANT, FURNACES, [2, -1], HARD_CASES),
        thorough=EVERYTHING,
    ),
    "neepp": Technique(
        "neepp", is_plugin=True,
        checks=Checks(
            ["rooms"], ["llvm_ad_spectral"], _NOT_DIFFUSE, [-1], _FEW_FOR_LEARNERS
        ),
        thorough=EVERYTHING,
    ),
    # On films of a few pixels, guiding gains little, and by default would be switched off
    "pss_guided": Technique(
        "pss_guided", {"always_guide": True}, is_plugin=True,
        checks=Checks(
            ["cornell_box"], ["llvm_ad_spectral"], _WITH_LIGHTS, [-1], _FEW_FOR_LEARNERS
        ),
        thorough=EVERYTHING,
    ),
    # ``test_swarm.py`` has furnaces, motion and lenses. On small films, maps pay little
    "swarm_path": Technique(
        "swarm_path", {"always_use": True}, is_plugin=True,
        checks=Checks(cases=["thin_lens", "no_light"]),
        thorough=Checks(
            ["cornell_box", "sunny_gloss"], ["llvm_ad_spectral"], FURNACES, [2, -1], _LEARNERS
        ),
    ),
    "swarm_all_maps": Technique(
        "swarm_path", {"always_use": True, "direction_map": True},
        thorough=Checks(
            ["mirrors_and_glass"], furnaces=FURNACES, depths=[-1],
            cases=("materials", "film_of_odd_size", "cropped_film", "three_samples", "thin_lens"),
        ),
    ),
    "auto_path": Technique(
        "auto_path", {"pilot_spp": 32}, is_plugin=True,
        checks=Checks(
            ["rooms"], furnaces=["furnace_glass"], depths=[-1],
            cases=(
                "no_light", "empty", "film_of_one_pixel", "three_samples",
                "light_that_nothing_sees",
            ),
        ),
        thorough=Checks(["door_ajar", "window"], ["llvm_ad_spectral"], cases=_LEARNERS),
    ),
    "auto": Technique(
        "auto", is_plugin=True,
        checks=Checks(cases=("no_light", "three_samples")),
        thorough=Checks(["rooms"], ["llvm_ad_spectral"], ["furnace_glass"], [-1], _LEARNERS),
    ),
    "guided_as_it_pays": Technique(
        "pss_guided", checks=Checks(["cornell_box"]), thorough=Checks(["door_ajar", "rooms"])
    ),
    "tiles": Technique(
        "pss_guided", {"always_guide": True, "regions": "tiles", "tile": 5},
        checks=Checks(
            ["rooms"],
            cases=(
                "no_light", "materials", "empty_before_environment", "film_of_one_pixel",
                "film_of_odd_size", "cropped_film", "three_samples", "max_depth_unlimited",
            ),
        ),
        thorough=Checks(cases=("closed_box", "thousand_samples", "hidden_environment")),
    ),
    "focal_points": Technique(
        "composed_path", {"scattering": {"type": "focal_points", "always_use": True}},
        checks=Checks(cases=["materials"]),
        thorough=Checks(
            ["cornell_box", "rooms"], ["llvm_ad_spectral"], _WITH_LIGHTS, [-1],
            ("no_light", "delta_lights", "medium", "empty", "film_of_one_pixel", "three_samples"),
        ),
    ),
    "many_connections": Technique(
        "reweighted_direct", {"light_samples": 4},
        checks=Checks(
            ["rooms"], furnaces=["furnace_lamps"], depths=[-1],
            cases=(
                *_SEVERAL_LIGHTS, "scaled_by_1e4", "lamp_of_radius_1e-4", "sun_of_one_texel",
                "constant_environment", "empty", "film_of_odd_size", "one_sample", "max_depth_0",
                "thin_lens",
            ),
        ),
        thorough=Checks(
            cases=(
                "plain", "radiance_1e6", "light_that_nothing_sees", "closed_box",
                "degenerate_light", "instances", "medium", "film_of_one_pixel", "cropped_film",
                "max_depth_unlimited", "hidden_emitters",
            )
        ),
    ),
    # All decisions at once: ``test_combinations.py`` has pairs of them
    "composed": Technique(
        "composed_path",
        {
            "directions": {"type": "guided_directions", "always_guide": True},
            "next_event": {"type": "learned_lights", "grid": 8},
            "connections": {"type": "weighted_connections", "count": 4, "vertices": "all"},
            "shadow_test": {"type": "visibility_roulette", "slope": 2.0, "floor": 0.3},
            "pilot_spp": 32,
        },
        checks=Checks(cases=["no_light", "empty"]),
        thorough=Checks(
            ["mirrors_and_glass"], ["llvm_ad_spectral"], ["furnace_glass"], [-1], _LEARNERS,
        ),
    ),
    # Lights chosen by power, by distance, by a loop over all of them, by a tree: nothing is learned
    "power": Technique("composed_path", {"next_event": "power"}, checks=Checks(["rooms"])),
    "spatial": Technique(
        "composed_path", {"next_event": "spatial"}, checks=Checks(["rooms"], cases=_SEVERAL_LIGHTS)
    ),
    "linear": Technique(
        "composed_path", {"next_event": "linear"},
        checks=Checks(["rooms"], cases=_SEVERAL_LIGHTS),
        thorough=Checks(cases=["thousand_lights"]),
    ),
    "tree": Technique(
        "composed_path", {"next_event": "tree"},
        checks=Checks(["rooms"], cases=_SEVERAL_LIGHTS),
        thorough=Checks(
            ["mirrors_and_glass"], ["llvm_ad_spectral"], ["furnace_lamps"], [-1],
            ("thousand_lights", "smooth_normal_lamp", "degenerate_light", "sun_of_one_texel"),
        ),
    ),
    "resampled": Technique(
        "composed_path", {"next_event": "resampled"},
        checks=Checks(
            ["rooms"],
            cases=(*_SEVERAL_LIGHTS, "sun_of_one_texel", "constant_environment", "empty"),
        ),
        thorough=Checks(
            ["sunny_gloss"], ["llvm_ad_spectral"], ["furnace_convex", "furnace_lamps"], [3],
            ("plain", "radiance_1e6", "lamp_of_radius_1e-4", "smooth_normal_lamp",
             "degenerate_light", "hidden_environment"),
        ),
    ),
    # One connection, which draws fewer samples of each partition but more partitions
    "two_stage": Technique(
        "two_stage", {"light_samples": 1}, is_plugin=True,
        checks=Checks(
            ["window"], furnaces=["furnace_convex"], depths=[2, -1],
            cases=(
                "sun_of_one_texel", "constant_environment", "materials", "no_light", "empty",
                "empty_before_environment", "hidden_environment", "film_of_one_pixel",
            ),
        ),
        thorough=Checks(
            ["cornell_box"], ["llvm_ad_spectral"], ["furnace_convex"], [3],
            ("plain", "delta_lights", "textured_two_sided_lights", "smooth_normal_lamp"),
        ),
    ),
    "two_stage_connections": Technique(
        "two_stage", {"light_samples": 4, "vertices": "all", "splits": 4},
        checks=Checks(cases=["sun_of_one_texel"]),
        thorough=Checks(
            ["sunny_gloss", "window"], ["llvm_ad_spectral"], ["furnace_convex"], [-1],
            ("materials", "constant_environment"),
        ),
    ),
    # ``test_visibility_maps.py`` has densities and boxes
    "triple_product": Technique(
        "composed_path", {"next_event": "triple_product", "connections": 4},
        checks=Checks(cases=["no_light"]),
        thorough=Checks(
            [], ["llvm_ad_spectral"], ["furnace_convex"], [-1],
            ("sun_of_one_texel", "constant_environment", "materials", "film_of_one_pixel",
             "cropped_film", "empty"),
        ),
    ),
    "triple_product_of_directions": Technique(
        "two_stage", {"visibility": "world", "light_samples": 2, "vertices": "all"},
        thorough=Checks(cases=("sun_of_one_texel", "materials")),
    ),
    # ``test_portals.py`` has rooms, furnaces and densities
    "portals": Technique(
        "composed_path", {"next_event": "portals"}, checks=Checks(cases=["no_light"]),
        thorough=Checks(
            ["window"], ["llvm_ad_spectral"],
            cases=("sky_through_portals", "materials", "constant_environment", "empty"),
        ),
    ),
    # ``test_adaptive.py`` has seeds, samplers and films
    "adaptive": Technique(
        "adaptive", nested="composed_path",
        checks=Checks(cases=["no_light", "film_of_one_pixel"]),
        thorough=Checks(
            ["cornell_box"], ["llvm_ad_spectral"], ["furnace_box"], [-1],
            ("sun_of_one_texel", "materials", "film_of_odd_size", "cropped_film", "max_depth_0",
             "one_sample", "three_samples"),
        ),
    ),
    "adaptive_learning": Technique(
        "adaptive", nested="neepp", thorough=Checks(cases=["plain", "one_sample"])
    ),
    # ``test_manifolds.py`` has chains, known answers and refusals
    "manifold": Technique(
        "composed_path", {"caustics": "manifold"},
        checks=Checks(
            furnaces=["furnace_glass"], depths=[-1],
            cases=("materials", "delta_lights", "no_light", "empty", "film_of_one_pixel"),
        ),
        thorough=Checks(
            ["mirrors_and_glass"], ["llvm_ad_spectral"], FURNACES, [3],
            ("plain", "scaled_by_1e4", "sun_of_one_texel", "constant_environment", "instances",
             "textured_two_sided_lights", "smooth_normal_lamp", "cropped_film", "thin_lens",
             "hidden_emitters", "one_sample"),
        ),
    ),
    # The heuristics of multiple importance sampling
    **{
        f"mis_{heuristic}": Technique(
            "composed_path", {"mis": heuristic},
            checks=Checks(cases=["textured_two_sided_lights"]),
            thorough=Checks(
                ["cornell_box"], furnaces=["furnace_lamps"], depths=[-1], cases=_WEIGHED,
            ),
        )
        for heuristic in ("balance", "cutoff", "maximum", "light")
    },
    # Too noisy for scenes with small lights
    "mis_bsdf": Technique(
        "composed_path", {"mis": "bsdf"}, checks=Checks(cases=["textured_two_sided_lights"]),
        thorough=Checks(cases=_WEIGHED),
    ),
    "trained": _slow_neepp("rooms", **_TRAINED),
    "visibility": _neepp("window", **_TRAINED, light_sampling="visibility"),
    "grid_64": _neepp("window", pilot_spp=16, grid=64),
    "grid_1": _slow_neepp("rooms", **{**_TRAINED, "grid": 1}),
    "rejecting": _neepp("rooms", **_REJECTING),
    # The paper's law is so noisy that its mean is precise enough in one scene only
    "rejecting_paper": _slow_neepp("door_ajar", **{**_REJECTING, "law": "paper", "grid": 4}),
    "rejecting_floor": Technique(
        "neepp", {**_REJECTING, **_FLOOR},
        checks=Checks(
            ["window"], furnaces=["furnace_lamps"], depths=[-1],
            cases=(*_SEVERAL_LIGHTS, "scaled_by_1e-3", "moved_by_1e3_sizes", "sun_of_one_texel",
                   "smooth_normal_lamp", "one_sample"),
        ),
        thorough=Checks(
            ["rooms"], furnaces=["furnace_isothermal"], depths=[-1],
            cases=("plain", "scaled_by_1e4", "radiance_1e6", "lamp_of_radius_1e-4",
                   "light_that_nothing_sees", "closed_box", "degenerate_light", "max_depth_2"),
        ),
    ),
    # Rejection alone, by the map of pairs of voxels
    "mapped": _slow_neepp("rooms", **_MAPPED),
    "mapped_paper": _slow_neepp("door_ajar", **{**_MAPPED, "law": "paper", "grid": 4}),
    "mapped_floor": Technique(
        "neepp", {**_MAPPED, **_FLOOR},
        checks=Checks(["rooms"], furnaces=["furnace_lamps"], depths=[-1]),
        thorough=Checks(furnaces=["furnace_isothermal"], depths=[-1]),
    ),
}  # fmt: skip
