"""Light maps: the places where paths scatter, the counts, the weights from them, and files."""

from __future__ import annotations

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lights.choice import Choice
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.lights.shutter_times import ShutterTimes
from mitsuba_ext.scene.regions.surface_voxels import RowCounts, SurfaceRows, region
from mitsuba_ext.techniques.learned_lights.light_map import LightMap
from mitsuba_ext.techniques.learned_lights.shadow_roulette import LightMapRoulette
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.light_table import LightTable
from mitsuba_ext.transport.observer import Scout
from mitsuba_ext.transport.rejection_law import RejectionLaw
from tests.support.maps import (
    connect,
    floor,
    lamp,
    learner_of,
    map_of,
    observe,
    row_of,
    surface,
    vertex_at,
    vertices,
)
from tests.support.statistical import assert_same_mean

pytestmark = pytest.mark.usefixtures("variant")


# ---- Where paths scatter ----


def _scout(scene: mi.Scene, lanes: int = 4096) -> Scout:
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 4})
    scout = Scout()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, lanes)
    ray = scene.sensors()[0].sample_ray(0, 0.5, sampler.next_2d(), sampler.next_2d())[0]
    scout.begin(lanes)
    walk = integrator.walk(observer=scout)
    dr.eval(walk(scene, sampler, CameraRays(ray), mi.Bool(True)).L)
    return scout


def test_a_scout_finds_surfaces_on_the_side_that_is_seen():
    """In a closed box, seen from inside."""
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "box": {
        "type": "cube", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}})
    p, n = _scout(scene).vertices()
    assert dr.width(p) > 2 * 4096
    assert bool(dr.all(dr.abs(dr.dot(n, p) + 1) < 1e-4))


def test_a_scout_in_an_empty_scene_finds_nothing():
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"},
                          "sky": {"type": "constant"}})
    assert dr.width(_scout(scene).vertices()[0]) == 0


def test_a_few_distant_points_do_not_widen_the_region():
    p, _n = vertices(10_000)
    p = p.numpy()
    p[:, :5] = 1e6
    box = region(mi.Point3f(p))
    assert np.all(np.array(box.max) < 1.2) and np.all(np.array(box.min) > -1.2)
    assert box.max.z > box.min.z, "a flat region has some depth"


@pytest.mark.parametrize("scale, offset", [(1, 0), (1e-3, 0), (1e4, 0), (1, 1e3)])
@pytest.mark.parametrize("grid", [1, 5, 64])
def test_vertices_are_found_in_their_rows(scale, offset, grid):
    p, n = vertices()
    p = scale * p + offset * scale
    rows = SurfaceRows(region(p), grid, p, n)
    assert RowCounts(rows.bbox, p, n)(grid) == pytest.approx(rows.count, rel=0.02, abs=2)
    si = surface(rows.p, rows.n, dr.width(rows.p))
    row = rows.row(si, mi.Bool(True)).numpy()
    assert (row < rows.count - 1).mean() > 0.99
    expected = np.repeat(np.arange(rows.count - 1), rows.size.numpy())
    assert (row == expected).mean() > 0.99
    # Other places, and the other side, share the last row
    below = surface((0.5 * scale + offset * scale, offset * scale, offset * scale), (0, 0, -1))
    below.wi = mi.Vector3f(0, 0, 1)
    far = surface((99 * scale, 0, 0))
    assert int(rows.row(below, mi.Bool(True))[0]) == int(rows.row(far, mi.Bool(True))[0])
    assert int(rows.row(far, mi.Bool(True))[0]) == rows.count - 1


# ---- What is made of the counts ----


def test_visibility_and_contribution_follow_the_counts():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    unoccluded = row_of(light_map, light_map.unoccluded)
    observe(light_map, 0, 0, 1000, 0.0)
    observe(light_map, 1, 500, 500, 0.5 * unoccluded[1])
    visibility = row_of(light_map, light_map.visibility())
    assert visibility == pytest.approx([0, 0.5], abs=0.01)
    by_visibility = row_of(light_map, light_map.weights("visibility"))
    assert by_visibility == pytest.approx(unoccluded * visibility)
    by_contribution = row_of(light_map, light_map.weights("contribution"))
    # The root of the mean square: half of the tests brought half of what was expected
    assert by_contribution[1] == pytest.approx(unoccluded[1] * np.sqrt(0.5 * 0.25), rel=0.02)
    assert by_contribution[0] < 0.05 * by_contribution[1]


