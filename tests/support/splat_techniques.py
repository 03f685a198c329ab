"""The techniques whose pixels share light: light paths, photons, chains, stored irradiance."""

from __future__ import annotations

from tests.support.furnaces import FURNACES
from tests.support.hard_cases import HARD_CASES
from tests.support.technique import DEPTHS, EVERY_VARIANT, SCENES, Checks, Technique

_NOT_DIFFUSE = ("furnace_glass", "furnace_isothermal", "furnace_lamps")
_GLASS_AND_ISOTHERMAL = ("furnace_glass", "furnace_isothermal")

#: ``path`` finds no beams, and errs for lamps with interpolated normals. Where rays start far above
#: surfaces, light paths and camera paths miss different objects. A thousand lights take minutes.
_UNLIKE_PATH = (
    "directional_area_light", "smooth_normal_lamp", "moved_by_1e3_sizes", "thousand_lights",
)
_OF_CAMERA_PATHS = ("sky_through_portals", "medium")
_LIGHT_PATHS = tuple(
    case for case in HARD_CASES if case not in (*_UNLIKE_PATH, *_OF_CAMERA_PATHS)
)

#: Light paths alone show nothing behind mirrors, glass, masks and null surfaces, and refuse a film
#: with a sampled border.
_UNSEEN_FROM_LIGHTS = {
    "furnace_glass", "furnace_isothermal", "materials", "cropped_film", "mirror_ring",
    "floor_under_water",
}  # fmt: skip

#: Chains refuse films with a sampled border. For a film of one pixel, 128 camera samples are few.
_OF_CHAINS = tuple(
    case
    for case in HARD_CASES
    if case not in ("cropped_film", "film_of_one_pixel", *_OF_CAMERA_PATHS)
)

