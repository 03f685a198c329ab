"""Russian roulette by what a path is expected to bring: its probabilities, what it learns from,
what it is worth, and that it changes no mean."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.pixel_estimates import PixelEstimates
from mitsuba_ext.techniques.guided_directions.decisions import AdjointRoulette
from mitsuba_ext.techniques.guided_directions.roulette_trial import Outcome, RouletteTrial
from mitsuba_ext.techniques.guided_directions.surface_regions import SurfaceRegions
from mitsuba_ext.transport.path_decisions import Roulette
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_pixels_on_average,
    some,
    two_halves,
)
from tests.support.techniques import TECHNIQUES

pytestmark = pytest.mark.usefixtures("variant")


# ---- Probabilities ----


class _ByPlace:
    """Regions along x."""

    def label(self, si, pixel, active):
        return mi.UInt32(si.p.x)


def _probability(throughput: float, radiance: float, pixel: float, depth: int = 5) -> float:
    table = mi.Float([0.0, radiance])
    roulette = AdjointRoulette(_ByPlace(), table, mi.Float([0.0, 1 / pixel]))
    vertex = SimpleNamespace(si=SimpleNamespace(p=mi.Point3f(1.5, 0, 0)), medium=None)
    path = SimpleNamespace(β=mi.Color3f(throughput), depth=mi.UInt32(depth))
    state = roulette.begin(None, None, mi.UInt32(1))
    p, _ = roulette.survival(state, vertex, path, mi.Bool(True))
    return float(p[0])


def test_paths_survive_in_proportion_to_their_expected_light() -> None:
    one = _probability(0.04, 2.0, 2.0)
    assert 0.1 < one < 0.5
    assert _probability(0.08, 2.0, 2.0) == pytest.approx(2 * one)
    assert _probability(0.04, 4.0, 2.0) == pytest.approx(2 * one)
    assert _probability(0.04, 2.0, 1.0) == pytest.approx(2 * one)


def test_probabilities_lie_between_the_least_and_one() -> None:
    for throughput in (0.0, 1e-20, 0.1, 1.0, 1e20):
        for radiance in (0.0, 1e-20, 1.0, 1e10):
            assert 0.1 <= _probability(throughput, radiance, 1.0) * 1.0001
            assert _probability(throughput, radiance, 1.0) <= 1
    assert _probability(1.0, 1.0, 1.0) == 1
    assert _probability(0.0, 0.0, 1.0) == pytest.approx(0.1)


def test_no_path_ends_at_mirrors_but_none_goes_on_forever() -> None:
    assert _probability(1e-3, -1.0, 1.0) == 1
    for radiance in (-1.0, 10.0):
        assert _probability(1.0, radiance, 1.0, depth=30) == pytest.approx(0.95)


# ---- What it learns from ----


def test_pixels_have_the_means_of_their_neighbours() -> None:
    width, height = 24, 20
    image = np.where(np.arange(width) < 12, 1.0, 3.0)[None].repeat(height, axis=0)
    pixels = PixelEstimates(width, height)
    index = mi.UInt32(np.arange(width * height, dtype=np.uint32))
    for error in (-0.5, 0.5):
        pixels.add(index, mi.Float((image + error).ravel().astype(np.float32)))
    scale = pixels.scale().numpy().reshape(height, width)
    floor = 1e-2 * image.mean() ** 2
    np.testing.assert_allclose(scale[:, :8], 1 / np.sqrt(1 + floor), rtol=1e-5)
    np.testing.assert_allclose(scale[:, 16:], 1 / np.sqrt(9 + floor), rtol=1e-5)
    assert (np.diff(scale[5]) <= 1e-6).all()


def test_a_black_image_has_a_finite_scale() -> None:
    pixels = PixelEstimates(4, 2)
    pixels.add(mi.UInt32([0, 1, 5]), mi.Float([0.0, np.inf, np.nan]))
    assert np.isfinite(pixels.scale().numpy()).all()


def test_a_region_expects_the_light_of_the_region_around_it() -> None:
    """Two corners of a cube; the second has few samples."""
    p = np.array([[0.1, 0.9], [0.1, 0.9], [0.1, 0.9]]).repeat(8, axis=1)
    up = np.tile([[0], [0], [1]], 16)
    regions = SurfaceRegions(mi.Point3f(p), mi.Normal3f(up), 8)
    finest = regions.count - 1
    parent = regions.regions.parent[finest]
    region = np.r_[np.full(1000, finest - 1), np.full(8, finest), [regions.count]]
    records = SimpleNamespace(
        region=mi.UInt32(region.astype(np.uint32)),
        value=mi.Float(np.r_[np.full(1000, 0.5), np.full(8, 4.0), [9.0]].astype(np.float32)),
        throughput=mi.Float(np.full(1009, 0.5, np.float32)),
    )
    radiance = regions.incident_radiance(records).numpy()
    assert radiance[finest - 1] == pytest.approx(1, rel=0.05)
    assert radiance[0] == pytest.approx((1000 * 1 + 8 * 8) / 1008)
    assert radiance[0] < radiance[parent] < radiance[finest] < 8
    assert radiance[regions.count] == -1


# ---- What it is worth ----


def _trial(
    survival: float, weights: tuple[float, float], brightest: float | None = None
) -> RouletteTrial:
    """Paths of two bounces that bring 1 after the second. The first one's number has one of two
    values of equal probability; the second of them brings nothing. Its density is 1 / weight. One
    path may be the brightest."""
    lanes = 1 << 17
    random = np.random.default_rng(1)
    # Errors are those from the true mean, and count the same everywhere
    pixels = SimpleNamespace(importance=lambda pixel, L: (mi.Float(1), dr.square(L - 1)))
    trial = RouletteTrial(1, 1, pixels)
    trial.begin(lanes, dr.zeros(mi.UInt32, lanes))
    guided = random.random(lanes) < 0.5 / weights[0]
    weight = np.where(guided, *weights)
    alive, factor, unguided = np.ones(lanes, bool), np.ones(lanes), np.ones(lanes)
    for bounce in range(2):
        w = weight if bounce == 0 else np.ones(lanes)
        depth, active = mi.UInt32(bounce), mi.Bool(alive)
        vertex = SimpleNamespace(depth=depth)
        trial.direction(vertex, None, mi.Float(w), mi.Color3f(0.0), active)
        unguided, factor = 0.8 * unguided, factor * w
        p = mi.Float(np.full(lanes, survival))
        path = SimpleNamespace(
            depth=depth + 1, β=mi.Color3f(mi.Float(unguided)), sampling_weight=1.0, η=mi.Float(1)
        )
        trial.survival(path, p, active)
        alive = alive & (random.random(lanes) < survival)
        factor, unguided = factor / survival, unguided / survival
    brought = np.where(alive & guided, 2 * factor, 0)
    assert brought.mean() == pytest.approx(1, rel=0.05)
    if brightest is not None:
        brought[0] = brightest
    trial.end(mi.Color3f(mi.Float(brought)))
    trial.finish()
    return trial


@pytest.mark.parametrize("survival", [1.0, 0.7])
def test_the_effects_of_other_roulettes_are_estimated_too(survival: float) -> None:
    """The probabilities of ``path`` are 0.8 both times, because surviving paths lose no
    throughput."""
    trial, lanes = _trial(survival, (0.6, 3.0)), 1 << 17
    squares = {"drawn": 4 * 0.5 * 0.6 / survival**2, "by_throughput": 4 * 0.5 * 0.6 / 0.64,
               "unguided": 4 * 0.5 / 0.64}  # fmt: skip
    for name, square in squares.items():
        effect: Outcome = getattr(trial, name)
        p = survival if name == "drawn" else 0.8
        assert effect.variance / lanes == pytest.approx(square - 1, rel=0.08), name
        assert effect.segments / lanes == pytest.approx(1 + p + p * p, rel=0.02), name


def test_one_bright_path_changes_no_effect() -> None:
    """It would hide what is gained with all other paths."""
    usual, bright = (_trial(0.7, (0.6, 3.0), brightest) for brightest in (None, 1e4))
    for name in ("drawn", "by_throughput", "unguided"):
        effects = getattr(usual, name), getattr(bright, name)
        assert effects[1].variance == pytest.approx(effects[0].variance, rel=1e-3), name


def test_efficiency_counts_variance_and_segments() -> None:
    assert Outcome(1.0, 2.0).efficiency(Outcome(4.0, 1.0)) == 2


# ---- Renders ----


def _room(**things: Any) -> mi.Scene:
    view = lookat([0, -0.9, 0], [0, 0.2, -0.2], [0, 0, 1])
    return mi.load_dict({
        "type": "scene",
        "sensor": sensor(to_world=view, film=film(32, 32), fov=80.0),
        "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.6)},
        **things,
    })  # fmt: skip


def _lamp_in_glass() -> mi.Scene:
    ball = {"type": "sphere", "center": [0.3, 0.3, -0.4]}
    return _room(
        glass={**ball, "radius": 0.3, "bsdf": {"type": "dielectric"}},
        lamp={**ball, "radius": 0.15, "bsdf": diffuse(0.0), "emitter": area(10.0)},
    )


def _lamp_to_the_ceiling() -> mi.Scene:
    place = mi.ScalarTransform4f().translate([0, 0.2, 0.5]).scale([0.2, 0.2, 1])
    return _room(lamp=rectangle(place, bsdf=diffuse(0.0), emitter=area(10.0)))


@pytest.mark.slow
@pytest.mark.parametrize("max_depth", some(8, of=[8, -1]))
@pytest.mark.parametrize(
    "make", some(_lamp_to_the_ceiling, of=[_lamp_in_glass, _lamp_to_the_ceiling])
)
def test_learned_roulette_is_unbiased(make, max_depth: int) -> None:
    scene = make()
    integrator = TECHNIQUES["pss_guided"].make(max_depth, rr_depth=1)
    image = two_halves(scene, integrator, 1024, SEEDS)
    assert type(integrator.learner.roulette) is AdjointRoulette
    reference = TECHNIQUES["composed_path"].make(max_depth, rr_depth=6)
    assert_same_pixels_on_average(image, two_halves(scene, reference, 4096, REFERENCE_SEEDS), 0.05)


@pytest.mark.parametrize("parameters", [{"rr_depth": 8}, {"regions": "tiles"}])
def test_without_a_learned_roulette_the_one_of_path_is_used(parameters: dict[str, Any]) -> None:
    integrator = TECHNIQUES["pss_guided"].make(8, **parameters)
    mi.render(_lamp_in_glass(), integrator=integrator, spp=64)
    assert integrator.learner.trial is None
    assert type(integrator.learner.roulette) is Roulette


def test_learned_roulette_is_dropped_where_the_one_of_path_is_better(monkeypatch) -> None:
    finish = RouletteTrial.finish

    def worse(self) -> None:
        finish(self)
        self.drawn = Outcome(2 * self.by_throughput.variance, self.by_throughput.segments)

    monkeypatch.setattr(RouletteTrial, "finish", worse)
    scene = _lamp_to_the_ceiling()
    for always, kind in ((False, Roulette), (True, AdjointRoulette)):
        integrator = mi.load_dict({"type": "pss_guided", "max_depth": 8, "rr_depth": 2,
                                   "always_guide": always})  # fmt: skip
        mi.render(scene, integrator=integrator, spp=128)
        assert type(integrator.learner.roulette) is kind
