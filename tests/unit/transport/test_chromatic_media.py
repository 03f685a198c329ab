"""Media whose extinction varies between colours: scenes with a known answer, and ``volpath``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.media import extinction_varies, may_be_chromatic
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.path_decisions import ScatteringAlone
from mitsuba_ext.transport.queries.scene import scene_query
from mitsuba_ext.transport.walk import Walk
from tests.support.fogs import cube, fog, grid, homogeneous
from tests.support.stage import rgb
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_pixels_on_average,
    batches,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")

#: Extinctions that differ by a factor of 100.
STRONG = [0.1, 1.0, 10.0]


def _grid_of_colours(strongest: float = 6.0, **other) -> dict:
    density = np.random.default_rng(3).random((6, 5, 7, 1), dtype=np.float32)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    colours = (density * np.array(STRONG, dtype=np.float32) / 10 * strongest).astype(np.float32)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(colours), "to_world": place}
    volume["raw"] = mi.is_rgb
    return {"type": "heterogeneous", "sigma_t": volume, "albedo": 1.0, **other}


CHROMATIC = {
    "homogeneous": lambda: fog("environment", homogeneous(STRONG, 1.0)),
    "grid": lambda: fog("environment", _grid_of_colours()),
    "one_colour_missing": lambda: fog("environment", homogeneous([0.0, 1.0, 5.0], 1.0)),
    "nested": lambda: fog("environment", homogeneous(STRONG, 1.0), inner=cube(
        homogeneous([3.0, 1.0, 0.3], 1.0), 0.4, exterior=homogeneous(STRONG, 1.0))),
}  # fmt: skip


@pytest.mark.parametrize("variant", some(
    "llvm_ad_rgb", of=["llvm_ad_rgb", "llvm_ad_spectral"]), indirect=True)  # fmt: skip
@pytest.mark.parametrize("name", some("homogeneous", "grid", of=CHROMATIC))
def test_every_path_in_a_white_medium_carries_the_light_of_the_sky(variant: str, name: str) -> None:
    """What no colour absorbs leaves the mean of the throughput over colours as it is: of a sky of
    radiance 1, every single path brings 1. (Dividing by one colour's density, or by the mean over
    colours of each flight alone, would only have this mean.)"""
    if name == "grid" and mi.is_spectral:
        pytest.skip("a raw grid has no spectra")
    content = {**CHROMATIC[name](), "light": {"type": "constant"}}
    del content["floor"]
    scene = mi.load_dict(content)
    if mi.is_spectral:  # colours become smooth spectra, and a sky has the spectrum of daylight
        scene = mi.load_dict({**content, "light": {"type": "constant", "radiance": {
            "type": "uniform", "value": 1.0}}})  # fmt: skip
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 1 << 14)
    ray, _ = scene.sensors()[0].sample_ray(0, sampler.next_1d(), sampler.next_2d(), mi.Point2f(0))
    # A finite number of bounces: the few paths that are longer bring nothing
    walk = Walk(1000, 1000, query=scene_query(scene), mis=ScatteringAlone())
    L = np.array(walk(scene, sampler, CameraRays(ray), mi.Bool(True)).L)
    assert len(L) > 1 and L.std(axis=1).max() > 0.1, "no path has met the medium"
    np.testing.assert_allclose(L.mean(axis=0), 1, rtol=2e-3)
    assert abs(L.mean() - 1) < 1e-4


def _compare(scene: mi.Scene, kind: dict, spp: int, precision: float) -> None:
    images = batches(scene, mi.load_dict({"max_depth": 8, **kind}), spp, SEEDS[:4])
    # Roulette biases `volpathmis` (docs/mitsuba_faults.md)
    theirs = mi.load_dict({"type": "volpathmis", "max_depth": 8, "rr_depth": 100})
    expected = batches(scene, theirs, spp, REFERENCE_SEEDS[:4])
    # Samples of a few wavelengths can have negative colours
    tolerance = 0.1 if mi.is_spectral else 0.0
    assert_same_pixels_on_average(images, expected, precision, tolerance=tolerance)


WALK = {"type": "composed_path"}
CASES = {
    "homogeneous": (lambda: fog("area", homogeneous(STRONG, [0.9, 0.6, 0.8])), WALK),
    "grid": (lambda: fog("area", _grid_of_colours(3.0, albedo=0.8)), WALK),
    "sky": (lambda: fog("environment", homogeneous(STRONG)), WALK),
    "point": (lambda: fog("point", homogeneous(STRONG)), WALK),
    "guided": (lambda: fog("area", homogeneous(STRONG)), {
        "type": "pss_guided", "always_guide": True}),
    "learned_lights": (lambda: fog("area", homogeneous(STRONG), spot={
        "type": "point", "position": [-1, 2, 1], "intensity": 3.0}), {"type": "neepp"}),
    "distances": (lambda: fog("area", homogeneous(STRONG)), {
        "type": "swarm_path", "always_use": True}),
    "auto_path": (lambda: fog("area", homogeneous(STRONG)), {
        "type": "auto_path", "pilot_spp": 32}),
}  # fmt: skip


@pytest.mark.parametrize("name", some("homogeneous", "grid", of=CASES))
def test_coloured_media_have_the_mean_of_volpathmis(name: str) -> None:
    content, kind = CASES[name]
    _compare(mi.load_dict(content()), kind, 512, 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_coloured_media_have_the_mean_of_volpathmis_in_spectral_variants(variant: str) -> None:
    _compare(mi.load_dict(CASES["homogeneous"][0]()), WALK, 2048, 0.05)


def test_photons_find_coloured_fog_that_one_colour_does_not_have() -> None:
    """Camera rays gather photons at distances that the missing colour samples, too."""
    scene = mi.load_dict(fog("area_inside", homogeneous([0.0, 0.5, 1.0], 0.8)))
    images = [batches(scene, mi.load_dict({"type": kind, "max_depth": 4}), 512, SEEDS[:2])
              for kind in ("sppm", "composed_path")]  # fmt: skip
    means = [image.mean(axis=(0, 1, 2)) for image in images]
    np.testing.assert_allclose(*means, rtol=0.03)


def test_only_chromatic_extinction_changes_the_kernel() -> None:
    """The albedo of a medium does not choose distances."""
    def is_chromatic(medium: dict) -> bool:
        scene = mi.load_dict(fog(medium=medium))
        assert extinction_varies(scene) == may_be_chromatic(scene)
        return scene_query(scene).has_chromatic_media

    assert not is_chromatic(homogeneous(2.0, [0.9, 0.5, 0.1]))
    assert not is_chromatic({**grid(), "albedo": rgb(0.9, 0.5, 0.1)})
    assert is_chromatic(homogeneous([1.0, 1.0, 1.01]))
    assert is_chromatic(_grid_of_colours())


def test_while_a_user_records_all_media_count_as_chromatic() -> None:
    """No array can be read in ``dr.freeze``."""
    scene = mi.load_dict(fog("environment", homogeneous(2.0)))
    assert not may_be_chromatic(scene)
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope):
        assert may_be_chromatic(scene)
