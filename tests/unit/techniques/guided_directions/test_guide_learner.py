"""The measurements of the learner of path guiding, its decisions, and the memory that it keeps."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.learner import Pilot
from mitsuba_ext.planning.pixel_estimates import PixelEstimates
from mitsuba_ext.planning.technique import Setting
from mitsuba_ext.techniques.guided_directions.decisions import GuidedDirections
from mitsuba_ext.techniques.guided_directions.learner import GuideLearner, most_efficient
from mitsuba_ext.techniques.guided_directions.path_records import BYTES_PER_RECORD, PathRecords
from mitsuba_ext.techniques.guided_directions.surface_regions import SurfaceRegions
from mitsuba_ext.techniques.guided_directions.tile_regions import TileRegions
from tests.support.maps import vertex_at
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 16


class _Numbers:
    """A sampler."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def next_1d(self) -> mi.Float:
        return mi.Float(0.5)

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(self._random.random((2, LANES), dtype=np.float32))


def _pixels() -> mi.UInt32:
    """Two, far from each other."""
    return 31 * (dr.arange(mi.UInt32, LANES) // (LANES // 2))


def _brought(pixel: mi.UInt32, u: mi.Point2f) -> mi.Float:
    """A bright pixel with little noise, and a dim one with much."""
    bright = 10 + 10 * dr.select(u.x < 0.5, mi.Float(1), 0)
    return dr.select(pixel == 0, bright, dr.select(u.y < 0.25, mi.Float(2), 0.6))


def _pilot(
    learner: GuideLearner, seed: int, scatters: bool = True, brought: Callable = _brought
) -> None:
    """The first of two directions decides nothing."""
    pixel, numbers = _pixels(), _Numbers(seed)
    observer = learner.observer
    observer.begin(LANES, pixel)
    state = learner.guide and learner.guide.begin(None, None, pixel)
    L, β, active = mi.Float(0), mi.Float(1), mi.Bool(scatters)
    for depth in range(2):
        sample, weight, vertex = numbers.next_2d(), mi.Float(1), vertex_at(depth)
        if learner.guide:
            _, sample, weight, state = learner.guide.draw(state, numbers, vertex, active)
        observer.direction(vertex, sample, weight, mi.Color3f(L), active)
        β *= weight
    L += β * brought(pixel, sample)
    observer.end(mi.Color3f(L))


def _learner(kind: type[GuideLearner] = GuideLearner, **changes) -> GuideLearner:
    parameters = {"bounces": 2, "max_memory": 1 << 30, "pilot_samples": 3 * LANES,
                  "film_size": (32, 1), **changes}
    learner = kind(lambda p, n: TileRegions(32, 1, 16), False, **parameters)
    learner.start(None, mi.Point3f(), mi.Normal3f())
    return learner


class _Listening(GuideLearner):
    """Keeps the gains that it found."""

    def gains(self, records: PathRecords) -> dict[float, np.ndarray]:
        self.found = super().gains(records)
        return self.found


def test_gain_of_each_share_follows_from_its_density() -> None:
    """Relative errors count; what the pilots before have drawn does not."""
    learner = _learner(_Listening, always=True)
    _pilot(learner, 1)
    learner.learn(Pilot(None, False))
    for pilot in range(2):
        guide = learner.guide
        share = guide.trees.share.numpy().max()
        assert share == pytest.approx(learner.guidance.share if learner.guidance else 0.6)
        _pilot(learner, 2 + pilot)
        learner.learn(Pilot(None, pilot == 1))
        pixel, u = _pixels(), _Numbers(10).next_2d()
        state = guide.begin(None, None, pixel)
        first = guide.draw(state, _Numbers(11), vertex_at(0), mi.Bool(True))
        tree = guide.regions.tree(first[3], None, mi.Bool(True))
        mixed = guide.trees.density(tree, u, mi.Bool(True))[0].numpy()
        density = (mixed - (1 - share)) / share
        value = _brought(pixel, u).numpy().reshape(2, -1)
        mean = value.mean(axis=1, keepdims=True)
        scale = np.sqrt(mean**2 + 0.01 * value.mean() ** 2)
        square, variance = (value / scale) ** 2, ((value - mean) / scale) ** 2
        for other, gains in learner.found.items():
            saved = square - square / (other * density + 1 - other).reshape(2, -1)
            expected = saved.sum() / variance.sum()
            assert gains[0] == pytest.approx(0, abs=0.01), other
            assert gains[1] == pytest.approx(expected, abs=0.03) and expected > 0.2, other


def test_most_efficient_guide_is_chosen() -> None:
    gains = {0.4: np.array([0.3, 0.2, 0.0]), 0.6: np.array([0.35, 0.01, -0.1])}
    guidance = most_efficient(gains)
    assert guidance[:3] == (0.4, 2, pytest.approx(0.5)) and 1.7 < guidance.efficiency < 2
    assert most_efficient({0.4: np.array([0.0, -0.1])}).efficiency < 1
    assert most_efficient(gains, all_bounces=True)[:2] == (0.4, 3)


class _Measured(GuideLearner):
    """Finds other gains than its pilots."""

    gain = 0.0

    def gains(self, records: PathRecords) -> dict[float, np.ndarray]:
        return {share: np.full(2, self.gain) for share in super().gains(records)}


@pytest.mark.parametrize("always", [False, True])
def test_a_guide_that_does_not_pay_is_dropped_unless_it_is_forced(always: bool) -> None:
    learner = _learner(_Measured, always=always)
    for seed in range(2):
        _pilot(learner, seed)
        decision = learner.learn(Pilot(None, False))
    assert (learner.guide is not None) == always
    assert (decision is None) == (not always)
    assert learner.guidance.gain == 0 and str(learner).startswith("no guide: ") == (not always)


def test_beside_light_paths_it_learns_from_new_samples_only() -> None:
    learner = _learner(always=True)
    for seed in (1, 2):
        _pilot(learner, seed)
        learner.learn(Pilot(None, False))
    guide, guidance, count = learner.guide, learner.guidance, learner.sample_count
    # Where a sample takes longer, guides cost less in comparison
    later, slow = learner.beside_light_paths(1.0), learner.beside_light_paths(100.0)
    for other in (later, slow):
        assert other.guide is guide
        _pilot(other, 3)
        assert other.learn(Pilot(None, True)) is other.guide is not guide
        assert other.sample_count == count / 2
    assert slow.guidance.efficiency > later.guidance.efficiency
    assert (learner.guide, learner.guidance, learner.sample_count) == (guide, guidance, count)


def test_gains_that_are_not_numbers_are_none() -> None:
    """Squares of a path's radiance can overflow."""
    learner = _learner()
    for seed in (1, 2):
        _pilot(learner, seed, brought=lambda pixel, u: _at(u, 1e30))
        learner.learn(Pilot(None, False))
    assert learner.guide is None and str(learner).startswith("no guide: ")


def _at(u: mi.Point2f, value: float) -> mi.Float:
    return dr.select(u.y < 0.25, mi.Float(value), 0)


@pytest.mark.parametrize("pilot", [1, 2])
def test_a_pilot_in_which_no_path_scatters_teaches_nothing(pilot: int) -> None:
    """After one in which paths did: a film of a few pixels, most of which see nothing."""
    learner = _learner()
    for index in range(3):
        _pilot(learner, index, scatters=index != pilot)
        learner.learn(Pilot(None, index == 2))
    assert learner.guide is not None


def test_stride_follows_from_the_memory() -> None:
    for records in (6 * LANES, 6 * LANES - 1, 1000):
        stride = -(-6 * LANES // records)
        learner = _learner(max_memory=records * BYTES_PER_RECORD)
        _pilot(learner, 1)
        learner.learn(Pilot(None, False))
        assert learner.sample_count == 2 * -(-LANES // stride)


def test_later_directions_are_not_guided() -> None:
    learner = _learner()
    _pilot(learner, 1)
    learner.learn(Pilot(None, True))
    guide = GuidedDirections(learner.guide.trees, learner.guide.regions, bounces=1)
    state, active = guide.begin(None, None, _pixels()), dr.full(mi.Bool, True, LANES)
    state = guide.draw(state, _Numbers(2), vertex_at(0), active)[3]
    _, sample, weight, after = guide.draw(state, _Numbers(3), vertex_at(1), active)
    assert (sample == _Numbers(3).next_2d()).numpy().all() and (weight == 1).numpy().all()
    assert (after == state).numpy().all()
    guided = learner.guide.draw(state, _Numbers(3), vertex_at(1), active)[2]
    assert not (guided == 1).numpy().all()


def test_regions_follow_the_film_and_the_pilots() -> None:
    camera = mi.load_dict(
        sensor(film=film(10, 6, rfilter={"type": "gaussian"}, sample_border=True))
    )
    # Two voxels with the least number of places, and one with less
    p = np.array([[0.1, 0.9, 0.1], [0.1, 0.9, 0.9], [0.1, 0.9, 0.1]]).repeat([8, 8, 7], axis=1)
    up = np.tile([[0], [0], [1]], 23)
    lit = mi.load_dict({"type": "scene", "lamp": {"type": "point"}})
    made = []
    for regions in ("tiles", "surfaces"):
        tile = {"tile": 4} if regions == "tiles" else {}
        integrator = mi.load_dict({"type": "pss_guided", "regions": regions, **tile})
        setting = Setting(lit, camera, 0, 3, 5, 32, pilot_spp=32)
        learner = integrator.slots["directions"].learner(setting, {})
        assert learner.wants_scout == (regions == "surfaces")
        made.append(learner.make_regions(mi.Point3f(p), mi.Normal3f(up)))
    assert made[0].count == 4 * 3
    assert made[1].count == SurfaceRegions(mi.Point3f(p), mi.Normal3f(up), 256 / 32).count == 9


def test_memory_is_bounded_where_no_path_ends() -> None:
    T = mi.ScalarTransform4f
    view = lookat([0, -0.9, 0], [0, 0, 0.1], [0, 0, 1])
    down = T().translate([0, 0, 0.95]).rotate([1, 0, 0], 180).scale([0.2, 0.2, 1])
    scene = mi.load_dict({
        "type": "scene",
        "sensor": sensor(to_world=view, film=film(48, 48)),
        "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.8)},
        "lamp": rectangle(down, bsdf=diffuse(0.0), emitter=area(5.0)),
    })  # fmt: skip
    guided = {"type": "pss_guided", "max_memory": 16.0, "max_depth": 8, "rr_depth": 100}
    integrator = mi.load_dict({**guided, "always_guide": True, "bounces": 5})
    taken = []
    for each in (mi.load_dict({**guided, "pilot_spp": 0}), integrator):
        mi.render(scene, integrator=each, spp=128)
        dr.sync_thread()
        taken.append(each.statistics.memory)
    assert integrator.guide is not None
    assert taken[1] - taken[0] < 1.25 * 16 * 2**20, taken


def test_importance_follows_the_place_in_the_image() -> None:
    """Errors are relative to the mean of the pixels around, and to little of all."""
    width, count = 32, 4
    pixels = PixelEstimates(width, width)
    records = PathRecords(lambda si, pixel, active: pixel, bounces=2, stride=1, pixels=pixels)
    # The right half of the film is brighter; paths bring half or three halves of that
    radiance = np.where(np.arange(width) < width // 2, 1.0, 4.0)[None].repeat(width, axis=0)
    pixel = np.arange(width * width, dtype=np.uint32).repeat(count)
    brought = radiance.ravel().repeat(count) * np.tile([0.5, 1.5], width * width * count // 2)
    for _ in range(2):
        records.begin(len(pixel), mi.UInt32(pixel))
        for depth in range(2):
            sample, L = mi.Point2f(0.5), mi.Color3f(0)
            records.direction(vertex_at(depth), sample, 1.0, L, mi.Bool(True))
        records.end(mi.Color3f(mi.Float(brought)))
    records.finish()
    floor = 0.01 * brought.mean() ** 2
    importance = records.importance.numpy().reshape(2, 2, width, width, count)
    for columns, mean in ((slice(0, 11), 1.0), (slice(21, width), 4.0)):
        np.testing.assert_allclose(importance[..., columns, :], 1 / (mean**2 + floor), rtol=1e-4)
    _, error = pixels.importance(mi.UInt32(pixel), mi.Float(brought))
    assert records.variance == pytest.approx(2 * error.numpy().sum(), rel=1e-4)
    error = error.numpy().reshape(width, width, count)
    np.testing.assert_allclose(error[:, :11], 0.25 / (1 + floor), rtol=1e-4)



def test_regions_have_the_least_of_places() -> None:
    p = np.array([[0.1, 0.9], [0.1, 0.9], [0.1, 0.9]]).repeat([8, 7], axis=1)
    up = np.tile([[0], [0], [1]], 15)
    assert SurfaceRegions(mi.Point3f(p), mi.Normal3f(up), 8).count == 5
    assert SurfaceRegions(mi.Point3f(p), mi.Normal3f(up), 7).count == 9