def test_surroundings_decide_where_nothing_was_tested():
    """A cell that its neighbours never saw is not expected to be seen."""
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    observe(light_map, 0, 0, 50, 0.0)
    observe(light_map, 1, 50, 0, 1.0)
    visibility = light_map.visibility().numpy().reshape(-1, 2)
    assert (visibility[:-1, 0] < 0.1).all() and (visibility[:-1, 1] > 0.9).all()


def test_an_untested_light_has_the_visibility_of_other_regions():
    """One lamp arrives and brings nothing, such as one that is not optimized."""
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    unoccluded = row_of(light_map, light_map.unoccluded)
    observe(light_map, 0, 500, 0, 0.0)
    observe(light_map, 1, 500, 0, unoccluded[1])
    ratio = light_map.weights("contribution") / light_map.unoccluded
    ratio = ratio.numpy().reshape(-1, 2)[:-1]
    assert (ratio[:, 0] < 0.2 * ratio[:, 1]).all()


def test_a_map_without_a_test_expects_the_unoccluded():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1, radiance=3.0)))
    unoccluded = light_map.unoccluded.numpy().reshape(-1, 2)
    for target in ("visibility", "contribution"):
        weights = light_map.weights(target).numpy().reshape(-1, 2)
        share = weights / weights.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(share, unoccluded / unoccluded.sum(axis=1, keepdims=True), 1e-4)


def test_one_bright_sample_does_not_decide():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    observe(light_map, 1, 100, 0, 0.3)
    before = row_of(light_map, light_map.weights("contribution"))[0]
    observe(light_map, 0, 99, 0, 0.3)
    observe(light_map, 0, 1, 0, 1e30)
    after = row_of(light_map, light_map.weights("contribution"))[0]
    assert np.isfinite(after) and after < 10 * max(before, 0.3)


def test_the_predicted_squares_follow_from_the_counts():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    unoccluded = row_of(light_map, light_map.unoccluded)
    observe(light_map, 0, 20_000, 0, unoccluded[0])
    observe(light_map, 1, 10_000, 10_000, 0.5 * unoccluded[1])
    square = np.array([1, 0.125]) * np.square(unoccluded)
    equal, other = np.array([0.5, 0.5]), np.array([0.8, 0.2])
    expected = (square / other).sum() / (square / equal).sum()
    tiled = [mi.Float(np.tile(p, light_map.rows.count)) for p in (equal, other)]
    predicted = row_of_rows(light_map, light_map.square_ratios(*tiled))
    assert predicted == pytest.approx(expected, rel=5e-3)
    assert row_of_rows(light_map, light_map.square_ratios(*tiled[:1] * 2)) == 1


def row_of_rows(light_map: LightMap, values: mi.Float) -> float:
    row = int(light_map.rows.row(surface((0.1, 0.1, 0)), mi.Bool(True))[0])
    return float(values[row])


def test_a_part_of_a_large_pilot_is_recorded():
    scene = floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1))
    p, n = vertices()
    rows = SurfaceRows(region(p), 1, p, n)
    lanes = 1 << 16
    recorded = []
    for samples in (0, 100, 10_000):
        light_map = LightMap(scene, rows, LightCells(scene, None), samples)
        light_map.begin(lanes)
        choice = Choice(mi.UInt32(0), mi.UInt32(0), mi.Float(0.5))
        si = surface((0.1, 0.1, 0), width=lanes)
        light_map.connection(
            choice, vertex_at(0, si), None, mi.Color3f(0.1), None, None, mi.Bool(True),
            mi.Bool(True),
        )  # fmt: skip
        light_map.evaluate()
        assert bool(dr.all(light_map.tests == light_map.successes))
        assert int(light_map.squares[0]) / int(light_map.tests[0]) > 0
        recorded.append(int(light_map.tests[0]))
    # Four entries want 128 tests; there are two for each sample
    assert recorded == [lanes, lanes, pytest.approx(lanes / 156, rel=0.05)]


