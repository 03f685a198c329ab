"""Bins of directions of an environment: their densities, and the samples drawn from them."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.scene.lights.environment_bins import BINS, EnvironmentBins
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.lights.sun import SunDisk
from mitsuba_ext.scene.lights.tabulated_bins import TabulatedBins
from mitsuba_ext.util.discrete_sampling import alias_tables
from mitsuba_ext.util.spectra import brightness, comparison_wavelengths
from tests.support.environments import ENVIRONMENTS, SPOTS, random_point

LANES = 1 << 18

pytestmark = pytest.mark.usefixtures("variant")


# ---- Environments ----


def _scene(name: str) -> mi.Scene:
    return mi.load_dict({"type": "scene", "e": ENVIRONMENTS[name](), "ball": {"type": "sphere"}})


def _everywhere(name: str, numbers: mi.PCG32) -> tuple[mi.Vector3f, mi.Float]:
    """Directions on the whole sphere, half of them in the spot, and their density."""
    d = mi.warp.square_to_uniform_sphere(random_point(numbers))
    if name not in SPOTS:
        return d, dr.full(mi.Float, dr.inv_four_pi, LANES)
    axis, degrees = SPOTS[name]
    axis = dr.normalize(mi.Vector3f(axis))
    area = 4 * np.sin(np.radians(degrees) / 2) ** 2  # of the cone's part of a unit sphere, over π
    p = mi.warp.square_to_uniform_disk_concentric(random_point(numbers))
    square = float(area) * dr.squared_norm(p)
    p *= dr.sqrt(float(area) * (1 - square / 4))
    cone = mi.Frame3f(axis).to_world(mi.Vector3f(p.x, p.y, 1 - square / 2))
    d = dr.select(numbers.next_float32() < 0.5, cone, d)
    in_cone = dr.squared_norm(d - axis) < float(area)
    return d, 0.5 * dr.inv_four_pi + dr.select(in_cone, float(0.5 / (np.pi * area)), 0)


@functools.lru_cache(maxsize=100)
def _samples(name: str) -> dict[str, np.ndarray]:
    """Directions in bins of random probabilities ("chance"), in bins chosen by their share, and
    everywhere; numbers only, as a scene that is kept alive takes part in all later kernels."""
    scene = _scene(name)
    bins = EnvironmentBins(scene)
    rng, numbers = np.random.default_rng(5), mi.PCG32(size=LANES)
    ref = dr.zeros(mi.Interaction3f, LANES)
    probability = 0.5 * (rng.dirichlet(np.ones(bins.count)) + bins.share)
    result = {"share": bins.share, "probability": probability}
    for kind, p in (("chance", probability), ("share", bins.share)):
        bin = rng.choice(bins.count, LANES, p=p)
        index = mi.UInt32(bin.astype(np.uint32))
        ds, weight = bins.sample(index, ref, random_point(numbers), mi.Bool(True))
        found, pdf = bins.pdf(ds.d, mi.Bool(True))
        result |= {
            f"{kind} bin": bin, f"{kind} pdf": ds.pdf.numpy(), f"{kind} d": ds.d.numpy(),
            f"{kind} found bin": found.numpy(), f"{kind} found pdf": pdf.numpy(),
            f"{kind} estimate": brightness(weight).numpy() / p[bin],
        }  # fmt: skip
    d, density = _everywhere(name, numbers)
    bin, pdf = bins.pdf(d, mi.Bool(True))
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.wi = -d
    estimate = brightness(scene.environment().eval(si)) / density
    return result | {
        "bin": bin.numpy(), "pdf": pdf.numpy(), "d": d.numpy(), "density": density.numpy(),
        "estimate": estimate.numpy(),
    }  # fmt: skip


def _agree(a: np.ndarray, b: np.ndarray, errors: float = 4) -> bool:
    error = np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b)))
    # Where nothing varies, rounding remains
    return abs(a.mean() - b.mean()) < errors * error + 1e-6 * abs(b.mean())


# ---- In RGB ----


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_sampled_direction_is_found_in_its_bin_with_its_density(name):
    s = _samples(name)
    for kind in ("chance", "share"):
        # Around the sun, what another bin would sample in its disk is lost
        sampled = s[f"{kind} pdf"] > 0
        assert np.mean(~sampled) < (1e-3 if name in SPOTS else 1e-9)
        same = (s[f"{kind} found bin"] == s[f"{kind} bin"])[sampled]
        assert np.mean(~same) < 1e-4
        ratio = (s[f"{kind} found pdf"] / np.maximum(s[f"{kind} pdf"], 1e-9))[sampled][same]
        assert np.mean(np.abs(ratio - 1) > 1e-2) < 2e-5


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_density_of_each_bin_integrates_to_one(name):
    s = _samples(name)
    count = len(s["share"])
    assert s["share"].sum() == pytest.approx(1) and (s["share"] > 0).all()
    assert np.isfinite(s["pdf"]).all() and s["pdf"].min() > 0
    value = s["pdf"] / s["density"]
    mean = np.bincount(s["bin"], value, count) / LANES
    square = np.bincount(s["bin"], value**2, count) / LANES
    z = np.abs(mean - 1) / np.sqrt((square - mean**2) / LANES)
    # Too few directions meet a bin at a pole to say how exact the mean is. The bins around the sun
    # miss the part that its disk takes from them.
    off = (z > 5.5) & (np.bincount(s["bin"], minlength=count) > 500)
    assert off.sum() <= (4 if name in SPOTS else 0) and (np.abs(mean[off] - 1) < 0.1).all()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_directions_are_distributed_by_the_density(name):
    """A chi² test: samples are counted, directions everywhere integrate the density."""
    s = _samples(name)
    edges = [np.linspace(-np.pi, np.pi, 25), np.linspace(-1, 1, 14)]

    def histogram(d, weights=None):
        return np.histogram2d(np.arctan2(d[1], d[0]), d[2], edges, weights=weights)[0]

    density = s["pdf"] * s["probability"][s["bin"]] / s["density"]
    observed = histogram(s["chance d"][:, s["chance pdf"] > 0])
    expected, square = histogram(s["d"], density), histogram(s["d"], density**2)
    used = expected > 25
    variance = expected + square - expected**2 / LANES
    chi2 = np.sum((observed - expected)[used] ** 2 / variance[used])
    assert used.sum() > 50 and stats.chi2.sf(chi2, used.sum()) > 1e-4


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_bins_of_any_probabilities_give_the_emission_of_the_environment(name):
    s = _samples(name)
    assert _agree(s["chance estimate"], s["estimate"])
    assert _agree(s["share estimate"], s["estimate"])


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_bins_are_sampled_in_proportion_to_their_emission(name):
    """Chosen by their share, they make nearly the same estimate of all that is emitted; also where
    a map's own sampling misses the pole, and though the sun is smaller than a texel of the sky."""
    estimate = _samples(name)["share estimate"]
    assert estimate.std() < (0.8 if name == "sun in the zenith" else 0.25) * estimate.mean()


