"""The records of path guiding, and the regions and tiles whose trees learn from them."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.pixel_estimates import PixelEstimates
from mitsuba_ext.techniques.guided_directions.cells import cell_code
from mitsuba_ext.techniques.guided_directions.path_records import PathRecords
from mitsuba_ext.techniques.guided_directions.sample_trees import LEAF, SampleTrees
from mitsuba_ext.techniques.guided_directions.surface_regions import SurfaceRegions
from mitsuba_ext.techniques.guided_directions.tile_regions import TileRegions
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.observer import Observer
from mitsuba_ext.transport.walk import Walk
from tests.support.maps import vertex_at
from tests.support.stage import diffuse, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")


# ---- Records ----


def _pass(records: PathRecords, bounces: list[int], samples: np.ndarray) -> None:
    """Paths that end after ``bounces``. Each brings 10 before the first bounce, then 1, 2, 3, …"""
    lanes = len(bounces)
    records.begin(lanes, dr.arange(mi.UInt32, lanes))
    for depth in range(max(bounces)):
        L = mi.Color3f(10.0 + depth * (depth + 1) / 2)
        active = mi.Bool([depth < count for count in bounces])
        sample = mi.Point2f(samples[depth])
        records.direction(vertex_at(depth), sample, 2.0 + depth, L, active)
    brought = [10.0 + count * (count + 1) / 2 for count in bounces]
    records.end(mi.Color3f(mi.Float(brought)))


def _recorded(stride: int = 1, passes: int = 1) -> tuple[PathRecords, np.ndarray, list[int]]:
    bounces = [4, 0, 2, 1, 3, 4, 0]
    samples = np.random.default_rng(3).random((4, 2, len(bounces)), dtype=np.float32)
    records = PathRecords(lambda si, pixel, active: 100 + pixel, 3, stride, PixelEstimates(4, 4))
    for _ in range(passes):
        _pass(records, bounces, samples)
    records.finish()
    return records, samples, bounces


def test_records_hold_the_light_of_paths_after_each_bounce() -> None:
    records, samples, bounces = _recorded()
    expected = [
        (depth, lane, sum(range(depth + 1, bounces[lane] + 1)), 2.0 + depth)
        for depth in range(3)
        for lane in range(len(bounces))
        if depth < bounces[lane]
    ]
    depth, lane, value, weight = map(np.array, zip(*expected))
    assert records.count == len(expected) and records.paths == len(bounces)
    np.testing.assert_array_equal(records.bounce.numpy(), depth)
    np.testing.assert_array_equal(records.region.numpy(), 100 + lane)
    np.testing.assert_allclose(records.value.numpy(), value, rtol=1e-6)
    np.testing.assert_array_equal(records.weight.numpy(), weight)
    code = np.array([cell_code(mi.Point2f(sample)).numpy() for sample in samples])
    np.testing.assert_array_equal(records.code.numpy(), code[depth, lane])
    # The earlier cells, the last one in the low byte
    cells = code[0, lane], code[0, lane] << 8 | code[1, lane]
    history = np.select([depth == 1, depth == 2], cells)
    np.testing.assert_array_equal(records.history.numpy(), history)


def test_one_path_in_a_stride_is_recorded_in_each_pass() -> None:
    records, _, bounces = _recorded(stride=3, passes=2)
    assert records.paths == 2 * 3
    lanes = [lane for depth in range(3) for lane in (0, 3, 6) if depth < bounces[lane]]
    np.testing.assert_array_equal(records.region.numpy(), 100 + np.array(2 * lanes))
    assert records.first_new == 0
    records.restart_counting()
    assert (records.first_new, records.paths, records.variance) == (records.count, 0, 0)


def test_a_stage_without_a_path_that_scatters_has_no_records() -> None:
    records = PathRecords(lambda si, pixel, active: pixel, 2, 5, PixelEstimates(4, 4))
    records.begin(3, dr.arange(mi.UInt32, 3))
    records.direction(vertex_at(0), mi.Point2f(0.5), 1.0, mi.Color3f(0), mi.Bool(False))
    records.end(mi.Color3f(1))
    records.finish()
    assert (records.count, records.paths) == (0, 1)


def test_the_brightest_path_counts_no_more_than_the_next() -> None:
    records, _, _ = _recorded()
    records.importance = mi.Float(1 + np.arange(records.count))
    square, variances = records.squares(records.value)
    whole = (dr.square(records.value) * records.importance).numpy()
    *_, next_brightest, brightest = np.sort(whole[records.bounce.numpy() == 0])
    assert brightest > next_brightest
    np.testing.assert_allclose(square.numpy(), np.minimum(whole, next_brightest), rtol=1e-6)
    left_out = records.variance - variances.sum()
    assert left_out == pytest.approx(brightest - next_brightest, rel=1e-4)


def test_infinite_radiance_decides_nothing() -> None:
    records = PathRecords(lambda si, pixel, active: pixel, 1, 1, PixelEstimates(4, 4))
    records.begin(4, dr.arange(mi.UInt32, 4))
    sample = mi.Point2f([0.1, 0.2, 0.3, 0.4], 0.5)
    records.direction(vertex_at(0), sample, 1.0, mi.Color3f(1), mi.Bool(True))
    records.end(mi.Color3f(mi.Float(2, np.inf, np.nan, 3)))
    records.finish()
    np.testing.assert_array_equal(records.value.numpy(), [1, 0, 0, 2])
    assert np.isfinite(records.importance.numpy()).all() and np.isfinite(records.variance)


def test_records_of_a_walk_are_the_radiance_of_longer_paths() -> None:
    """A point light in a closed room: what a path has brought before it takes its n-th direction is
    the radiance of the same path, cut there."""
    T = mi.ScalarTransform4f
    room = {"type": "cube", "to_world": T().translate([0, 0, 1]).scale(5), "flip_normals": True}
    lamp = {"type": "point", "position": [0.8, -1, 1.5], "intensity": {"type": "rgb", "value": 3}}
    scene = mi.load_dict(stage(light=lamp, wall=None, room={**room, "bsdf": diffuse(0.8)}))
    lanes, bounces = 256, 3

    def radiance(max_depth: int, observer: PathRecords | None = None) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(5, lanes)
        ray, _ = mi.load_dict(sensor()).sample_ray(0, 0, sampler.next_2d(), mi.Point2f(0.5))
        observer, pixel = observer or Observer(), dr.arange(mi.UInt32, lanes)
        observer.begin(lanes, pixel)
        walk = Walk(max_depth, rr_depth=100, observer=observer)
        sample = walk(scene, sampler, CameraRays(ray, pixel), mi.Bool(True))
        dr.eval(sample.L)
        return sample.L.numpy().mean(axis=0)

    pixels = PixelEstimates(16, 16)
    records = PathRecords(lambda si, pixel, active: mi.UInt32(7), bounces, 2, pixels)
    whole = radiance(6, records)
    records.finish()
    assert records.count == bounces * lanes // 2 and (records.region == mi.UInt32(7)).numpy().all()
    np.testing.assert_allclose(records.weight.numpy(), 1)
    for bounce in range(bounces):
        value = records.value.numpy()[records.bounce.numpy() == bounce]
        expected = (whole - radiance(bounce + 2))[::2]
        assert expected.mean() > 0
        np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-6)


# ---- Regions of surfaces ----

#: Pointers do not keep what they point to alive.
_shapes: list[mi.Shape] = []


def _points(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points on a floor and on a wall, many of them in one corner, and normals towards the room."""
    random = np.random.default_rng(seed)
    p = random.random((3, count)) ** 3
    n = np.zeros((3, count))
    on_wall = random.random(count) < 0.3
    p[2, ~on_wall], n[2, ~on_wall] = 0, 1
    p[0, on_wall], n[0, on_wall] = 1, -1
    return p.astype(np.float32), n.astype(np.float32)


