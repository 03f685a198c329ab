"""Presets are ``composed_path`` with the parameters of its slots written out: the same images, bit
for bit."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import area, diffuse, film, rectangle, sensor, stage
from tests.support.statistical import batches, one_thread

pytestmark = pytest.mark.usefixtures("variant")

_OPTICS = {
    "aperture_radius": 0.2, "focus_distance": 4.0, "shutter_open": 0.25, "shutter_close": 0.75,
}  # fmt: skip


def _scene() -> mi.Scene:
    """Four lamps, two of them behind the wall, through a lens whose shutter stays open."""
    T = mi.ScalarTransform4f
    lamps = {
        f"lamp {i}": rectangle(
            T().translate([x, y, 1.9]).rotate([1, 0, 0], 180).scale([0.2, 0.2, 1]),
            bsdf=diffuse(0.0), emitter=area(radiance),
        )
        for i, (x, y, radiance) in enumerate(
            ((-1, 0, 3.0), (1, 0, 6.0), (0, 2, 20.0), (1, 2.5, 9.0))
        )
    }  # fmt: skip
    camera = sensor("thinlens", film=film(20, 16), **_OPTICS)
    return mi.load_dict(stage(camera=camera, light={}, **lamps))


def _assert_same_image(*integrators: dict[str, Any], spp: int = 64) -> None:
    scene, images, shadow_rays, learned = _scene(), [], [], []
    for parameters in integrators:
        depth = {} if "nested" in parameters else {"max_depth": 4}
        integrator = mi.load_dict({**parameters, **depth})
        with one_thread():
            images.append(batches(scene, integrator, spp, [5])[0])
        shadow_rays.append(integrator.statistics.rays["shadow"])
        learned.append(integrator.statistics.learned)
    assert images[0].any()
    np.testing.assert_array_equal(*images)
    assert len(set(shadow_rays)) == 1 and len(set(learned)) == 1, (shadow_rays, learned)


def _composed(**slots: Any) -> dict[str, Any]:
    return {"type": "composed_path", **slots}


_ROULETTE = {"law": "affine", "slope": 3.0, "floor": 0.2}


def _slow(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize("preset, slots", [
    _slow({}, {"next_event": "contribution"}),
    ({"light_sampling": "visibility", "grid": 4, "max_memory": 3.0, "pilot_spp": 9},
     {"next_event": {"type": "learned_lights", "target": "visibility", "grid": 4,
                     "max_memory": 3.0}, "pilot_spp": 9}),
    ({"grid": 3, "rejection": True, **_ROULETTE},
     {"next_event": {"type": "learned_lights", "grid": 3},
      "shadow_test": {"type": "visibility_roulette", **_ROULETTE}}),
    ({"light_sampling": "uniform", "rejection": True, "grid": 6, "refine": 3, "law": "paper"},
     {"shadow_test": {"type": "visibility_roulette", "grid": 6, "refine": 3, "law": "paper"}}),
    ({"light_sampling": "spatial", "grid": 5}, {"next_event": {"type": "spatial_lights",
                                                               "grid": 5}}),
    ({"light_sampling": "linear"}, {"next_event": "linear"}),
    _slow({"light_sampling": "power"}, {"next_event": "power"}),
    _slow({"light_sampling": "uniform"}, {}),
], ids=lambda parameters: "-".join(map(str, parameters)))  # fmt: skip
def test_neepp_is_composed_path(preset: dict[str, Any], slots: dict[str, Any]) -> None:
    _assert_same_image({"type": "neepp", **preset}, _composed(**slots))


@pytest.mark.parametrize("guiding, connections", [
    _slow({"always_guide": True}, {}),
    _slow({"always_guide": True, "regions": "tiles", "tile": 5, "bounces": 3}, {}),
    ({"always_guide": True, "bounces": 2, "max_memory": 0.5}, {"connections": 0}),
], ids=["surfaces", "tiles", "without connections"])  # fmt: skip
def test_pss_guided_is_composed_path(guiding: dict[str, Any], connections: dict[str, Any]) -> None:
    preset = {"nee_first_bounce": False} if connections else {}
    _assert_same_image(
        {"type": "pss_guided", "pilot_spp": 12, **guiding, **preset},
        _composed(directions={"type": "guided_directions", **guiding}, pilot_spp=12, **connections),
    )


@pytest.mark.parametrize("pattern, weights", [("sobol", "torus"), _slow("hammersley", "none")])
def test_reweighted_direct_is_composed_path(pattern: str, weights: str) -> None:
    many = {"pattern": pattern, "weights": weights}
    _assert_same_image(
        {"type": "reweighted_direct", "light_samples": 5, **many},
        _composed(connections={"type": "weighted_connections", "count": 5, **many}),
        spp=8,
    )


def test_a_number_of_connections_is_a_plugin_with_defaults() -> None:
    nested = {"type": "weighted_connections", "count": 3}
    _assert_same_image(_composed(connections=3), _composed(connections=nested), spp=8)


@pytest.mark.parametrize("inner", [{}, {"next_event": "contribution"}], ids=["plain", "learning"])
@pytest.mark.parametrize("kind, slot", [("lens", "aperture"), ("time", "time")])
def test_reweighted_numbers_of_the_camera_are_a_slot(
    kind: str, slot: str, inner: dict[str, Any]
) -> None:
    numbers = {"pattern": "stratified", "weights": "torus"}
    _assert_same_image(
        {"type": f"reweighted_{kind}", **numbers,
         "nested": _composed(max_depth=4, **inner)},
        _composed(**{slot: {"type": "weighted_numbers", **numbers}}, **inner),
    )  # fmt: skip


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_nested_purposes_are_slots_of_one_integrator(variant: str) -> None:
    nested = _composed(max_depth=4)
    for kind in ("wavelength", "time", "lens"):
        nested = {"type": f"reweighted_{kind}", "pattern": "sobol", "nested": nested}
    slots = dict.fromkeys(("aperture", "time", "wavelength"), "sobol")
    _assert_same_image(nested, _composed(**slots), spp=16)
