"""Chains visit states in proportion to the target function, from the first mutation on; small steps
are symmetric and stay in the interval."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.estimators.chains.bootstrap import Bootstrap
from mitsuba_ext.estimators.chains.chains import ChainRules, Chains
from mitsuba_ext.estimators.chains.looped import LoopedChains
from mitsuba_ext.estimators.chains.small_steps import SmallSteps
from mitsuba_ext.estimators.chains.stepped import SteppedChains
from mitsuba_ext.estimators.chains.target import Contribution, ImageTarget
from mitsuba_ext.rendering.filter_weights import mean_weights
from mitsuba_ext.transport.estimator import Sample
from mitsuba_ext.transport.numbers import NumberTable, StoredNumbers
from mitsuba_ext.transport.walk import Walk
from tests.support.chain_targets import BINS, TARGETS, Histogram, Target, found_at, ramp
from tests.support.stage import film, sensor, stage
from tests.support.statistical import THRESHOLD, sidak, z_exact

pytestmark = pytest.mark.usefixtures("variant")

#: Tests fail below this probability, the probability of |z| > THRESHOLD.
_UNLIKELY = 2 * stats.norm.sf(THRESHOLD)


# ---- Chains on known densities ----


#: Of the two kinds of chains, the targets for which each is made.
CASES = [
    *((LoopedChains, name) for name in ("ramp", "hill", "varying")),
    *((SteppedChains, name) for name in ("hill", "varying", "both ends")),
]
EACH_CASE = pytest.mark.parametrize(("kind", "name"), [
    pytest.param(
        kind, name, id=f"{kind.__name__}-{name}",
        # A mutation is several kernels
        marks=pytest.mark.slow if kind is SteppedChains and name != "both ends" else (),
    )
    for kind, name in CASES
])  # fmt: skip


def _chains(
    kind: type, target: ImageTarget, image: Any, rules: ChainRules, samples: Bootstrap,
    seed: int, count: int,
) -> Chains:  # fmt: skip
    return kind(target, image, rules, samples, samples.choose(count), seed)


def _run(
    kind: type,
    target: ImageTarget,
    seed: int,
    steps: int,
    large_step: float = 0.3,
    kelemen: bool = False,
    count: int = 1024,
    bootstrap: int = 4096,
) -> tuple[Chains, Histogram, np.ndarray]:
    """Chains after a number of mutations, the visits, and the estimate of the integrals."""
    samples = Bootstrap(target, seed, bootstrap)
    image = Histogram()
    weight = large_step * samples.mean if kelemen else 0.0
    rules = ChainRules(large_step, SmallSteps(1 / 64, 1 / 4), weight)
    chains = _chains(kind, target, image, rules, samples, seed, count)
    image.counts = [chains.advance(min(16, steps - done)) for done in range(0, steps, 16)]
    chains.end()
    sums = (image.visits.numpy() + image.uniform.numpy()).reshape(BINS, BINS)
    return chains, image, sums * samples.mean / (steps * count)


def _assert_unbiased(estimates: np.ndarray, exact: np.ndarray, precision: float) -> None:
    """The estimates come from independent seeds: [seed, y, x]."""
    assert not estimates[:, exact == 0].any()
    known = estimates[:, exact > 0]
    z = np.array([z_exact(e, x)[0] for e, x in zip(known.T, exact[exact > 0])])
    assert np.abs(z).max() < sidak(len(z)), z.round(1)
    score, error = z_exact(known.sum(axis=1), exact.sum())
    errors = [z_exact(e, x)[1] for e, x in zip(known.T, exact[exact > 0])]
    assert abs(score) < THRESHOLD and error < precision, (score, error)
    assert np.median(errors) < 5 * precision, errors


@pytest.mark.parametrize(("large_step", "kelemen"), [
    (0.3, True), *(pytest.param(p, k, marks=pytest.mark.slow)
                   for p, k in ((0.0, False), (0.3, False), (1.0, True))),
])  # fmt: skip
@EACH_CASE
def test_visits_and_uniform_samples_estimate_a_known_function(
    kind: type, name: str, large_step: float, kelemen: bool
) -> None:
    """In each of 64 bins, over independent seeds."""
    target, exact = TARGETS[name]
    found = [_run(kind, target, seed, 64, large_step, kelemen)[2] for seed in range(1, 17)]
    _assert_unbiased(np.array(found), exact, 0.01)


@EACH_CASE
def test_few_mutations_from_few_samples_are_right_on_average(kind: type, name: str) -> None:
    """There is no start-up bias: chains start where the target function is large, and all of them
    count by the mean of the samples from which they were chosen."""
    target, exact = TARGETS[name]
    found = [_run(kind, target, seed, 2, 0.1, count=16, bootstrap=16)[2] for seed in range(1, 257)]
    _assert_unbiased(np.array(found), exact, 0.05)


@pytest.mark.parametrize("large_step", [0.0, 0.2])
@EACH_CASE
def test_last_states_of_chains_have_the_density_of_the_target(
    kind: type, name: str, large_step: float
) -> None:
    target, exact = TARGETS[name]
    chains, _, _ = _run(kind, target, 5, 96, large_step, count=1 << 14)
    states = chains._parts if kind is SteppedChains else chains._state
    place = (states.position.numpy() * BINS).astype(int)
    seen = np.zeros((BINS, BINS))
    np.add.at(seen, (place[1], place[0]), 1)
    assert not seen[exact == 0].any()
    seen, expected = seen[exact > 0], exact[exact > 0] / exact.sum() * (1 << 14)
    assert stats.chisquare(seen, expected).pvalue > _UNLIKELY


@EACH_CASE
def test_all_mutations_are_in_the_image(kind: type, name: str) -> None:
    chains, image, _ = _run(kind, TARGETS[name][0], 1, 40)
    assert image.total.numpy()[0] == pytest.approx(40 * 1024, rel=1e-5)
    chains.advance(3)
    chains.end()
    chains.end()
    assert image.total.numpy()[0] == pytest.approx(43 * 1024, rel=1e-5), "they may go on"


@pytest.mark.parametrize("name", ["hill", "varying"])
def test_both_kinds_of_chains_end_in_the_same_states(name: str) -> None:
    """Bit for bit."""
    looped, stepped = (
        _run(kind, TARGETS[name][0], 9, 24, kelemen=True)
        for kind in (LoopedChains, SteppedChains)
    )
    known = looped[0]._known.numpy()
    np.testing.assert_array_equal(stepped[0]._known[0].numpy(), known)
    np.testing.assert_array_equal(stepped[0]._state.numpy(), looped[0]._state.target.numpy())
    ours, theirs = stepped[0]._values[0].numpy(), looped[0]._values.numpy()
    used = (np.arange(len(ours) // len(known))[:, None] < known).ravel()
    np.testing.assert_array_equal(ours[used], theirs[used])
    np.testing.assert_allclose(stepped[2], looped[2], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("kind", [LoopedChains, SteppedChains])
def test_every_proposal_is_accepted_where_the_target_is_constant(kind: type) -> None:
    def constant(numbers: Any) -> tuple[Contribution, Sample]:
        x, y = numbers.next_2d()
        return found_at(x, y, mi.Float(0.7) + 0 * x)

    _, image, _ = _run(kind, Target(constant), 1, 48)
    large, large_accepted, small_accepted = (
        sum(int(dr.sum(getattr(counts, name))[0]) for counts in image.counts)
        for name in ("large", "accepted_large", "accepted_small")
    )
    assert large == large_accepted and small_accepted == 48 * 1024 - large
    assert abs(large / (48 * 1024) - 0.3) < THRESHOLD * math.sqrt(0.3 * 0.7 / (48 * 1024))


def test_a_chain_leaves_no_black_state_behind_for_another() -> None:
    """Once a state is not black, no black one is accepted."""
    chains, _, _ = _run(LoopedChains, TARGETS["ramp"][0], 3, 50)
    assert chains._state.target.numpy().min() > 0


# ---- The states of a walk ----


def _walk_target() -> ImageTarget:
    glass = {"type": "sphere", "center": [-0.2, -0.8, 0.4], "radius": 0.3,
             "bsdf": {"type": "dielectric"}}  # fmt: skip
    scene = mi.load_dict(stage(glass=glass))
    return ImageTarget(scene, scene.sensors()[0], Walk(6, 2), 16)


class _NoImage:
    def add(self, *_: Any) -> None: ...

    def tensors(self) -> list:
        return []


@pytest.mark.parametrize("steps", [0, 1, 37])
def test_a_stored_state_agrees_with_its_numbers(steps: int) -> None:
    """Bit for bit: a chain forgets nothing of a path that it may come from."""
    target, count = _walk_target(), 2048
    rules = ChainRules(0.3, SmallSteps(), 0.0)
    samples = Bootstrap(target, 7, 4096)
    chains = _chains(LoopedChains, target, _NoImage(), rules, samples, 7, count)
    for _ in range(steps):
        chains.advance(1)
    numbers = StoredNumbers.begin(NumberTable(chains._values, count), count)
    found, _ = target(numbers)
    dr.eval(found, numbers.index)
    np.testing.assert_array_equal(numbers.index.numpy(), chains._known.numpy())
    for part in ("value", "target", "position"):
        np.testing.assert_array_equal(
            getattr(found, part).numpy(), getattr(chains._state, part).numpy()
        )
    assert chains._state.target.numpy().min() > 0 and len(set(chains._known.numpy())) > 3


# ---- Where chains start ----


def test_samples_of_the_bootstrap_lie_in_one_cell_each() -> None:
    samples = Bootstrap(TARGETS["hill"][0], 3, 900)
    numbers = samples.numbers(dr.arange(mi.UInt32, samples.count))
    place, others = numbers.next_2d(), numbers.next_2d()
    cells = np.floor(place.numpy() * math.isqrt(samples.count)).astype(int)
    assert samples.count == 900 and len(set(map(tuple, cells.T))) == 900
    assert stats.kstest(others.numpy().ravel(), "uniform").pvalue > _UNLIKELY
    assert [Bootstrap(TARGETS["hill"][0], 3, n).count for n in (1, 901)] == [1, 31**2]


def test_samples_are_chosen_in_proportion_to_the_target() -> None:
    """Each is chosen as often as expected, give or take one; black samples are never chosen."""
    samples, count = Bootstrap(TARGETS["ramp"][0], 3, 1000), 5000
    found, _ = ramp(samples.numbers(dr.arange(mi.UInt32, samples.count)))
    expected = found.target.numpy() / found.target.numpy().sum() * count
    chosen = np.bincount(samples.choose(count).numpy(), minlength=samples.count)
    assert chosen.sum() == count and not chosen[expected == 0].any()
    assert np.abs(chosen - expected).max() < 1 + 1e-3


def test_the_mean_of_the_bootstrap_is_the_mean_of_the_target() -> None:
    for name, (target, exact) in TARGETS.items():
        means = np.array([Bootstrap(target, seed, 100).mean for seed in range(1, 65)])
        z, error = z_exact(means, exact.sum())
        assert abs(z) < THRESHOLD and error < 0.01, (name, z, error)


def test_the_bootstrap_knows_the_error_of_its_mean() -> None:
    """The error is the error of samples without strata, because only numbers without strata matter
    here."""

    def rare(numbers: Any) -> tuple[Contribution, Sample]:
        place, x = numbers.next_2d(), numbers.next_1d()
        return found_at(place.x, place.y, dr.select(x < 0.1, mi.Float(1), 0))

    found = [Bootstrap(Target(rare), seed, 400) for seed in range(1, 65)]
    spread = np.std([samples.mean for samples in found], ddof=1) / 0.1
    # sqrt(0.9 / 0.1 / 400) = 0.15
    assert 0.75 < spread / 0.15 < 1.25
    assert abs(np.mean([samples.error for samples in found]) / 0.15 - 1) < 0.05


# ---- Small steps ----


def _uniform(count: int, seed: int) -> mi.Float:
    return mi.Float(np.random.default_rng(seed).random(count, dtype=np.float32))


_STEPS = [SmallSteps(), SmallSteps(1 / 64, 0.5), SmallSteps(0.1, 0.1)]


def test_the_logarithm_of_the_distance_of_a_small_step_is_uniform() -> None:
    steps, count = SmallSteps(1 / 512, 1 / 8), 1 << 16
    moved = steps.move(mi.Float(0.5), _uniform(count, 1)).numpy().astype(np.float64) - 0.5
    assert np.abs(moved).min() >= steps.low * (1 - 1e-4)
    assert np.abs(moved).max() <= steps.high * (1 + 1e-4)
    position = np.log(np.abs(moved) / steps.low) / math.log(steps.high / steps.low)
    for part in (position[moved > 0], position[moved < 0]):
        assert abs(len(part) - count / 2) < THRESHOLD * math.sqrt(count) / 2
        seen, _ = np.histogram(part, 32, (-1e-4, 1 + 1e-4))
        assert stats.chisquare(seen).pvalue > _UNLIKELY


def test_a_small_step_and_its_reverse_are_equally_likely() -> None:
    """This includes steps over the ends of the interval."""
    count, bins = 1 << 20, 24
    value = _uniform(count, 2)
    moved = SmallSteps(1 / 256, 1 / 4).move(value, _uniform(count, 3)).numpy()
    pairs, _, _ = np.histogram2d(value.numpy(), moved, bins, [(0, 1), (0, 1)])
    assert pairs[0, -1] > 100 and pairs[-1, 0] > 100
    forward, backward = (p[np.triu_indices(bins, 1)] for p in (pairs, pairs.T))
    seen = forward + backward > 0
    z2 = (forward - backward)[seen] ** 2 / (forward + backward)[seen]
    assert stats.chi2.sf(z2.sum(), seen.sum()) > _UNLIKELY


@pytest.mark.parametrize("steps", _STEPS, ids=str)
def test_small_steps_stay_in_the_interval(steps: SmallSteps) -> None:
    largest = 1 - 2.0**-24
    ends = [0.0, 1e-30, 1e-9, steps.low, 0.5, 1 - steps.high, 1 - steps.low, largest]
    samples = [0.0, 1e-9, 0.25, 0.5 - 2.0**-25, 0.5, 0.75, largest]
    value, sample = (mi.Float(x) for x in np.array(np.meshgrid(ends, samples)).reshape(2, -1))
    moved = steps.move(value, sample).numpy()
    assert moved.min() >= 0 and moved.max() <= largest
    distance = np.abs(moved - value.numpy())
    distance = np.minimum(distance, 1 - distance)
    assert distance.min() >= steps.low * (1 - 1e-5) - 1e-7
    assert distance.max() <= steps.high * (1 + 1e-5) + 1e-7


# ---- Filters ----


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "mitchell", "lanczos"])
def test_mean_weights_agree_with_many_camera_samples(rfilter: str) -> None:
    camera = mi.load_dict(sensor(film=film(7, 5, rfilter={"type": rfilter})))
    camera.film().prepare([])
    block, spp = camera.film().create_block(), 1 << 14
    lane = dr.arange(mi.UInt32, 35 * spp)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 35 * spp)
    position = mi.Point2f(lane // spp % 7, lane // spp // 7) + sampler.next_2d()
    block.put(position, [mi.Float(0)] * 3 + [mi.Float(1)])
    weights = np.array(block.tensor())[..., 3] / spp
    np.testing.assert_allclose(weights, mean_weights(camera.film()), atol=0.02)
