"""Bins of directions of an environment: densities, and what is sampled by them."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.lights.environment import BINS, EnvironmentBins, brightness, some_wavelengths
from mitsuba_ext.lights.light_cells import LightCells
from mitsuba_ext.lights.searching import alias_tables

LANES = 1 << 19
ALL_VARIANTS = ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono"]

pytestmark = pytest.mark.usefixtures("variant")


# ---- Environments ----


def _map(image: np.ndarray, **more) -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(np.float32(image)), **more}


def _random(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(1).random((height, width, 3))


def _with_sun(row: int) -> np.ndarray:
    image = 0.1 * _random(32, 64)
    image[row, 20] = 1e5
    return image


def _half_black() -> np.ndarray:
    image = np.zeros((16, 33, 3))
    image[3:9, 4:12] = _random(6, 8)
    return image


def _turned():
    return mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 70).rotate([0, 1, 0], 130)


ENVIRONMENTS = {
    "constant": lambda: {"type": "constant", "radiance": 2.0},
    "turned": lambda: _map(_random(40, 81), to_world=_turned()),
    "mirrored": lambda: _map(_random(9, 16), to_world=mi.ScalarTransform4f().scale([-1, 1, 1])),
    "sun": lambda: _map(_with_sun(11)),
    "sun in the zenith": lambda: _map(_with_sun(0)),
    "half black": lambda: _map(_half_black()),
    "smallest": lambda: _map(_random(3, 2)),
    "odd": lambda: _map(_random(5, 7)),
    "sky": lambda: {"type": "sunsky", "sun_direction": [1, 1, 1], "to_world": _turned()},
    "sunset": lambda: {"type": "sunsky", "sun_direction": [1, 0, 0.02]},
    "noon": lambda: {"type": "sunsky", "sun_direction": [0, 0, 1]},
    "sky without sun": lambda: {"type": "sunsky", "sun_scale": 0.0},
}


def _scene(name: str) -> mi.Scene:
    return mi.load_dict({"type": "scene", "e": ENVIRONMENTS[name](), "ball": {"type": "sphere"}})


@functools.lru_cache(maxsize=None)
def _samples(name: str) -> dict[str, np.ndarray]:
    """Directions in bins of random probabilities ("by chance"), in bins chosen by their share, and
    everywhere; numbers only, as a scene that is kept alive takes part in all later kernels."""
    scene = _scene(name)
    bins = EnvironmentBins(scene)
    rng, numbers = np.random.default_rng(5), mi.PCG32(size=LANES)

    def square():
        return mi.Point2f(numbers.next_float32(), numbers.next_float32())

    ref = dr.zeros(mi.Interaction3f, LANES)
    probability = rng.random(bins.count) * (rng.random(bins.count) > 0.2) + 1e-3 * bins.share
    probability /= probability.sum()
    result = {"share": bins.share, "probability": probability}
    for kind, p in (("chance", probability), ("share", bins.share)):
        bin = rng.choice(bins.count, LANES, p=p)
        ds, weight = bins.sample(mi.UInt32(bin.astype(np.uint32)), ref, square(), mi.Bool(True))
        found, pdf = bins.pdf(ds.d, mi.Bool(True))
        result |= {
            f"{kind} bin": bin, f"{kind} pdf": ds.pdf.numpy(), f"{kind} d": ds.d.numpy(),
            f"{kind} found bin": found.numpy(), f"{kind} found pdf": pdf.numpy(),
            f"{kind} estimate": brightness(weight).numpy() / p[bin],
        }  # fmt: skip
    d = mi.warp.square_to_uniform_sphere(square())
    bin, pdf = bins.pdf(d, mi.Bool(True))
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.wi = -d
    value = brightness(scene.environment().eval(si))
    own = scene.environment().sample_direction(ref, square())[1]
    return result | {
        "bin": bin.numpy(), "pdf": pdf.numpy(), "d": d.numpy(), "own estimate": brightness(own).numpy(),
        "estimate": (4 * dr.pi * value + dr.zeros(mi.Float, LANES)).numpy(),
    }  # fmt: skip


def _agree(a: np.ndarray, b: np.ndarray, errors: float = 4) -> bool:
    error = np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b)))
    # Single precision keeps what does not vary from being exact
    return abs(a.mean() - b.mean()) < errors * error + 1e-6 * abs(b.mean())


# ---- In RGB ----


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_sampled_direction_is_found_in_its_bin_with_its_density(name):
    s = _samples(name)
    for kind in ("chance", "share"):
        same = s[f"{kind} found bin"] == s[f"{kind} bin"]
        assert np.mean(~same) < 2e-5
        ratio = s[f"{kind} found pdf"][same] / s[f"{kind} pdf"][same]
        assert np.mean(np.abs(ratio - 1) > 1e-2) < 2e-5


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_density_of_each_bin_integrates_to_one(name):
    s = _samples(name)
    count = len(s["share"])
    assert s["share"].sum() == pytest.approx(1) and (s["share"] > 0).all()
    assert np.isfinite(s["pdf"]).all() and s["pdf"].min() > 0
    density = 4 * np.pi * s["pdf"]
    mean = np.bincount(s["bin"], density, count) / LANES
    square = np.bincount(s["bin"], density**2, count) / LANES
    z = (mean - 1) / np.sqrt((square - mean**2) / LANES)
    assert np.abs(z).max() < 5
    assert stats.chi2.sf(np.sum(z**2), count) > 1e-4


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_directions_are_distributed_by_the_density(name):
    """A chi² test: samples are counted, directions everywhere integrate the density."""
    s = _samples(name)
    edges = [np.linspace(-np.pi, np.pi, 25), np.linspace(-1, 1, 14)]

    def histogram(d, weights=None):
        return np.histogram2d(np.arctan2(d[1], d[0]), d[2], edges, weights=weights)[0]

    density = 4 * np.pi * s["pdf"] * s["probability"][s["bin"]]
    observed = histogram(s["chance d"])
    expected, square = histogram(s["d"], density), histogram(s["d"], density**2)
    used = expected > 25
    variance = expected + square - expected**2 / LANES
    chi2 = np.sum((observed - expected)[used] ** 2 / variance[used])
    assert used.sum() > 50 and stats.chi2.sf(chi2, used.sum()) > 1e-4


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_bins_of_any_probabilities_give_what_the_environment_emits(name):
    s = _samples(name)
    assert _agree(s["chance estimate"], s["own estimate"])
    assert _agree(s["share estimate"], s["own estimate"])
    assert _agree(s["estimate"], s["own estimate"])


@pytest.mark.parametrize("name", [k for k in ENVIRONMENTS if k not in ("constant", "smallest")])
def test_bins_are_sampled_by_what_they_emit(name):
    """Chosen by their share, bins give nearly the same estimate for all directions."""
    estimate = _samples(name)["share estimate"]
    assert estimate.std() < (1.5 if "s" == name[0] else 0.5) * estimate.mean()


def test_alias_tables_have_the_probabilities_of_their_weights():
    rng = np.random.default_rng(0)
    for power in (0, 1, 5, 40):
        sizes = rng.integers(1, 30, 200)
        group = np.repeat(np.arange(200), sizes)
        for weights in (rng.random(len(group)) ** power + 1e-12, rng.integers(1, 4, len(group))):
            threshold, alias = alias_tables(weights, sizes)
            assert (group[alias] == group).all()
            assert threshold.min() >= 0 and threshold.max() <= 1
            probability = threshold + np.bincount(alias, 1 - threshold, len(alias))
            expected = weights * sizes[group] / np.bincount(group, weights)[group]
            assert probability == pytest.approx(expected, abs=1e-7)