def test_the_sun_is_found_in_the_zenith():
    """Any direction away from its middle will do there to find its edge."""
    disk = SunDisk.of(mi.load_dict({"type": "sunsky", "sun_direction": [0, 0, 1]}))
    numbers = mi.PCG32(size=1000)
    d = disk.sample(random_point(numbers))
    assert bool(dr.all(disk.contains(d))) and bool(dr.all(dr.abs(dr.norm(d) - 1) < 1e-5))
    assert disk.solid_angle == pytest.approx(np.pi * np.radians(0.5358 / 2) ** 2, rel=0.05)
    assert np.arccos(d.z.numpy().min()) == pytest.approx(np.radians(0.5358 / 2), rel=0.05)


@pytest.mark.parametrize("name", ["constant", "turned", "sky"])
def test_samples_lie_behind_the_scene_and_lanes_without_one_are_zero(name):
    ball = {"type": "sphere", "center": [9, 0, 0]}
    scene = mi.load_dict({"type": "scene", "e": ENVIRONMENTS[name](), "ball": ball})
    cells = LightCells(scene, mi.Vector3f(1))
    assert cells.count == BINS[0] * BINS[1] + (name == "sky")
    assert cells.emitter_index.tolist() == cells.count * [0]
    ref = dr.zeros(mi.Interaction3f, 3)
    ref.p = mi.Point3f([9, 50, -3], [0, 0, 7], 0)
    for active in (False, True):
        sample = mi.Point2f([0, 0.5, 1], [0, 0.99, 1])
        cell = mi.UInt32([0, 300, cells.count - 1])
        ds, weight = cells.sample(cell, ref, sample, mi.Bool(active))
        assert bool(dr.all((ds.pdf > 0) == active)) and bool(dr.all(weight.x >= 0))
        assert active or bool(dr.all(weight.x == 0))
        assert bool(dr.all(dr.isfinite(ds.pdf) & dr.all(dr.isfinite(ds.p) & dr.isfinite(ds.d))))
        assert bool(dr.all(dr.norm(ds.p - mi.Point3f(9, 0, 0)) > 1))
        # Also where there is no direction at all
        bad = dr.zeros(mi.SurfaceInteraction3f, 3)
        d = mi.DirectionSample3f(scene, bad, ref)
        d.d = mi.Vector3f([0, dr.nan, 1], 0, 0)
        pdf = cells.pdf(ref, bad, d, mi.Bool(False))[1]
        assert bool(dr.all(pdf == 0))