SPLAT_TECHNIQUES: dict[str, Technique] = {
    # ``test_bdpt.py`` and ``test_light_tracer.py`` have emitters, materials and sensors
    "bdpt": Technique(
        "bdpt", is_plugin=True, makes_splats=True,
        checks=Checks(["cornell_box"], cases=["no_light", "instances", "thin_lens"]),
        thorough=Checks(
            ["mirrors_and_glass", "sunny_gloss", "window"], EVERY_VARIANT, FURNACES,
            [2, -1], _LIGHT_PATHS,
        ),
    ),
    # ``test_merging.py`` has the bias of merging
    "vcm": Technique(
        "vcm", {"radius": 0.01}, is_plugin=True, makes_splats=True,
        checks=Checks(cases=["no_light"]),
        thorough=Checks(
            ["cornell_box", "mirrors_and_glass"], ["llvm_ad_mono"], _GLASS_AND_ISOTHERMAL, [2, -1],
            ("plain", "materials", "mirror_ring", "floor_under_water", "scaled_by_1e4",
             "film_of_one_pixel", "one_sample", "max_depth_0", "thin_lens", "hidden_emitters"),
        ),
    ),
    "photon_map": Technique(
        "photon_map", {"photons": 1 << 16}, is_plugin=True, makes_splats=True,
        checks=Checks(cases=["no_light"]),
        thorough=Checks(
            variants=["llvm_ad_mono"], depths=[-1],
            cases=("plain", "materials", "mirror_ring", "floor_under_water", "scaled_by_1e4",
                   "film_of_one_pixel", "one_sample", "max_depth_0", "thin_lens",
                   "hidden_emitters"),
        ),
    ),
    # ``test_instant_radiosity.py`` has choices, bounds and materials
    "instant_radiosity": Technique(
        "instant_radiosity", {"light_paths": 200}, is_plugin=True, makes_splats=True,
        checks=Checks(furnaces=["furnace_box"], depths=[3], cases=["no_light"]),
        thorough=Checks(
            ["cornell_box", "rooms"], ["llvm_ad_mono"], FURNACES, [2, -1],
            _LIGHT_PATHS,
        ),
    ),
    # ``test_irradiance_cache.py`` has means: it is biased
    "irradiance_cache": Technique(
        "irradiance_cache", {"gather_samples": 64, "min_spacing": 0.5, "max_share": 1.0,
         "effort": 100.0},
        is_plugin=True, makes_splats=True,
        checks=Checks(cases=["no_light"]),
        thorough=Checks(
            variants=["llvm_ad_mono"], furnaces=["furnace_glass"],
            cases=("plain", "delta_lights", "constant_environment", "film_of_one_pixel",
                   "one_sample", "max_depth_0", "max_depth_unlimited", "thin_lens", "cropped_film",
                   "hidden_emitters", "empty", "degenerate_light", "instances"),
        ),
    ),
    "light_tracer": Technique(
        "light_tracer", is_plugin=True, makes_splats=True,
        checks=Checks(cases=["no_light", "max_depth_unlimited"]),
        thorough=Checks(
            ["rooms"], EVERY_VARIANT,
            [name for name in FURNACES if name not in _UNSEEN_FROM_LIGHTS], [2, -1],
            [case for case in _LIGHT_PATHS if case not in _UNSEEN_FROM_LIGHTS],
        ),
    ),
    # 128 camera samples, the number that ``path`` has in the tests. ``test_chains.py`` and
    # ``test_pssmlt.py`` have chains on known densities, films and sensors
    "pssmlt": Technique(
        "pssmlt", {"bidirectional": False, "direct_samples": 128, "chains": 1024},
        is_plugin=True, makes_splats=True,
        checks=Checks(
            ["cornell_box"], furnaces=["furnace_glass"], depths=[-1],
            cases=("no_light", "light_that_nothing_sees", "materials", "one_sample"),
        ),
        thorough=Checks(
            SCENES, EVERY_VARIANT, FURNACES, DEPTHS, _OF_CHAINS,
        ),
    ),
    # No camera samples: chains find all light
    "chains_alone": Technique(
        "pssmlt",
        {"bidirectional": False, "direct_samples": -1, "chains": 1024,
         "kelemen_style_weights": False},
        makes_splats=True,
        checks=Checks(cases=["plain", "film_of_one_pixel"]),
        thorough=Checks(
            ["cornell_box", "rooms"], ["llvm_ad_spectral"], _GLASS_AND_ISOTHERMAL, [2, -1],
            _OF_CHAINS,
        ),
    ),
    # Chains of paths from both ends
    "bidirectional_chains": Technique(
        "pssmlt", {"direct_samples": 128, "chains": 4096, "two_stage": True}, makes_splats=True,
        checks=Checks(cases=["no_light"]),
        thorough=Checks(
            ["cornell_box", "rooms"], ["llvm_ad_spectral"], _NOT_DIFFUSE, [2, -1],
            tuple(case for case in _LIGHT_PATHS if case in _OF_CHAINS),
        ),
    ),
    "erpt": Technique(
        "erpt", {"bidirectional": False, "direct_samples": 128, "outliers": 2.0}, is_plugin=True,
        makes_splats=True,
        checks=Checks(furnaces=["furnace_glass"], cases=["no_light"]),
        thorough=Checks(
            ["cornell_box", "mirrors_and_glass"], ["llvm_ad_spectral"], _NOT_DIFFUSE, [2, -1],
            # Its mean is known to 3.5 % only
            tuple(case for case in _OF_CHAINS if case != "bulb_under_a_shade"),
        ),
    ),
    "mlt": Technique(
        "mlt", {"direct_samples": 128, "chains": 1024}, is_plugin=True, makes_splats=True,
        checks=Checks(cases=("no_light", "plain")),
        thorough=Checks(
            [], ["llvm_ad_spectral"], _GLASS_AND_ISOTHERMAL, [2, -1],
            ("materials", "directional_light", "smooth_normal_lamp", "mirror_ring",
             "floor_under_water", "closed_box", "degenerate_triangles", "thin_lens",
             "hidden_emitters"),
        ),
    ),
}  # fmt: skip
