"""Learned seeds of chains, and the shares of connections and scattering."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.manifolds.seeds import SeedMap
from mitsuba_ext.estimators.light_paths.manifolds.shares import (
    counted,
    most_trials,
    share_of_scattering,
    taken_from_scattering,
)
from mitsuba_ext.estimators.light_paths.manifolds.solver import Target
from mitsuba_ext.util.stored_arrays import DamagedError, StoredArrays

pytestmark = pytest.mark.usefixtures("variant")


def _records(count: int) -> np.ndarray:
    """Chains from vertices in a cube to one target. Each begins one unit above its vertex; the
    chains of half of the vertices are twice as bright as the others."""
    records = np.zeros((count, 11), np.float32)
    records[:, 0:3] = np.random.default_rng(1).random((count, 3))
    records[:, 6:9] = records[:, 0:3] + [0, 0, 1]
    records[:, 9] = 11
    records[:, 10] = np.where(records[:, 0] < 0.5, 2, 1)
    return records


def _seeds_at(seeds: SeedMap, p: mi.Point3f, height: float) -> mi.Point3f:
    """Seeds for vertices; ``height`` is the number by which a node of the tree is chosen."""
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(1, dr.width(p))
    target = Target(mi.Point3f(0), mi.Bool(False))
    leaf = seeds.leaf(p, target, dr.full(mi.Bool, True, dr.width(p)))
    first, pattern = seeds.seed(leaf, numbers.next_1d(), mi.Float(height))
    assert dr.all(pattern == 11)
    return first - mi.Vector3f(0, 0, 1)


def test_seeds_are_those_of_near_vertices_in_proportion_to_their_light() -> None:
    records = _records(8192)
    seeds = SeedMap.of(records)
    p = mi.Point3f(np.ascontiguousarray(records[:, 0:3].T))
    distance = np.array(dr.norm(_seeds_at(seeds, p, 0.0) - p))
    assert distance.mean() < 0.12  # 512 leaves; of two random points: 0.66
    # The root of the tree: the number is the largest one below 1
    share = (np.array(_seeds_at(seeds, p, 1 - 2.0**-24).x) < 0.5).mean()
    assert abs(share - 2 / 3) < 0.02


def test_few_chains_are_enough_for_seeds() -> None:
    seeds = SeedMap.of(_records(1))
    assert len(seeds.seeds) == 1 and not len(seeds.splits)


def test_seeds_are_restored() -> None:
    seeds = SeedMap.of(_records(256))
    stored = StoredArrays.of(seeds.state())
    again = SeedMap.restored(stored)
    for mine, other in zip(seeds.kernel_state(), again.kernel_state()):
        np.testing.assert_array_equal(np.array(mine), np.array(other))
    nothing = SeedMap.restored(StoredArrays.of(SeedMap().state()))
    assert not len(nothing.seeds)
    with pytest.raises(DamagedError, match="patterns"):
        SeedMap.restored(StoredArrays.of({**seeds.state(), "seeds": seeds.seeds + 1}))


@pytest.mark.parametrize("ratio", [0.0, 0.003, 0.04, 0.3, 0.99])
@pytest.mark.parametrize("p", [0.9, 0.2, 0.01])
def test_connections_and_scattering_share_all_light_of_a_chain(p: float, ratio: float) -> None:
    """A trial finds it with the probability p; sums over the number of trials until one does."""
    limit = 4096
    most = int(most_trials(mi.Float(ratio), mi.UInt32(limit))[0])
    assert most == min(limit, int(1 / ratio) if ratio else limit)
    n = dr.arange(mi.UInt32, most + 1) + 1  # one more if no trial finds it
    by_us, by_scattering = counted(dr.minimum(n, most), ratio), share_of_scattering(n, ratio)
    chance = p * (1 - p) ** np.arange(most + 1.0)
    chance[-1] = (1 - p) ** most
    total = p * np.array(by_us) + np.array(by_scattering)
    np.testing.assert_allclose((chance * total).sum(), 1, rtol=1e-4)
    assert (np.array(by_scattering) > 0).all() == (ratio > 0)
    if ratio > 0:  # the second moment of scattering, as connections tell it
        taken = p * np.array(taken_from_scattering(dr.minimum(n, most), mi.Float(ratio)))
        np.testing.assert_allclose(
            (chance * taken).sum(), (chance * (1 - np.array(by_scattering) ** 2)).sum(), rtol=1e-3
        )


def test_few_trials_lose_light_of_chains_that_they_rarely_find() -> None:
    p, limit = 0.01, 64
    n = np.arange(1, 4096)
    counts = np.array(counted(dr.minimum(mi.UInt32(n), limit), mi.Float(0)))
    found = (p * (1 - p) ** (n - 1.0) * p * counts).sum()
    np.testing.assert_allclose(found, 1 - (1 - p) ** limit, rtol=1e-4)
