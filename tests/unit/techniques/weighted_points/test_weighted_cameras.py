"""Weighted lens points, times and wavelengths, combined and around integrators that learn."""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.request import Request
from tests.support.hard_cases import HARD_CASES
from tests.support.stage import film, lookat, sensor
from tests.support.statistical import assert_same_pixels_on_average, batches

pytestmark = pytest.mark.usefixtures("variant")

PATH = {"type": "composed_path", "max_depth": 3}
VIEW = {"aperture_radius": 0.3, "focus_distance": 2.0, "shutter_open": 0.25, "shutter_close": 0.75}
WEIGHTED = {"pattern": "independent", "weights": "torus"}


IN_SPECTRAL = pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)


def white(**parameters: Any) -> mi.Scene:
    camera = sensor("thinlens", to_world=lookat([0, -4, 0], [0, 0, 0], [0, 0, 1]),
                    film=film(12, 12, **parameters), **VIEW)  # fmt: skip
    return mi.load_dict({"type": "scene", "sensor": camera, "sky": {"type": "constant"}})


def nest(names: tuple[str, ...], innermost: dict = PATH, **parameters: Any) -> dict[str, Any]:
    for name in reversed(names):
        innermost = {"type": f"reweighted_{name}", **parameters, "nested": innermost}
    return innermost


@IN_SPECTRAL
@pytest.mark.parametrize("order", [("lens", "time", "wavelength"), ("wavelength", "lens", "time")])
def test_weights_of_all_purposes_are_multiplied(variant, order):
    """All weights of a sample are multiplied: the sum over a pixel varies as products do, not as
    the last factor does."""
    scene = white(pixel_format="rgba")

    def spread(names: tuple[str, ...]) -> float:
        integrator = mi.load_dict(nest(names, **WEIGHTED))
        return float(batches(scene, integrator, 16, range(1, 5))[..., 3].std())

    assert spread(order[:1]) < 1e-3, "weights of one purpose add up to one"
    assert spread(order[:2]) > 0.05 and spread(order) > 1.2 * spread(order[:2])


def test_aovs_and_alpha_have_the_same_weights():
    camera = sensor("thinlens", to_world=lookat([0, -4, 0], [0, 0, 0], [0, 0, 1]),
                    film=film(8, 8, pixel_format="rgba"), **VIEW)  # fmt: skip
    wall = {"type": "rectangle", "to_world": lookat([0, 1, 0], [0, 0, 0], [0, 0, 1]).scale(9)}
    sky = {"type": "constant"}
    scene = mi.load_dict({"type": "scene", "sensor": camera, "wall": wall, "sky": sky})
    normals = {"type": "composed_path", "aovs": "nn:sh_normal"}
    (image,) = batches(scene, mi.load_dict(nest(("lens", "time"), normals, **WEIGHTED)), 16, [1])
    assert image[..., 3].std() > 0.05
    np.testing.assert_allclose(image[..., -2], -image[..., 3], rtol=1e-4)


@pytest.mark.parametrize("side, nested", [
    (12, "neepp"),
    *(pytest.param(*case, marks=pytest.mark.slow)
      for case in ((12, "pss_guided"), (71, "neepp"), (71, "pss_guided"))),
])  # fmt: skip
def test_a_timeout_keeps_the_samples_that_were_asked_for(side, nested):
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    camera = sensor(shutter_open=0.0, shutter_close=1.0, film=film(side, side))
    scene = mi.load_dict({"type": "scene", "sensor": camera, "ball": {"type": "sphere"}, "l": lamp})
    integrator = mi.load_dict(nest(("time",), {"type": nested, "max_depth": 3}, timeout=60.0))
    for spp in (64, 72):
        mi.render(scene, integrator=integrator, spp=spp)
        assert integrator.statistics.spp == spp


