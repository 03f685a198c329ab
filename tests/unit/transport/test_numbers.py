"""The numbers of a walk: a fixed count per bounce, and the same path from a stored vector."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.planning.technique import Setting
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.lights.weights import power_weights
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.light_table import LightTable, OneRow
from mitsuba_ext.transport.numbers import NumberTable, StoredNumbers, hashed, hashed_2d
from mitsuba_ext.transport.path_decisions import DirectionSamples, Roulette, ShadowTest
from mitsuba_ext.transport.walk import Walk
from tests.support.stage import diffuse, rectangle, stage

pytestmark = pytest.mark.usefixtures("variant")

LANES, DEPTH = 2048, 6


class _Table:
    """Numbers that were drawn, by lane; not a part of the loop's state."""

    def __init__(self, size: int) -> None:
        self.values = dr.full(mi.Float, -1, size * LANES)


@dataclass
class _Recorder:
    """A sampler whose numbers are written down."""

    inner: mi.Sampler
    written: _Table
    lane: mi.UInt32
    index: mi.UInt32

    def next_1d(self, active: Any = True) -> mi.Float:
        x = self.inner.next_1d()
        dr.scatter(self.written.values, x, self.index * LANES + self.lane)
        self.index = self.index + 1
        return x

    def next_2d(self, active: Any = True) -> mi.Point2f:
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())


class _Watched(DirectionSamples):
    """Writes down how many numbers a path has drawn when it chooses each of its directions."""

    def __init__(self) -> None:
        self.drawn = dr.full(mi.UInt32, 2**32 - 1, DEPTH * LANES)

    def draw(self, state, sampler, vertex, active):
        slot = vertex.depth * LANES + sampler.lane
        dr.scatter(self.drawn, sampler.index, slot, vertex.depth < DEPTH)
        return super().draw(state, sampler, vertex, active)


class _Half(ShadowTest):
    def probability(self, state, choice, si, ds, active):
        return mi.Float(0.5), state


class _NeverEnds(Roulette):
    def survival(self, state, vertex, path, active):
        return mi.Float(0.97), state


def _scene() -> mi.Scene:
    """All kinds of vertices: connected ones and mirrors, in light and shade, and paths that end."""
    T = mi.ScalarTransform4f
    mirror = rectangle(
        T().translate([-1.2, 0.5, 0.6]).rotate([0, 1, 0], 60).scale(0.5), bsdf={"type": "conductor"}
    )
    glass = {"type": "sphere", "center": [-0.2, -0.8, 0.4], "radius": 0.3,
             "bsdf": {"type": "dielectric"}}  # fmt: skip
    point = {"type": "point", "position": [1, -1, 1.5]}
    wall = rectangle(T().translate([1.5, 0, 1]).rotate([0, 1, 0], -90), bsdf=diffuse())
    return mi.load_dict(stage(mirror=mirror, glass=glass, point=point, side=wall))


def _camera(scene: mi.Scene) -> CameraRays:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(9, LANES)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, sampler.next_2d(), mi.Point2f(0.5))
    return CameraRays(ray, dr.arange(mi.UInt32, LANES))


def _decisions(scene: mi.Scene, name: str) -> dict[str, Any]:
    cells = LightCells(scene, None)
    setting = Setting(scene, scene.sensors()[0], 0, DEPTH, 5, 16)
    if name == "path":
        return {}
    if name == "table":
        return {"next_event": LightTable(OneRow(), cells, power_weights(scene, cells))}
    if name == "roulette":
        return {"shadow_test": _Half()}
    if name == "many with roulette":
        return {**_decisions(scene, "many"), "shadow_test": _Half()}
    nested = {
        "linear": {"next_event": "linear"},
        "many": {"connections": {"type": "weighted_connections", "count": 3, "vertices": "all"}},
        "many at first": {"connections": 3},
    }[name]
    integrator = mi.load_dict({"type": "composed_path", **nested})
    decisions = {slot: p.decision(setting) for slot, p in integrator.slots.items()}
    return {slot: decision for slot, decision in decisions.items() if decision is not None}


_NAMES = ["path", "table", "linear", "roulette", "many", "many at first", "many with roulette"]


