"""``erpt`` renders what ``path`` renders, for any share of the energy that chains redistribute."""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.chains.bootstrap import Bootstrap
from mitsuba_ext.estimators.chains.chain_image import ChainImage
from mitsuba_ext.estimators.chains.looped import LoopedChains
from mitsuba_ext.estimators.chains.redistribution import RedistributionRender
from tests.support.chain_integrators import GLASS_BALL, erpt
from tests.support.chain_targets import TARGETS
from tests.support.stage import area, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    THRESHOLD,
    assert_images_are_sound,
    assert_same_quarters,
    batches,
    some,
    z_exact,
)
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")


_SETTINGS = {
    "outliers": {"outliers": 2.0},
    "everything": {"outliers": 0.0, "mutations_per_pixel": 50, "direct_samples": -1},
    "chains find all light": {"outliers": 1.0, "direct_samples": -1},
    "chains of one mutation": {"outliers": 0.0, "chain_length": 1},
    "bidirectional": {"outliers": 2.0, "bidirectional": True},
    "paths": {"outliers": 0.0, "mutations": "path"},
    "outliers of paths": {"outliers": 2.0, "mutations": "path"},
}


@pytest.mark.parametrize("which", some("chains find all light", "everything", of=_SETTINGS))
def test_redistribution_keeps_the_mean(which: str) -> None:
    scene = mi.load_dict(stage(glass=GLASS_BALL), optimize=False)
    integrator = erpt(**{"direct_samples": 64, **_SETTINGS[which]})
    # Many seeds: a tenth more energy in the chains must be seen
    precision = 0.02 if "mutations" in _SETTINGS[which] else 0.015
    images = batches(scene, integrator, 32, range(1, 25))
    expected = batches(scene, REFERENCE.make(4), 1024, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["lens", "caustic"])
def test_a_perturbation_alone_keeps_the_mean(which: str) -> None:
    kinds = ("lens", "multi_chain", "caustic")
    only = {f"{kind}_perturbation": kind == which for kind in kinds}
    scene = mi.load_dict(stage(glass=GLASS_BALL), optimize=False)
    integrator = erpt(mutations="path", outliers=1.0, direct_samples=-1, **only)
    images = batches(scene, integrator, 32, range(1, 17))
    expected = batches(scene, REFERENCE.make(4), 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.03)


@pytest.mark.slow
def test_chains_of_paths_keep_the_radiance_of_a_furnace() -> None:
    """A room that reflects half of its light: both parts of it, the outliers' energy too."""
    room = {"type": "sphere", "radius": 6.0, "flip_normals": True, "emitter": area(1.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    scene = mi.load_dict({"type": "scene", "room": room, "sensor": sensor()})
    integrator = erpt(5, mutations="path", outliers=1.0, direct_samples=-1)
    images = batches(scene, integrator, 16, range(1, 9))
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 2 - 0.5**4)
    assert abs(z) < THRESHOLD and error < 0.01


@pytest.mark.parametrize("key", ["bidirectional", "next_event", "proposal_filter"])
def test_parameters_that_chains_of_paths_do_not_use_are_refused(key: str) -> None:
    value = {"bidirectional": True, "next_event": "spatial", "proposal_filter": 7}[key]
    with pytest.raises(RuntimeError, match=f'"{key}" is for chains of primary samples'):
        erpt(mutations="path", **{key: value})


def test_only_outliers_are_redistributed() -> None:
    scene = mi.load_dict(stage(glass=GLASS_BALL))
    shares = []
    for outliers in (0.0, 1.0, 4.0, 1e6):
        integrator = erpt(outliers=outliers)
        batches(scene, integrator, 16, [1])
        shares.append(float(re.match(r"([\d.]+)% of the energy", integrator.statistics.learned)[1]))
    assert shares[0] == 100 and shares[-1] == 0 and shares == sorted(shares, reverse=True)
    assert len(set(shares)) == 4


def test_the_number_of_mutations_follows_the_energy() -> None:
    """All of it: as many as asked for, give or take a chain's."""
    scene, mutations = mi.load_dict(stage(glass=GLASS_BALL)), 60
    integrator = erpt(outliers=0.0, mutations_per_pixel=mutations, direct_samples=16)
    batches(scene, integrator, 64, [1])
    pixels = 16 * 16
    samples = integrator.statistics.rays["camera"] - 16 * pixels - mutations * pixels
    assert samples == pytest.approx(64 * pixels, rel=0.15)


def test_samples_start_chains_in_proportion_to_their_energy() -> None:
    """On average over the random offset, which follows from the seed."""
    ramp, counts = TARGETS["ramp"][0], []
    for seed in range(1, 65):
        samples = Bootstrap(ramp, seed, 64)
        found = ramp.evaluate(samples.numbers(dr.arange(mi.UInt32, samples.count)))
        target = found.target.numpy()
        energy = 2.5 * target.mean()
        chosen = np.bincount(samples.choose_by_energy(energy).numpy(), minlength=64)
        assert not chosen[target == 0].any()
        assert np.abs(chosen - target / energy).max() < 1 + 1e-4
        counts.append(chosen.sum() - target.sum() / energy)
    assert abs(np.mean(counts)) < THRESHOLD * np.std(counts, ddof=1) / 8


def test_cancelling_leaves_a_sound_image() -> None:
    scene, integrator = mi.load_dict(stage(glass=GLASS_BALL)), erpt()
    integrator.progress = lambda fraction: integrator.cancel()
    (image,) = batches(scene, integrator, 8, [1])
    assert_images_are_sound(image)
    assert image.any() and integrator.statistics.spp > 0


@pytest.mark.parametrize("chains", [True, False])
def test_an_error_amid_a_batch_leaves_the_batches_before_it(
    monkeypatch: pytest.MonkeyPatch, chains: bool
) -> None:
    """A second Ctrl-C does too, in chains or in samples: half of a batch would have a wrong
    mean."""
    monkeypatch.setattr(RedistributionRender, "max_batch", 16 * 16 * 16)
    scene, integrator = mi.load_dict(stage(glass=GLASS_BALL)), erpt(outliers=1.0, direct_samples=8)
    (expected,) = batches(scene, integrator, 16, [5])
    fails = LoopedChains if chains else ChainImage
    name = "end" if chains else "add_found"
    original, calls = getattr(fails, name), []

    def fail(part: Any, *found: Any) -> None:
        original(part, *found)
        calls.append(name)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(fails, name, fail)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, seed=5, spp=48)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 16
    image = np.array(scene.sensors()[0].film().bitmap())
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5 * expected.mean())


def test_a_time_limit_ends_between_batches() -> None:
    scene, integrator = mi.load_dict(stage(glass=GLASS_BALL)), erpt(timeout=2.0)
    (image,) = batches(scene, integrator, 1 << 14, [1])
    assert_images_are_sound(image)
    assert 0 < integrator.statistics.spp and not integrator.statistics.interrupted