def test_the_roulette_reads_the_chosen_cell():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    observe(light_map, 0, 0, 1000, 0.0)
    observe(light_map, 1, 1000, 0, 1.0)
    si = surface((0.1, 0.1, 0))
    row = light_map.rows.row(si, mi.Bool(True))
    for law, blocked in (("affine", 0.01), ("paper", 1e-4)):
        roulette = LightMapRoulette(light_map, RejectionLaw(law, 10, 0.005))
        choices = [Choice(row, mi.UInt32(cell), None) for cell in (0, 1)]
        p = [float(roulette.probability((), c, si, None, True)[0][0]) for c in choices]
        assert p[1] == 1 and p[0] == pytest.approx(blocked, abs=0.02)
    assert roulette.rejected_share == pytest.approx(0.5, abs=0.01)


def test_probabilities_of_a_selection_follow_its_weights_and_no_light_is_lost():
    scene = floor(**{f"lamp_{i}": lamp(i / 40 - 1, 0, 1, size=0.01) for i in range(80)})
    light_map = map_of(scene, grid=1)
    rng = np.random.default_rng(1)
    weights = rng.uniform(0, 1, light_map.rows.count * 80).astype(np.float32) ** 8
    selection = LightTable(light_map.rows, light_map.cells, mi.Float(weights))
    sampler = mi.load_dict({"type": "independent"})
    lanes = 1 << 18
    sampler.seed(0, lanes)
    si = surface((0.1, 0.1, 0), width=lanes)
    _ds, _weight, choice, _state = connect(selection, scene, sampler, si)
    row = weights.reshape(-1, 80)[int(choice.row[0])].astype(np.float64)
    expected = row / row.sum()
    counts = np.bincount(choice.cell.numpy(), minlength=80)
    error = np.sqrt(expected * (1 - expected) / lanes) + 2 / lanes
    assert (np.abs(counts / lanes - expected) < 5 * error).all()
    np.testing.assert_allclose(
        choice.probability.numpy(), expected[choice.cell.numpy()], rtol=1e-2, atol=1e-7
    )


# ---- In a render ----


def test_the_grid_follows_the_number_of_samples_and_the_memory():
    scene = floor(**{f"lamp_{i}": lamp(i / 10 - 1, 0, 1, size=0.01) for i in range(20)})

    def entries(**parameters) -> int:
        return len(learner_of(scene, **parameters).map.tests)

    assert entries(pilot_samples=100) < entries(pilot_samples=100_000)
    assert entries(grid=64, max_memory=2**22) * 128 <= 2**22
    assert entries(grid=64) > entries(grid=8)


def test_voxels_of_a_selection_without_learning_fit_into_the_memory():
    scene = floor()
    times = ShutterTimes(scene, mi.load_dict({"type": "perspective"}))

    def rows(**parameters) -> int:
        integrator = mi.load_dict(
            {"type": "neepp", "light_sampling": "spatial", **parameters}
        )
        return integrator.slots["next_event"].voxel_rows(scene, 80, times).count

    assert 1 < rows(max_memory=0.5) <= 2**19 / 40 / 80 < rows()
    assert rows(grid=1) == 2


def _two_rooms() -> mi.Scene:
    """A wall hides most lamps from the camera."""
    T = mi.ScalarTransform4f
    wall = T().rotate([0, 1, 0], 90).scale([2, 2, 1])
    lamps = {f"near_{i}": lamp(-0.5, i - 0.5, 0.7, radiance=9.0) for i in range(2)}
    lamps |= {f"far_{i}": lamp(0.5, i / 4 - 1, 0.7, radiance=9.0) for i in range(8)}
    return _stage(wall={"type": "rectangle", "to_world": wall}, **lamps)