def _interaction(
    p: np.ndarray, n: np.ndarray, side: float = 1.0, bsdf: str = "diffuse"
) -> mi.SurfaceInteraction3f:
    """Points that are seen from the normals' side, or from the other."""
    si = dr.zeros(mi.SurfaceInteraction3f, p.shape[1])
    si.p, si.n = mi.Point3f(p), mi.Normal3f(n)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(0, 0, side)
    _shapes.append(mi.load_dict({"type": "sphere", "bsdf": {"type": bsdf}}))
    si.shape = mi.ShapePtr(_shapes[-1])
    return si


LEAST = 32


@pytest.fixture
def surfaces() -> SurfaceRegions:
    p, n = _points(20_000)
    return SurfaceRegions(mi.Point3f(p), mi.Normal3f(n), LEAST)


def _labels(regions: SurfaceRegions, *where, active: bool = True) -> np.ndarray:
    return regions.label(_interaction(*where), None, mi.Bool(active)).numpy()


def test_every_point_has_a_region_and_unknown_points_have_the_region_of_everything(
    surfaces: SurfaceRegions,
) -> None:
    p, n = _points(20_000)
    labels = _labels(surfaces, p, n)
    assert 50 < surfaces.count == labels.max() + 1
    assert (labels > 0).mean() > 0.98
    # A fresh sample of the same places, from both sides, at rounding distance, and far away
    p, n = _points(5_000, seed=2)
    assert _labels(surfaces, p, n).max() < surfaces.count
    assert (_labels(surfaces, p, -n) == _labels(surfaces, p, n, -1.0)).all()
    assert (_labels(surfaces, p, -n) == 0).all(), "the other sides have not been seen"
    assert not _labels(surfaces, p + 10, n).any() and not _labels(surfaces, -1e30 - p, n).any()
    assert not _labels(surfaces, np.full_like(p, np.inf), n).any()
    assert not _labels(surfaces, p, n, active=False).any()
    state = surfaces.begin(None)
    tree = surfaces.tree(state, _interaction(p, n), mi.Bool(True)).numpy()
    assert (tree == _labels(surfaces, p, n)).all()


