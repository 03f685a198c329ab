"""Learned visibility of an environment: densities are exact, and the mean agrees with ``path``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.rendering.statistics import kernel_cache_misses
from mitsuba_ext.techniques.two_stage_lights.environment_visibility import (
    PrimaryVisibility,
    Tile,
    VisibilityCounts,
)
from mitsuba_ext.techniques.two_stage_lights.learner import VisibilityLearner
from mitsuba_ext.techniques.two_stage_lights.two_stage import TwoStage
from mitsuba_ext.transport.path_decisions import LightNumbers
from mitsuba_ext.util.stored_arrays import StoredArrays
from tests.support.environments import (
    LANES,
    directions_everywhere,
    floor_below,
    floor_vertex,
    random_point,
)
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor
from tests.support.statistical import assert_images_are_sound, assert_same_mean, batches, one_thread

pytestmark = pytest.mark.usefixtures("variant")

#: Film of 3 x 2 tiles.
WIDTH, HEIGHT = 20, 11


def _counts(kind: str, shape: tuple[int, int], tiles: int = 6) -> np.ndarray:
    """Tests and successes of cells: few random ones, none, all light in one cell, none visible."""
    rng, (columns, rows) = np.random.default_rng(7), shape
    tests = rng.integers(0, 30, (tiles, rows, columns)).astype(np.uint64)
    seen = np.minimum(tests, rng.integers(0, 30, tests.shape).astype(np.uint64))
    if kind == "untrained":
        tests, seen = 0 * tests, 0 * seen
    if kind in ("one cell", "nothing visible"):
        tests, seen = 0 * tests + np.uint64(50), 0 * seen
    if kind == "one cell":
        seen[:, rows // 3, columns // 2] = 50
    return (tests | (seen << np.uint64(32))).ravel()


KINDS = ("random", "untrained", "one cell", "nothing visible")


# ---- Cells ----


def test_pixels_lie_in_tiles_and_a_large_film_has_larger_ones() -> None:
    counts = VisibilityCounts(WIDTH, HEIGHT, 16, 16)
    tiles = counts.tiles.tile(dr.arange(mi.UInt32, WIDTH * HEIGHT)).numpy().reshape(HEIGHT, WIDTH)
    assert (counts.tiles.columns, counts.tiles.rows) == (3, 2)
    assert tiles[0, 7] == 0 and tiles[0, 8] == 1 and tiles[8, 0] == 3 and tiles.max() == 5
    large = VisibilityCounts(3840, 2160, 16, 16)
    assert large.tiles.count <= 8192 and large.tiles.edge > 8


def test_visibility_is_a_probability_and_follows_the_counts() -> None:
    counts = VisibilityCounts(WIDTH, HEIGHT, 16, 16)
    for kind in KINDS:
        counts.restore(StoredArrays.of({"counts": _counts(kind, (16, 16))}))
        visibility = counts.visibility().numpy()
        assert visibility.min() > 0 and visibility.max() <= 1
    counts.restore(StoredArrays.of({"counts": _counts("one cell", (16, 16))}))
    visibility = counts.visibility().numpy().reshape(-1, 16, 16)[4]
    assert visibility[5, 8] > 0.9 and np.delete(visibility.ravel(), 5 * 16 + 8).max() < 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_random_numbers_are_distributed_by_their_density(kind: str) -> None:
    """In one tile, chi² over cells is met, the density is found again, and no cell is starved."""
    counts = VisibilityCounts(WIDTH, HEIGHT, 16, 16)
    counts.restore(StoredArrays.of({"counts": _counts(kind, (16, 16))}))
    maps, numbers = PrimaryVisibility(counts, 0.8), mi.PCG32(size=LANES)
    tile, active = Tile(mi.UInt32(4), mi.Bool(True)), mi.Bool(True)
    point, density = maps.sample(tile, random_point(numbers), active)
    x, y = np.mgrid[0:16, 0:16].astype(np.float32)
    centers = mi.Point2f(((x + 0.5) / 16).ravel(), ((y + 0.5) / 16).ravel())
    expected = maps.density(tile, centers, active).numpy().reshape(16, 16)
    assert expected.mean() == pytest.approx(1, rel=1e-5) and expected.min() >= 0.2 - 1e-5
    same = np.isclose(density.numpy(), maps.density(tile, point, active).numpy(), rtol=1e-3)
    assert same.mean() > 0.999  # at edges of cells, rounding decides
    p = point.numpy()
    observed = np.histogram2d(p[0], p[1], bins=np.linspace(0, 1, 17) * np.ones((2, 1)))[0]
    expected *= LANES / 256
    chi2 = ((observed - expected) ** 2 / expected).sum()
    assert p.min() >= 0 and p.max() < 1 and stats.chi2.sf(chi2, 255) > 1e-4
    if kind == "one cell":
        assert density.numpy().max() > 150
    if kind == "untrained":
        assert np.allclose(density.numpy(), 1, rtol=1e-4)


# ---- Directions ----


def _learned(scene: mi.Scene, space: str, kind: str) -> TwoStage:
    learner = VisibilityLearner(space, 8, False, 0.9, WIDTH, HEIGHT)
    shape = (16, 16) if space == "primary" else (32, 16)
    return learner.restore(scene, StoredArrays.of({"counts": _counts(kind, shape)}))


_CASES = [
    ("primary", "turned", "glass", "random"), ("primary", "sky", "metal", "random"),
    ("primary", "turned", "diffuse", "one cell"), ("world", "turned", "glass", "random"),
    ("world", "sun", "metal", "one cell"), ("world", "turned", "diffuse", "untrained"),
    ("primary", "one texel", "metal", "random"), ("world", "one texel", "metal", "random"),
]  # fmt: skip


@pytest.mark.parametrize("space, environment, bsdf, kind", [
    pytest.param(*case, marks=() if case in (_CASES[0], _CASES[3]) else pytest.mark.slow)
    for case in _CASES
])  # fmt: skip
def test_connections_have_the_density_that_mis_asks_for(
    space: str, environment: str, bsdf: str, kind: str
) -> None:
    """It is found again in the direction of each sample, integrates to one, and chi²."""
    scene = floor_below(environment, bsdf)
    decision, si, active = _learned(scene, space, kind), floor_vertex(scene), mi.Bool(True)
    numbers = mi.PCG32(size=LANES)
    pixel = dr.full(mi.UInt32, 9 * WIDTH + 10, LANES)
    place = decision.visit(decision.begin(None, None, pixel), scene, si, active)
    ds, _weight, _ = decision.sample(place, scene, LightNumbers(random_point(numbers)), si, active)
    other, by_area = directions_everywhere(environment, numbers)
    found, pdf = (decision.remember(place, scene, d, mi.Float(1), active).density
                  for d in (ds.d, other))  # fmt: skip
    value = pdf / by_area
    dr.eval(ds.d, ds.pdf, found, other, value)
    d, density, found, other, value = (x.numpy() for x in (ds.d, ds.pdf, found, other, value))
    kept = density > 0
    assert kept.mean() > 0.998 and value.min() > 0
    # At edges of cells, rounding decides
    assert np.mean(np.abs(found[kept] / density[kept] - 1) > 1e-2) < 2e-3
    error = value.std() / np.sqrt(LANES)
    assert error < 0.1 and abs(value.mean() - kept.mean()) < 4.5 * error + 2e-3

    edges = [np.linspace(-np.pi, np.pi, 17), np.linspace(-1, 1, 10)]

    def histogram(d: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        return np.histogram2d(np.arctan2(d[1], d[0]), d[2], edges, weights=weights)[0]

    observed, expected = histogram(d[:, kept]), histogram(other, value)
    spread = expected + histogram(other, value**2) - expected**2 / LANES
    used = (expected > 50) & (histogram(other) > 50)
    chi2 = np.sum((observed - expected)[used] ** 2 / spread[used])
    assert used.sum() > 2 and stats.chi2.sf(chi2, used.sum()) > 1e-4


# ---- A box with a hole ----


def _box(**walls: Any) -> mi.Scene:
    """Open above, where a lid leaves a hole; the camera is inside."""
    T = mi.ScalarTransform4f
    places = {
        "left": T().translate([-1, 0, 0]).rotate([0, 1, 0], 90),
        "right": T().translate([1, 0, 0]).rotate([0, 1, 0], -90),
        "near": T().translate([0, -1, 0]).rotate([1, 0, 0], -90),
        "far": T().translate([0, 1, 0]).rotate([1, 0, 0], 90),
        "floor": T().translate([0, 0, -1]),
        "lid": T().translate([-0.2, 0, 1]).rotate([1, 0, 0], 180).scale([0.8, 1, 1]),
        "other_lid": T().translate([0.8, 0.3, 1]).rotate([1, 0, 0], 180).scale([0.2, 0.7, 1]),
    }
    shapes = {name: rectangle(place, bsdf=diffuse(0.5), **walls) for name, place in places.items()}
    camera = sensor(to_world=lookat([0.3, -0.9, 0.5], [-0.3, 0.4, -1], [0, 0, 1]), fov=15.0,
                    film=film(16, 16))  # fmt: skip
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    return mi.load_dict({"type": "scene", "sky": sky, "sensor": camera, **shapes}, optimize=False)


def _made(visibility: str, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({
        "type": "two_stage", "max_depth": 2, "visibility": visibility, **parameters
    })  # fmt: skip


@pytest.mark.parametrize("space", ["primary", pytest.param("world", marks=pytest.mark.slow)])
def test_a_box_with_a_hole_has_the_mean_of_path_and_less_error(space: str) -> None:
    scene = _box()
    images = batches(scene, _made(space), 64, range(4))
    assert_images_are_sound(images)
    path = batches(scene, mi.load_dict({"type": "path", "max_depth": 2}), 2048, range(1001, 1005))
    assert_same_mean(images, path, 0.02)
    plain = batches(scene, _made("unknown"), 64, range(4))
    assert images.std(axis=0).mean() < 0.6 * plain.std(axis=0).mean()


@pytest.mark.slow
@pytest.mark.parametrize("space", ["primary", "world"])
def test_a_box_in_which_all_is_equally_bright_stays_so(space: str) -> None:
    images = batches(_box(emitter=area(0.5)), _made(space, max_depth=-1, rr_depth=50), 64, range(4))
    error = images.mean(axis=(1, 2, 3)).std(ddof=1) / 2
    assert abs(images.mean() - 1) < 4 * error + 2e-4 and error < 5e-3


@pytest.mark.parametrize("space", ["primary", pytest.param("world", marks=pytest.mark.slow)])
def test_other_maps_need_no_other_kernels(space: str) -> None:
    scene, integrator = _box(), _made(space, pilot_spp=2)
    batches(scene, integrator, 8, [1, 2])
    before = kernel_cache_misses()
    batches(scene, integrator, 8, [3, 4])
    assert kernel_cache_misses() == before


def test_without_pilots_it_is_two_stage() -> None:
    scene = _box()
    plain, same = (batches(scene, _made(v), 2, [1]) for v in ("unknown", "primary"))
    np.testing.assert_allclose(plain, same, rtol=1e-5)


def test_learned_visibility_is_summed_up_over_passes() -> None:
    integrator = _made("primary", pilot_spp=2)
    batches(_box(), integrator, 8, [1])
    assert "2 x 2 tiles of 8 pixels, 16 x 16 cells" in integrator.statistics.learned
    with pytest.raises(RuntimeError, match='"reallocated" needs a "visibility" that is learned'):
        mi.load_dict({"type": "two_stage", "reallocated": 0.5})


@pytest.mark.slow
@pytest.mark.parametrize("space", ["primary", "world"])
def test_restored_maps_equal_the_saved_ones(space: str, tmp_path: Path) -> None:
    """Two renders from the same file are equal bit by bit, and better than without maps."""
    scene, file = _box(), str(tmp_path / "learned.npz")
    batches(scene, _made(space, save_learned=file), 64, [1])
    with one_thread():
        first, second = (
            batches(scene, _made(space, load_learned=file), 8, range(4)) for _ in range(2)
        )
    np.testing.assert_array_equal(first, second)
    plain = batches(scene, _made("unknown"), 8, range(4))
    assert first.std(axis=0).mean() < 0.6 * plain.std(axis=0).mean()