def _recorded(name: str, **more: Any) -> tuple[Any, _Recorder, CameraRays, dict[str, Any]]:
    scene = _scene()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(4, LANES)
    recorder = _Recorder(sampler, _Table(64 * DEPTH), dr.arange(mi.UInt32, LANES),
                         dr.zeros(mi.UInt32, LANES))  # fmt: skip
    rays, decisions = _camera(scene), _decisions(scene, name)
    walk = Walk(DEPTH, 2, **decisions, **more)
    sample = walk(scene, recorder, rays, mi.Bool(True))
    dr.eval(sample, recorder.index, recorder.written.values)
    return scene, sample, recorder, rays, decisions


@pytest.mark.parametrize("name", _NAMES)
def test_a_bounce_always_draws_the_same_number_of_numbers(name: str) -> None:
    """This includes rejected connections, vertices that cannot be connected, and the dark: each
    number keeps its meaning after a small change of the numbers before it."""
    watched = _Watched()
    _recorded(name, directions=watched, roulette=_NeverEnds())
    drawn = watched.drawn.numpy().reshape(DEPTH, LANES).astype(np.int64)
    places = []
    for row in drawn:
        reached = row[row != 2**32 - 1]
        if len(reached):
            places.append(set(reached.tolist()))
    assert len(places) >= 4
    assert all(len(place) == 1 for place in places), places
    steps = np.diff([place.pop() for place in places])
    # The first vertex may draw others than later ones
    assert len(set(steps[1:].tolist())) == 1, steps


@pytest.mark.parametrize("name", _NAMES)
def test_a_walk_is_the_same_from_the_numbers_that_it_drew(name: str) -> None:
    scene, sample, recorder, rays, decisions = _recorded(name)
    assert sample.L.numpy().any()
    numbers = StoredNumbers.begin(NumberTable(recorder.written.values, LANES), LANES)
    again = Walk(DEPTH, 2, **decisions)(scene, numbers, rays, mi.Bool(True))
    dr.eval(again, numbers.index)
    np.testing.assert_array_equal(again.L.numpy(), sample.L.numpy())
    np.testing.assert_array_equal(numbers.index.numpy(), recorder.index.numpy())
    np.testing.assert_array_equal(again.shadow_count.numpy(), sample.shadow_count.numpy())


def test_numbers_beyond_the_stored_ones_are_zero() -> None:
    table = NumberTable(mi.Float([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), 2)
    numbers = StoredNumbers.begin(table, 2)
    np.testing.assert_allclose(numbers.next_2d().numpy(), [[0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_allclose(numbers.next_1d().numpy(), [0.5, 0.6])
    np.testing.assert_array_equal(numbers.next_2d().numpy(), 0)
    np.testing.assert_array_equal(numbers.index.numpy(), 5)


# ---- Hashed numbers ----


@pytest.mark.parametrize("words", ["random", "consecutive"])
def test_pairs_of_hashed_numbers_are_uniform(words: str) -> None:
    """Those of one index, and first or second numbers of consecutive indices."""
    count = 1 << 22
    word = dr.arange(mi.UInt32, count)
    if words == "random":
        rng = np.random.default_rng(1)
        word = mi.UInt32(rng.integers(0, 1 << 32, count, dtype=np.uint32))
    p_values = []
    for index in (1, 2, 3, 7):
        here, next_one = (np.array(hashed_2d(word, mi.UInt32(i))) for i in (index, index + 1))
        assert here.min() >= 0 and here.max() < 1
        pairs = (here, (here[0], next_one[0]), (here[1], next_one[1]))
        p_values += [_chi2_of_pair(x, y) for x, y in pairs]
    assert min(p_values) > 1e-4 / len(p_values)


def test_all_pairs_of_the_hashed_numbers_of_a_lane_are_uniform() -> None:
    """Depth maps take five numbers for each of their pixels, whose words are consecutive."""
    numbers = [np.array(x) for x in hashed(dr.arange(mi.UInt32, 1 << 22), 5)]
    p_values = [_chi2_of_pair(x, y) for x, y in itertools.combinations(numbers, 2)]
    assert len(p_values) == 10 and min(p_values) > 1e-4 / len(p_values)


def _chi2_of_pair(x: np.ndarray, y: np.ndarray, bins: int = 64) -> float:
    """The p-value of the hypothesis that pairs of numbers are uniform."""
    cell = (x * bins).astype(int) * bins + (y * bins).astype(int)
    found, expected = np.bincount(cell, minlength=bins**2), len(x) / bins**2
    chi2 = ((found - expected) ** 2 / expected).sum()
    return float(stats.chi2.sf(chi2, bins**2 - 1))