@IN_SPECTRAL
def test_sets_within_sets_are_cut_alike_at_any_depth(variant):
    def points_of_sets(timeout: float) -> set[int]:
        inner = nest(("lens", "time"), timeout=3.0)
        outer = mi.load_dict({"type": "reweighted_wavelength", "nested": inner})
        scene = white()
        request = Request(scene, scene.sensors()[0], 1, timeout=timeout)
        plan = outer.plan_learning(request, 4096)
        stage = outer.schedule(request, (4096,), plan).next_stage()
        return {numbers._sets.count for numbers in vars(stage.camera).values() if numbers}

    assert points_of_sets(9.0) == {64} and points_of_sets(-1.0) == {1024}


@IN_SPECTRAL
def test_purposes_pixels_and_sets_draw_numbers_of_their_own(variant):
    nested = nest(("lens", "time", "wavelength"), pattern="sobol")
    scene = white()
    integrator, request = mi.load_dict(nested), Request(scene, scene.sensors()[0], 1)
    schedule = integrator.schedule(request, (16,), integrator.plan_learning(request, 16))
    stage = schedule.next_stage()
    pixel = dr.arange(mi.UInt32, 1 << 15)
    sets = [numbers for numbers in vars(stage.camera).values() if numbers]
    for one in sets:
        one._sets._opaque_sets = mi.UInt32(1)  # the same set for all: what differs is the shift
    turns = [[one.draw(None, pixel, mi.UInt32(16 * turn))[0] for one in sets] for turn in (0, 1)]
    numbers = [n for turn in turns for u in turn for n in (u if isinstance(u, mi.Point2f) else [u])]
    numbers = np.array([np.array(n) for n in numbers])
    assert len(numbers) == 8
    circle = np.exp(2j * np.pi * numbers)
    # Each number, and the difference and sum of two numbers (modulo 1), are uniform
    for a, b in itertools.combinations(circle, 2):
        for product in (a, a * b, a * b.conj()):
            assert abs(product.mean()) < 4.5 / np.sqrt(len(pixel))
    neighbours = circle[:, 1:] * circle[:, :-1].conj()
    assert np.abs(neighbours.mean(axis=1)).max() < 4.5 / np.sqrt(len(pixel))


def test_a_purpose_is_served_once():
    with pytest.raises(Exception, match="nested already"):
        mi.load_dict(nest(("lens", "time", "lens")))


@pytest.mark.parametrize("name", ["lens", "time"])
def test_emitters_are_hidden_by_the_nested_integrator(name):
    with pytest.raises(Exception, match="in the nested integrator"):
        mi.load_dict(nest((name,), hide_emitters=True))


@pytest.mark.parametrize("case", [
    "plain", "scaled_by_1e4", "materials", "closed_box", "cropped_film", "one_sample",
    "max_depth_unlimited", "hidden_environment",
])  # fmt: skip
def test_hard_case_has_the_mean_of_path(case):
    hard = HARD_CASES[case]
    scene = hard.make()
    optics = {"aperture_radius": 1e-3, "focus_distance": 1.0, "shutter_close": 0.5}
    scene["sensor"] = {**scene["sensor"], "type": "thinlens", **optics}
    scene = mi.load_dict(scene, optimize=False)
    own = {"type": "composed_path", "max_depth": hard.max_depth, **hard.parameters}
    integrator = mi.load_dict(nest(("time", "lens"), own, pattern="stratified", weights="torus"))
    images = batches(scene, integrator, hard.spp, range(1, 1 + hard.seeds))
    path = batches(scene, mi.load_dict({**own, "type": "path"}), 512, [101, 102])
    assert_same_pixels_on_average(images, path, hard.precision, unit=hard.unit)


@pytest.mark.parametrize("name", ["lens", "time"])
@pytest.mark.parametrize("chains", ["pssmlt", "erpt", "mlt"])
def test_chains_are_refused(name: str, chains: str) -> None:
    """Only their camera samples would be left: direct light."""
    with pytest.raises(Exception, match=f'not the whole image of "{chains}": its chains'):
        mi.load_dict(nest((name,), {"type": chains}))