def test_mirrors_and_glass_neither_learn_nor_are_guided(surfaces: SurfaceRegions) -> None:
    """Their directions do not depend on the sample."""
    p, n = _points(20_000)
    region = mi.UInt32(_labels(surfaces, p, n))
    specular = [_labels(surfaces, p, n, 1.0, b) for b in ("conductor", "dielectric")]
    assert all((label == surfaces.count).all() for label in specular)
    assert (_labels(surfaces, p, n, 1.0, "plastic") == region.numpy()).all()
    u = mi.Point2f(np.random.default_rng(4).random((2, 20_000), dtype=np.float32))
    ones, spot = dr.full(mi.Float, 1, 20_000), dr.select(u.x < 0.25, mi.Float(9), 1)
    for label, is_guided in ((region, True), (mi.UInt32(specular[0]), False)):
        samples = SimpleNamespace(code=cell_code(u), value=spot, weight=ones, region=label)
        nodes, roots, _ = surfaces.build(samples)
        probability = dr.gather(mi.Float, nodes.probability, roots).numpy()
        assert probability[-1] == LEAF and (probability[:-1] != LEAF).any() == is_guided


def _around(surfaces: SurfaceRegions, level: int) -> np.ndarray:
    """For each region, the region of a level in which it lies; itself if there is none."""
    around = np.arange(surfaces.count + 1)
    for smaller in surfaces.regions.levels[level + 1 :]:
        around[smaller] = around[surfaces.regions.parent[smaller]]
    return around


def test_larger_regions_contain_the_smaller_ones(surfaces: SurfaceRegions) -> None:
    p, n = _points(20_000)
    labels, side = _labels(surfaces, p, n), np.where(n[2] > 0, 1, -1)
    extents, inside = [], []
    for level in range(len(surfaces.regions.levels)):
        around, regions = _around(surfaces, level)[labels], surfaces.regions.levels[level]
        members = [around == region for region in range(regions.start, regions.stop)]
        assert all(LEAST <= chosen.sum() for chosen in members)
        extents.append(max(np.ptp(p[:, chosen], axis=1).max() for chosen in members))
        inside.append(np.mean((around >= regions.start) & (around < regions.stop)))
        if level > 0:
            assert all(np.ptp(side[chosen]) == 0 for chosen in members)
            # Each lies in one of the level before
            before = _around(surfaces, level - 1)[labels]
            assert all(len(set(before[chosen])) == 1 for chosen in members)
    assert inside[0] == 1 and (np.diff(inside) <= 0).all() and inside[-1] < inside[1]
    expected = 1.05 / np.array([1, 4, 8, 16, 32])
    assert (extents <= expected + 1e-3).all(), extents