def test_a_learned_map_serves_another_view_and_lowers_the_variance(tmp_path: Path):
    """Without a pilot, the mean agrees with ``path``."""
    scene = _two_rooms()
    maps, files = [], [tmp_path / f"{run}.npz" for run in range(2)]
    for file in files:
        learn = mi.load_dict(
            {"type": "neepp", "max_depth": 2, "grid": 8, "save_learned": str(file)}
        )
        mi.render(scene, integrator=learn, spp=64, seed=3)
        with np.load(file) as data:
            counters = ("tests", "successes", "squares")
            maps.append([data[f"next_event/{name}"] for name in counters])
    for first, again in zip(*maps):
        # A ray in ten thousand may change its fate with the order in which floats are added
        assert (first == again).mean() > 0.999 and first.sum() == pytest.approx(again.sum(), 1e-3)
    seen, arrived = re.search(
        r"\((\d+) seen, (\d+) with a success\)", learn.statistics.learned
    ).groups()
    assert int(seen) > int(arrived) > 100, "the pilots taught nothing"

    view = mi.ScalarTransform4f().look_at([-0.9, 0.3, 3], [-0.5, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 32, "height": 32}
    sensor = mi.load_dict({"type": "perspective", "fov": 15, "film": film, "to_world": view})
    use, path = (
        mi.load_dict({"max_depth": 2, **integrator})
        for integrator in (
            {"type": "neepp", "grid": 8, "load_learned": str(files[0]), "pilot_spp": 0},
            {"type": "path"},
        )
    )
    images, reference = (
        np.array([integrator.render(scene, sensor, seed=seed, spp=spp) for seed in seeds])
        for integrator, spp, seeds in ((use, 16, range(8)), (path, 64, range(100, 108)))
    )
    assert "light map" in use.statistics.learned and use.statistics.passes == 1
    assert_same_mean(images, reference, precision=0.03)
    ours, theirs = (np.median(x.var(axis=0, ddof=1) / (x.mean(axis=0) ** 2 + 1e-4))
                    for x in (images, reference))  # fmt: skip
    assert ours < 0.4 * 64 / 16 * theirs, (ours, theirs)
    with pytest.raises(ValueError, match='"neepp": .* belongs to another scene'):
        use.render(_stage(a=lamp(0, 0, 9)), spp=4)


def _learned(scene: mi.Scene, **parameters) -> str:
    integrator = mi.load_dict({"type": "neepp", "max_depth": 2, **parameters})
    assert np.isfinite(np.array(mi.render(scene, integrator=integrator, spp=64))).all()
    return integrator.statistics.learned


def _stage(**lights) -> mi.Scene:
    """A floor, seen from above by a small film."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 32, "height": 32}
    view = T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return floor(sensor={"type": "perspective", "to_world": view, "film": film}, **lights)


def test_a_light_tree_is_kept_where_a_map_is_hardly_better(tmp_path: Path):
    scene, file = _two_rooms(), tmp_path / "learned.npz"
    learned = _learned(scene, save_learned=str(file))
    assert learned.startswith("lights: a light tree, about ")
    loads = {"type": "neepp", "load_learned": str(file)}
    loaded, tree = (
        np.array(mi.load_dict({"max_depth": 2, **made}).render(scene, spp=1))
        for made in (loads, {"type": "composed_path", "next_event": "tree"})
    )
    np.testing.assert_array_equal(loaded, tree)


def test_learning_ends_where_it_would_not_pay():
    """Two lamps side by side are chosen well enough by chance."""
    assert "there is only one" in str(learner_of(floor(a=lamp(0, 0, 9, size=0.05))))
    assert "as path" in _learned(_stage(a=lamp(0, 0, 9, size=0.1), b=lamp(0.1, 0, 9, size=0.1)))
    # One is hidden from nearly everything
    different = _stage(a=lamp(0, 0, 9, size=0.1), b=lamp(0, 0, -1, size=0.5))
    assert "as path" not in _learned(different)