@pytest.mark.parametrize("name", ["turned", "sky"])
def test_a_few_directions_stand_for_a_bin(name):
    """Light and mean direction of each bin agree with many samples."""
    bins, each = EnvironmentBins(_scene(name)), 1 << 10
    index = dr.arange(mi.UInt32, bins.count * each) // each
    numbers, ref = mi.PCG32(size=len(index)), dr.zeros(mi.Interaction3f, len(index))
    found = []
    for source in (bins, TabulatedBins(bins)):
        ds, weight = source.sample(index, ref, random_point(numbers), mi.Bool(True))
        value = brightness(weight)
        columns = value, value * ds.d.x, value * ds.d.y, value * ds.d.z
        found.append(np.array([dr.block_sum(x, each).numpy() for x in columns]) / each)
    # A bin at the horizon may be black except for a few directions
    light = found[0][0] + found[0][0].mean()
    assert (np.abs(found[1] - found[0]) <= 0.06 * light).all()


@pytest.mark.parametrize(
    "variant, name",
    [
        ("llvm_ad_spectral", "constant"), ("llvm_ad_spectral", "turned"),
        ("llvm_ad_spectral", "sky"), ("llvm_ad_mono", "constant"), ("llvm_ad_mono", "turned"),
    ],
    indirect=["variant"],
)  # fmt: skip
def test_bins_work_in_other_variants(variant, name):
    scene = _scene(name)
    bins = EnvironmentBins(scene)
    rng, numbers = np.random.default_rng(2), mi.PCG32(size=LANES)
    bin = rng.choice(bins.count, LANES, p=bins.share)
    ref = dr.zeros(mi.Interaction3f, LANES)
    ref.wavelengths = comparison_wavelengths(LANES)
    index = mi.UInt32(bin.astype(np.uint32))
    ds, weight = bins.sample(index, ref, random_point(numbers), mi.Bool(True))
    found, pdf = bins.pdf(ds.d, mi.Bool(True))
    seen = (ds.pdf > 0).numpy()
    assert np.mean(found.numpy()[seen] != bin[seen]) < 2e-5
    assert np.abs(np.median((pdf / ds.pdf).numpy()[seen]) - 1) < 1e-5
    d, density = _everywhere(name, numbers)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.wi, si.wavelengths = -d, ref.wavelengths
    estimate = brightness(weight).numpy() / bins.share[bin]
    assert estimate.std() < 0.25 * estimate.mean()
    assert _agree(estimate, (brightness(scene.environment().eval(si)) / density).numpy())


def test_alias_tables_have_the_probabilities_of_their_weights():
    rng = np.random.default_rng(0)
    for power in (0, 1, 5, 40):
        sizes = rng.integers(1, 30, 200)
        group = np.repeat(np.arange(200), sizes)
        for weights in (rng.random(len(group)) ** power + 1e-12, rng.integers(1, 4, len(group))):
            expected = weights * sizes[group] / np.bincount(group, weights)[group]
            end = np.cumsum(sizes)
            first, last = (mi.UInt32(x[group].astype(np.uint32)) for x in (end - sizes, end - 1))
            tables = alias_tables(mi.Float64(expected), first, last, int(sizes.max()))
            threshold, alias = (x.numpy() for x in tables)
            assert (group[alias] == group).all()
            assert threshold.min() >= 0 and threshold.max() <= 1
            probability = threshold + np.bincount(alias, 1 - threshold, len(alias))
            assert probability == pytest.approx(expected, abs=2e-6)