def test_a_region_without_samples_has_the_density_of_the_one_around_it(
    surfaces: SurfaceRegions,
) -> None:
    """Paths are recorded in a quarter of the places only."""
    p, n = _points(20_000)
    p, n = p[:, p[1] < 0.2], n[:, p[1] < 0.2]
    random = np.random.default_rng(4)
    u = mi.Point2f(random.random((2, p.shape[1]), dtype=np.float32))
    ones = dr.full(mi.Float, 1, p.shape[1])
    region = surfaces.label(_interaction(p, n), None, mi.Bool(True))
    value = dr.select((u.x < 0.25) & (u.y > 0.5), mi.Float(9), 1)
    nodes, roots, below = surfaces.build(
        SimpleNamespace(code=cell_code(u), value=value, weight=ones, region=region)
    )
    assert below is None and len(roots) == surfaces.count + 1
    assert roots.numpy().max() < nodes.count
    share = dr.full(mi.Float, 0.6, len(roots))
    trees = SampleTrees(nodes.probability, nodes.child, nodes.is_even, roots, share)
    # Of a region and all smaller ones in it
    count = np.bincount(region.numpy(), minlength=surfaces.count)
    for smaller in reversed(range(1, surfaces.count)):
        count[surfaces.regions.parent[smaller]] += count[smaller]
    empty = np.flatnonzero(count == 0)
    assert len(empty) > 10
    place = mi.Point2f(0.2, 0.6)
    for tree in empty[:: len(empty) // 10]:
        found, around = (
            trees.density(mi.UInt32(int(t)), place, mi.Bool(True))[0].numpy()[0]
            for t in (tree, surfaces.regions.parent[tree])
        )
        assert found == around
    assert trees.density(mi.UInt32(0), place, mi.Bool(True))[0].numpy()[0] > 1.5


# ---- Tiles of the film ----


@pytest.mark.parametrize(
    ("width", "height", "tile"), [(37, 23, 8), (16, 16, 16), (7, 5, 100), (6, 4, 1), (1, 1, 4)]
)
def test_pixels_are_in_their_tiles(width: int, height: int, tile: int) -> None:
    regions = TileRegions(width, height, tile)
    pixel = np.arange(width * height)
    expected = pixel // width // tile * -(-width // tile) + pixel % width // tile
    for found in (regions.begin(mi.UInt32(pixel)), regions.label(None, mi.UInt32(pixel), True)):
        np.testing.assert_array_equal(found.numpy(), expected)
    assert regions.count == expected.max() + 1


def _tile_trees(width: int, height: int, tile: int) -> tuple[TileRegions, SampleTrees]:
    """Trees of paths whose second sample must lie on the side of the first one. Only the left half
    of the film gets light, and small numbers bring more of it."""
    count = 1 << 16
    random = np.random.default_rng(5)
    regions = TileRegions(width, height, tile)
    u = random.random((2, 2, count), dtype=np.float32)
    pixel = random.integers(width * height, size=count)
    same_side = (u[0, 0] < 0.5) == (u[1, 0] < 0.5)
    brought = np.where(same_side, 4.0, 0.1) * np.where(u[0, 0] < 0.5, 3, 1)
    brought *= pixel % width < width // 2
    first, second = (cell_code(mi.Point2f(sample)) for sample in u)
    zero = dr.zeros(mi.UInt32, count)
    label = regions.label(None, mi.UInt32(pixel), mi.Bool(True))

    def twice(a, b) -> mi.UInt32:
        return mi.UInt32(np.concatenate([a.numpy(), b.numpy()]))

    records = SimpleNamespace(
        bounces=2, region=twice(label, label), code=twice(first, second),
        history=twice(zero, first), bounce=twice(zero, zero + 1),
        value=mi.Float(np.tile(brought, 2)), weight=dr.full(mi.Float, 1, 2 * count),
    )  # fmt: skip
    nodes, roots, below = regions.build(records)
    assert len(below) == nodes.count and below.numpy().max() < len(roots)
    share = dr.full(mi.Float, 0.8, len(roots))
    return regions, SampleTrees(
        nodes.probability, nodes.child, nodes.is_even, roots, share, below
    )


@pytest.mark.parametrize("tile", [4, 5, 64])
def test_the_first_sample_of_a_path_decides_about_the_tree_of_the_second(tile: int) -> None:
    width, height, lanes = 16, 8, 1 << 14
    regions, trees = _tile_trees(width, height, tile)
    active, random = mi.Bool(True), np.random.default_rng(6)
    pixel = random.integers(width // 4, size=lanes) + width * random.integers(height, size=lanes)
    state = regions.begin(mi.UInt32(pixel))
    sides = []
    for _ in range(2):
        u = mi.Point2f(random.random((2, lanes), dtype=np.float32))
        tree = regions.tree(state, None, active)
        sample, density, leaf = trees.sample(tree, u, active)
        np.testing.assert_allclose(trees.density(tree, sample, active)[0], density, rtol=1e-4)
        state = regions.after(state, trees, leaf, active)
        sides.append(sample.x.numpy() < 0.5)
    assert sides[0].mean() == pytest.approx(0.2 / 2 + 0.8 * 0.75, abs=0.04)
    assert (sides[0] == sides[1]).mean() > 0.82
    # What is not guided any more keeps its tree
    assert (regions.after(state, trees, leaf, mi.Bool(False)) == state).numpy().all()


def test_a_tile_that_found_nothing_expects_the_light_of_its_surroundings() -> None:
    regions, trees = _tile_trees(16, 8, 4)
    tile = regions.begin(mi.UInt32([15]))
    assert trees.density(tile, mi.Point2f(0.2, 0.5), mi.Bool(True))[0].numpy()[0] > 1.1


def _one_tile(u: np.ndarray, value: np.ndarray, goes_on: list[np.ndarray]) -> tuple:
    """The trees of one tile from paths of the samples ``u`` [bounces, 2, paths]; which of them went
    on after each bounce; and a walk down the trees by the x of the samples."""
    codes = [cell_code(mi.Point2f(sample)).numpy() for sample in u]
    columns, history = [], np.zeros_like(codes[0])
    recorded = np.full(len(value), True)
    for bounce, code in enumerate(codes):
        columns.append([x[recorded] for x in (code, history, np.full_like(code, bounce), value)])
        history = history << 8 | code
        recorded = recorded & goes_on[bounce]
    code, history, bounce, value = (np.concatenate(x) for x in zip(*columns))
    records = SimpleNamespace(
        bounces=len(u), region=dr.zeros(mi.UInt32, len(code)), code=mi.UInt32(code),
        history=mi.UInt32(history), bounce=mi.UInt32(bounce), value=mi.Float(value),
        weight=dr.full(mi.Float, 1, len(code)),
    )  # fmt: skip
    regions, active = TileRegions(1, 1, 1), mi.Bool(True)
    nodes, roots, below = regions.build(records)
    arrays = nodes.probability, nodes.child, nodes.is_even, roots
    trees = SampleTrees(*arrays, dr.full(mi.Float, 0.8, len(roots)), below)

    def after(*samples: float) -> tuple[int, float]:
        """The tree after samples with these x, and its density on the left."""
        state = regions.begin(mi.UInt32([0]))
        for x in samples:
            leaf = trees.density(state, mi.Point2f(x, 0.1), active)[1]
            state = regions.after(state, trees, leaf, active)
        return state.numpy()[0], trees.density(state, mi.Point2f(0.2, 0.1), active)[0].numpy()[0]

    return regions, after


def test_a_tree_below_a_rare_leaf_expects_the_light_of_its_tile() -> None:
    """First samples with large numbers are two of 4,000."""
    u = np.random.default_rng(7).random((2, 2, 4000), dtype=np.float32)
    u[0, 0] *= 0.5
    u[0, 0, :2] += 0.5
    everywhere = np.full(4000, True)
    _, after = _one_tile(u, np.where(u[1, 0] < 0.25, 4.0, 0.1), [everywhere] * 2)
    (left, density), (right, of_right) = after(0.2), after(0.8)
    assert left != right and min(density, of_right) > 1.5


def test_below_a_leaf_that_no_path_reached_nothing_is_guided() -> None:
    u = np.random.default_rng(8).random((3, 2, 4000), dtype=np.float32)
    value = np.where(u[:2, 0] < 0.5, 4.0, 0.1).prod(axis=0)
    regions, after = _one_tile(u, value, [u[0, 0] < 0.5, u[1, 0] < 0.5, u[0, 0] < 2])
    assert after(0.8) == after(0.2, 0.8) == (regions.count, 1)
    assert after(0.2)[1] > 1.5 and after(0.2, 0.2)[0] > regions.count


def test_the_third_sample_remembers_the_first() -> None:
    u = np.random.default_rng(9).random((3, 2, 20_000), dtype=np.float32)
    value = np.where((u[0, 0] < 0.5) == (u[2, 0] < 0.5), 4.0, 0.1)
    value *= np.where(u[:2, 0] < 0.5, 2.0, 1.0).prod(axis=0)
    _, after = _one_tile(u, value, [u[0, 0] < 2] * 3)
    for second in (0.2, 0.8):
        assert after(0.2, second)[1] > 1.5 and after(0.8, second)[1] < 0.5
