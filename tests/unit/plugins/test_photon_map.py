"""Photon mapping in two passes: its images against ``path``, its maps, and what it refuses.
(``tests/claims`` has the tests that all techniques share.)"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.emitters_and_materials import shiny_things
from tests.support.stage import stage
from tests.support.statistical import assert_same_mean, batches, load

pytestmark = pytest.mark.usefixtures("variant")


def make(max_depth: int = 6, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "photon_map", "max_depth": max_depth, **parameters})


@pytest.mark.parametrize("parameters", [
    {}, pytest.param({"guided": True}, marks=pytest.mark.slow),
    pytest.param({"final_gather": False}, marks=pytest.mark.slow),
    pytest.param({"next_event": "power"}, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_mean_agrees_with_path(parameters: dict) -> None:
    """Each path from a light to the camera belongs to one part of the estimate: direct light,
    caustics, gathered light, by way of all kinds of surfaces."""
    scene = mi.load_dict(stage(**shiny_things()), optimize=False)
    found = batches(scene, make(photons=1 << 17, **parameters), 32, range(1, 9))
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 6}), 1024, range(101, 109))
    assert_same_mean(found, expected, 0.04, tolerance=0.0)


@pytest.mark.parametrize("parameters", [{"guided": True}, {"final_gather": False}])
def test_direct_light_agrees_with_path(parameters: dict) -> None:
    scene = mi.load_dict(stage(**shiny_things()), optimize=False)
    found = batches(scene, make(2, photons=1 << 14, **parameters), 256, range(1, 9))
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 2}), 256, range(101, 109))
    assert_same_mean(found, expected, 0.04, tolerance=0.0)


def test_guided_directions_change_no_mean() -> None:
    """The same photons, looked up from other directions."""
    scene = load("furnace_box", width=16, height=16)
    plain, guided = (
        batches(scene, make(3, photons=1 << 14, guided=guided), 128, range(1, 5)).mean()
        for guided in (False, True)
    )
    assert guided == pytest.approx(plain, rel=0.003)


def test_light_by_way_of_a_mirror_counts_once() -> None:
    """The lamp shines up, at a mirror: no light reaches the floor directly."""
    T = mi.ScalarTransform4f
    lamp = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(0.5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}}  # fmt: skip
    mirror = {"type": "rectangle", "bsdf": {"type": "conductor"},
              "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(3)}  # fmt: skip
    scene = mi.load_dict(stage(light=lamp, mirror=mirror), optimize=False)
    found = batches(scene, make(4, photons=1 << 17), 64, range(1, 9))
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 4}), 256, range(101, 109))
    assert_same_mean(found, expected, 0.02, tolerance=0.0)


def test_more_photons_have_less_bias() -> None:
    """In the corners of a box, a part of the disk is missing."""
    scene = load("furnace_box", width=16, height=16)
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 256, [1]).mean()
    biases = [
        1 - batches(scene, make(3, photons=photons), 32, range(1, 5)).mean() / expected
        for photons in (1 << 12, 1 << 17)
    ]
    assert abs(biases[1]) < 0.01 and biases[1] < 0.5 * biases[0]


def test_the_maps_are_visible() -> None:
    """The channels of the maps hold what photons tell of the surfaces that pixels show."""
    scene = mi.load_dict(stage(**shiny_things()), optimize=False)
    integrator = make(photons=1 << 16, photon_aovs=True, aovs="d:depth")
    names = integrator.aov_names()
    assert names == ["d.T", *(f"{m}.{c}" for m in ("caustic", "global") for c in "RGB")]
    image = np.array(mi.render(scene, integrator=integrator, spp=4))[..., -7:]
    caustic, everything = image[..., 1:4], image[..., 4:7]
    assert (caustic >= 0).all() and 0 < caustic.mean() < everything.mean()
    maps = integrator.maps
    assert 0 < maps.caustics.grids[0].count < maps.vertices.count


def test_a_given_radius_is_used() -> None:
    scene = mi.load_dict(stage(**shiny_things()), optimize=False)
    integrator = make(photons=1 << 12, global_radius=0.25, caustic_radius=0.125)
    mi.render(scene, integrator=integrator, spp=1)
    maps = integrator.maps
    found = [[float(grid.radius[0]) for grid in m.grids] for m in (maps.caustics, maps.gathered)]
    assert found == [[0.125], [0.25]]


# ---- Errors ----


def test_a_guided_gather_needs_a_gather() -> None:
    with pytest.raises((ValueError, RuntimeError), match='"photon_map": "guided" chooses'):
        make(guided=True, final_gather=False)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_variants_are_refused(variant: str) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match='"photon_map": the variant is'):
        make().render(scene, spp=1)


def test_moving_shapes_are_refused() -> None:
    ball = {"type": "moving", "translate": [0, 0, 1], "in": {"type": "sphere", "radius": 0.1}}
    scene = mi.load_dict(stage(ball=ball), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match='"photon_map": shapes or lights'):
        make().render(scene, spp=1)
