"""Sample swarming: maps of numbers that tiles of pixels share."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hard_cases import area, diffuse, film, lookat, rectangle, sensor, stage
from statistical import assert_exact, assert_same_pixels_on_average, batches, load, one_thread

from mitsuba_ext.composition import swarm as swarm_parameters
from mitsuba_ext.composition.swarm import doubling_pilots, stage_weights
from mitsuba_ext.decisions.swarm import map_learner
from mitsuba_ext.decisions.swarm.bounce_records import BounceRecords
from mitsuba_ext.decisions.swarm.cells import CellDensities, Cells
from mitsuba_ext.decisions.swarm.estimate import Form, Grid, Shares, estimate
from mitsuba_ext.decisions.swarm.film_tiles import FilmTiles
from mitsuba_ext.decisions.swarm.light_maps import light_cells
from mitsuba_ext.decisions.swarm.lobe_maps import path_density
from mitsuba_ext.decisions.swarm.tile_counts import Choices, TileCounts
from mitsuba_ext.rendering.dither import dithered_parts

pytestmark = pytest.mark.usefixtures("variant")

_BOUNDS = np.array([0, 0.1, 0.1, 0.35, 0.6, 0.61, 1, 1, 1], np.float32)

CELLS = {
    "line": lambda: Cells.line(6),
    "square": lambda: Cells.square(3),
    "uneven": lambda: Cells([0, 0, 0], _BOUNDS),
    "joint": lambda: Cells([0, 0, 0, 1, 2, 1, 2], _BOUNDS),
}

# ---- Densities over cells ----


def _table(kind: str, cells: Cells) -> np.ndarray:
    rng = np.random.default_rng(1)
    mass = {
        "random": rng.random(cells.count),
        "one_hot": np.arange(cells.count) == cells.count // 3,
        "half_empty": rng.random(cells.count) * (rng.random(cells.count) < 0.5),
        "uniform": np.ones(cells.count),
    }[kind] * (cells.widths > 0)
    return np.stack([np.full(cells.count, 1 / cells.count), mass / mass.sum()])


def _maps(cells: Cells, mass: np.ndarray) -> CellDensities:
    return CellDensities(cells, mi.Float(mass.astype(np.float32).ravel()))


@pytest.mark.parametrize("kind", ["random", "one_hot", "half_empty", "uniform"])
@pytest.mark.parametrize("name", CELLS)
def test_samples_have_their_density(name: str, kind: str) -> None:
    cells = CELLS[name]()
    mass = _table(kind, cells)
    maps, count = _maps(cells, mass), 1 << 18
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    u = [sampler.next_1d() for _ in range(cells.dimension)]
    table = dr.full(mi.UInt32, 1, count)
    drawn, pdf, cell = maps.sample(table, u)
    assert all((0 <= x.numpy()).all() and (x.numpy() < 1).all() for x in drawn)
    # Where a number lies is its cell, but for rounding at the edges
    assert (cells.find(drawn).numpy() == cell.numpy()).mean() > 0.999
    np.testing.assert_allclose(maps.density(table, cell).numpy(), pdf.numpy(), rtol=1e-3)
    expected = mass[1] * count
    found = np.bincount(cell.numpy(), minlength=cells.count)
    assert not found[expected == 0].any()
    chi2 = (np.square(found - expected)[expected > 0] / expected[expected > 0]).sum()
    freedom = (expected > 0).sum() - 1
    assert chi2 < freedom + 5 * np.sqrt(2 * freedom) + 1e-6 * count
    # Within a cell, numbers are uniform
    reached = cells.widths[mass[1] > 0].sum()
    np.testing.assert_allclose((1 / pdf.numpy()).mean(), reached, rtol=0.02)


def test_inactive_lanes_keep_their_numbers() -> None:
    maps = _maps(Cells.line(3), _table("one_hot", Cells.line(3)))
    u = mi.Float([0.1, 0.9])
    (drawn,), pdf, _ = maps.sample(mi.UInt32([1, 1]), [u], mi.Bool([False, True]))
    assert drawn.numpy()[0] == u.numpy()[0] and pdf.numpy()[0] == 1


# ---- Estimates ----


def _estimated(
    counts: np.ndarray, widths: np.ndarray | None = None, squares: np.ndarray | None = None
) -> np.ndarray:
    """Of counts by row, column, map and cell; the samples count one each by default."""
    widths = np.full(counts.shape[-1], 1 / counts.shape[-1]) if widths is None else widths
    squares = counts.sum(-1) if squares is None else squares
    arrays = (mi.Float(x.astype(np.float32).ravel()) for x in (counts, squares))
    shares = estimate(*arrays, Grid(*counts.shape[:3]), mi.Float(widths.astype(np.float32)))
    return shares.numpy().reshape(counts.shape)


def test_without_samples_maps_are_uniform() -> None:
    widths = np.array([0.5, 0.25, 0.25, 0])
    shares = _estimated(np.zeros((3, 5, 2, 4)), widths)
    np.testing.assert_allclose(shares, np.broadcast_to(widths, shares.shape), atol=1e-6)
    tables = Shares(mi.Float(shares.ravel()), mi.Float(widths.astype(np.float32)))
    for form in (Form(True, 0.2), Form(False, 0.05)):
        mass = tables.mass(form).numpy().reshape(shares.shape)
        np.testing.assert_allclose(mass, shares, atol=1e-6)
        np.testing.assert_allclose(tables.expected_ratio(form).numpy(), 1, rtol=1e-5)


def test_one_sample_is_not_believed() -> None:
    counts = np.zeros((4, 4, 1, 16))
    counts[1, 2, 0, 5] = 1e9
    shares = _estimated(counts, squares=np.square(counts.sum(-1)))
    np.testing.assert_allclose(shares, 1 / 16, rtol=1e-4)
    # Nor one in each tile, in different places
    tiles = np.arange(16)
    counts.reshape(16, 16)[tiles, (5 * tiles) % 16] = 1e9
    shares = _estimated(counts, squares=np.square(counts.sum(-1)))
    assert shares.max() < 3 / 16 and shares.min() > 0.5 / 16


def _believed(h, p, n, variance, tables):
    """The beta-binomial estimate and its variance at one node, with the ρ of these tables."""
    excess, weight = (n * (h - p) ** 2 / (p * (1 - p)) - 1).sum(), tables * (n - 1)
    chance = np.sqrt(2 * tables)
    rho = np.clip((excess - chance) / weight, 0, 0.5)
    most = np.clip((max(excess, 0) + chance) / weight, 0, 0.5)
    believed = n * rho / (n * rho + 1 - rho)
    left = p + believed * (h - p)
    return left, (1 - believed) ** 2 * variance + left * (1 - left) * most / (n * most + 1)


def test_few_samples_of_a_tile_are_believed_a_little() -> None:
    counts = np.zeros((1, 2, 1, 2))
    counts[0, 0, 0], counts[0, 1, 0] = (12, 0), (4, 8)
    film, variance = _believed(np.array([2 / 3]), 1 / 2, 24, 0, 1)
    left, variance = _believed(np.array([1, 1 / 3]), film, 12, variance, 2)
    a, b = np.sqrt(left**2 + variance), np.sqrt((1 - left) ** 2 + variance)
    np.testing.assert_allclose(_estimated(counts)[0, :, 0, 0], a / (a + b), rtol=1e-4)
    assert (np.abs(a / (a + b) - [1, 1 / 3]) > 0.03).all()


def test_smaller_tiles_go_on_with_what_larger_ones_have_counted() -> None:
    tiles, smaller = FilmTiles(7, 5, 4), FilmTiles(7, 5, 2)
    counts, pixel = TileCounts(tiles, 2, 4), dr.arange(mi.UInt32, 35)
    radiance = mi.Float(pixel % 3)

    def add(cell: int) -> None:
        one = (mi.UInt32(x) for x in (1, cell))
        counts.add(pixel, radiance, Choices(*one, mi.Float(1), radiance, mi.Bool(True)))

    add(1)
    add(3)
    (before, squares), gain = counts.sums(), counts.expected_gain(np.full(8, 0.5))
    before = before.numpy().reshape(2, 2, 2, 4)
    counts.divide(smaller)
    after, squares_after = counts.sums()
    after = after.numpy().reshape(3, 4, 2, 4)
    for row, column in np.ndindex(3, 4):
        np.testing.assert_allclose(after[row, column], before[row // 2, column // 2] / 4, atol=1)
    np.testing.assert_allclose(squares_after.numpy()[1], squares.numpy()[1] / 4, rtol=1e-3)
    assert counts.samples == 70 and after[0, 0, 0].sum() == 0 and gain > 0
    add(3)
    assert counts.sums()[0].numpy().sum() > after.sum()


def test_noise_stays_nearly_uniform() -> None:
    rng = np.random.default_rng(2)
    counts = rng.multinomial(20, np.full(64, 1 / 64), size=(30, 40, 1)).astype(float)
    shares = _estimated(counts)
    assert (1 / (64 * shares)).mean() < 1.005  # the loss of drawing from it


def test_a_window_that_moves_over_the_film_is_found() -> None:
    rng, rows, columns = np.random.default_rng(3), 20, 30
    counts, truth = np.zeros((rows, columns, 1, 64)), np.zeros((rows, columns, 1, 64))
    for column in range(columns):
        begin = 5 + column
        truth[:, column, 0, begin : begin + 8] = 1 / 8
        counts[:, column, 0] = rng.multinomial(4, truth[0, column, 0], size=rows)
    shares = _estimated(counts)
    loss = (truth / (64 * np.maximum(shares, 1e-6) * 0.9 + 0.1)).sum(-1)
    assert loss.mean() < 0.35  # 1 for uniform numbers, 1/8 at best


# ---- Stages ----


@pytest.mark.parametrize("samples", [1, 2, 3, 8, 21, 64])
def test_pilots_double(samples: int) -> None:
    pilots = doubling_pilots(samples)
    assert sum(pilots) == samples and pilots[0] == 1
    assert all(n >= sum(pilots[:i]) for i, n in enumerate(pilots))


@pytest.mark.parametrize("parts", [1, 2, 4])
@pytest.mark.parametrize("spp", [4, 6, 8, 16, 64, 1024])
def test_weights_of_stages_cost_little(spp: int, parts: int) -> None:
    pilots = doubling_pilots(max(1, min(spp // 4, 64)))
    stages = [*pilots, spp - sum(pilots)]
    weights = np.array(stage_weights(stages, parts))
    assert len(weights) == len(stages) + parts - 1
    assert weights[-1] == 1 and (weights > 0).all() and (np.diff(weights) >= 0).all()
    # In each part of the pixels, the first stage has another weight
    sizes = [2.0 ** -(parts - max(1, part)) if parts > 1 else 1 for part in range(parts)]
    loss = 0.0
    for part, size in enumerate(sizes):
        w = np.array([weights[part], *weights[parts:]])
        loss += size * (np.sum(stages) * (stages * w**2).sum() / (stages * w).sum() ** 2 - 1)
    assert sum(sizes) == 1 and loss < 0.0151
    assert stage_weights([5]) == [1]


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("size", [(1, 1), (7, 5), (64, 48)])
def test_parts_of_a_film_are_all_of_it(size: tuple[int, int], count: int) -> None:
    parts = dithered_parts(*size, count)
    pixels = np.sort(np.concatenate(parts))
    np.testing.assert_array_equal(pixels, np.arange(size[0] * size[1]))
    if size == (64, 48):
        assert [len(part) * 2**count for part in parts] == [
            2 * pixels.size * 2 ** max(0, part - 1) for part in range(count)
        ]
        # Spread evenly: each 8 x 8 block has as many of each part
        for part in parts:
            blocks = part // 64 // 8 * 8 + part % 64 // 8
            assert len(set(np.bincount(blocks))) == 1


# ---- Renders ----

_OPTICS = {
    "aperture_radius": 0.1, "focus_distance": 3.0, "shutter_open": 0.25, "shutter_close": 0.75,
}  # fmt: skip


_ALL_ON = {"lobe_map": True, "direction_map": True}


def swarm(**parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "swarm_path", "max_depth": 4, **_ALL_ON, **parameters})


def _furnace() -> mi.Scene:
    """A room whose walls emit what they absorb, with a white thing that turns in it."""
    T = mi.ScalarTransform4f
    turns = {
        "back": ([1, 0, 0], 0), "front": ([1, 0, 0], 180), "floor": ([1, 0, 0], -90),
        "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90), "right": ([0, 1, 0], -90),
    }  # fmt: skip
    wall = {"bsdf": diffuse(0.5), "emitter": area(0.5)}
    walls = {
        name: rectangle(T().rotate(*turn) @ T().translate([0, 0, -2]).scale([2, 2, 1]), **wall)
        for name, turn in turns.items()
    }
    cube = {"type": "cube", "to_world": T().scale(0.35), "bsdf": diffuse(1.0)}
    moving = {"type": "moving", "axis": [1, 2, 0.5], "angle": 200.0, "cube": cube}
    camera = sensor("thinlens", lookat([0, 0, 1.8], [0, 0, 0], [0, 1, 0]), film=film(), **_OPTICS)
    return mi.load_dict({"type": "scene", "sensor": camera, **walls, "thing": moving})


def test_furnace_has_the_exact_radiance() -> None:
    integrator = swarm(always_use=True, max_depth=-1)
    assert_exact(batches(_furnace(), integrator, 128, [1, 2]), 1.0, precision=0.006)
    assert "uniform" not in integrator.statistics.learned


def _streaks(width: int = 24, height: int = 18, **changes: Any) -> mi.Scene:
    """A small bright ball that flies past, out of focus, and a lamp."""
    T = mi.ScalarTransform4f
    ball = {"type": "sphere", "radius": 0.15, "center": [-1, 0, 0.5], "bsdf": diffuse(0.8)}
    moving = {"type": "moving", "translate": [2, 0, 0.4], "ball": ball}
    lamp = rectangle(
        T().translate([0.8, 1.8, 1.2]).rotate([1, 0, 0], 90).scale(0.06), bsdf=diffuse(0.0),
        emitter=area(40.0),
    )  # fmt: skip
    changes = {"film": film(width, height), **_OPTICS, "shutter_open": 0.0, "shutter_close": 1.0,
               "aperture_radius": 0.3, **changes}  # fmt: skip
    camera = sensor("thinlens", **changes)
    return mi.load_dict(stage(camera=camera, moving=moving, lamp=lamp))


@pytest.mark.parametrize("variant", [
    "llvm_ad_rgb", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow),
], indirect=True)  # fmt: skip
def test_mean_is_that_of_uniform_numbers(variant: str) -> None:
    scene = _streaks()
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True), 256, [1, 2])
    tolerance = 9.0 if mi.is_spectral else 0.0
    assert_same_pixels_on_average(images, expected, 0.03, tolerance=tolerance)


def test_maps_lower_the_noise_where_they_promise_to() -> None:
    scene = load("six_balls", width=96, height=54)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 2})
    noise = batches(scene, plain, 32, [1, 2]).var(axis=0).mean()
    integrator = swarm(max_depth=2)
    ours = batches(scene, integrator, 32, [1, 2]).var(axis=0).mean()
    assert ours < 0.6 * noise
    assert "less variance" in integrator.statistics.learned


@pytest.mark.slow
@pytest.mark.parametrize(("adversary", "kind"), [
    ("one_hot", "streaks"), ("random", "streaks"), ("one_hot", "glass"), ("random", "glass"),
])  # fmt: skip
def test_wrong_maps_only_make_noise(monkeypatch, adversary: str, kind: str) -> None:
    """All mass in one cell, or anywhere: the share of uniform numbers keeps the mean right."""

    def wrong(counts, squares, grid, widths):
        shape = (grid.count, len(widths))
        rng = np.random.default_rng(shape[0])
        if adversary == "random":
            mass = rng.random(shape) ** 4 * (widths.numpy() > 0)
        else:
            mass = np.zeros(shape)
            mass[:, shape[1] // 5] = 1
        return mi.Float((mass / mass.sum(-1, keepdims=True)).astype(np.float32).ravel())

    monkeypatch.setattr(map_learner, "estimate", wrong)
    scene, depth = (_streaks(12, 10), 2) if kind == "streaks" else (_glass_and_spots(), 5)
    plain = mi.load_dict({"type": "composed_path", "max_depth": depth})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True, max_depth=depth), 1024, [1, 2])
    assert_same_pixels_on_average(images, expected, 0.08)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_image() -> None:
    integrator = swarm(always_use=True)
    with one_thread():
        a, b, other = batches(_streaks(), integrator, 16, [1, 1, 2])
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - other).mean() > 0.01 * a.mean()


@pytest.mark.parametrize("spp", [1, 3, 4])
def test_few_samples_cost_nothing(spp: int) -> None:
    integrator = swarm()
    mi.render(_streaks(5, 3), integrator=integrator, spp=spp)
    assert (integrator.statistics.learned == "") == (spp < 4)


_CROPPED = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}


def test_each_pixel_has_its_sample_where_the_first_one_is_divided(monkeypatch) -> None:
    monkeypatch.setattr(swarm_parameters, "_LEAST_PIXELS", 1)
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": 0.5},
        "sensor": {**sensor(), "film": {**film(13, 11), **_CROPPED}},
    })  # fmt: skip
    integrator = swarm(always_use=True)
    image = np.array(mi.render(scene, integrator=integrator, spp=8))
    assert image.shape[:2] == (5, 7) and integrator.statistics.passes == 6
    assert integrator.statistics.spp == 8 and integrator.statistics.rays["camera"] == 8 * 35
    np.testing.assert_allclose(image, 0.5, rtol=1e-5)


@pytest.mark.slow
def test_mean_where_the_first_sample_is_divided(monkeypatch) -> None:
    monkeypatch.setattr(swarm_parameters, "_LEAST_PIXELS", 1)
    scene = _streaks(13, 11)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True), 6, range(64))
    error = images.mean(axis=(1, 2, 3)).std(ddof=1) / 8 + expected.mean() * 0.003
    assert abs(images.mean() - expected.mean()) < 4 * error


def test_what_is_learned_can_be_saved(tmp_path) -> None:
    scene, path = _streaks(), str(tmp_path / "maps.npz")
    learning = swarm(always_use=True, save_learned=path)
    first = batches(scene, learning, 64, [1])
    loaded = swarm(always_use=True, load_learned=path)
    again = batches(scene, loaded, 64, [2, 3])
    assert loaded.statistics.passes == 1 and "uniform" not in loaded.statistics.learned
    np.testing.assert_allclose(again.mean(), first.mean(), rtol=0.1)


def test_a_scene_names_it_and_wrong_values_are_named() -> None:
    text = str(swarm(lens_map=False, pilot_spp=8))
    assert "lens_map = False" in text and "pilot_spp = 8" in text and "aperture" not in text
    with pytest.raises((RuntimeError, TypeError), match="time_map"):
        swarm(time_map=3)
    with pytest.raises(RuntimeError, match="wavelength"):
        mi.load_dict({"type": "composed_path", "wavelength": "swarm"})


# ---- Lights, lobes, directions ----


def _glass_and_spots() -> mi.Scene:
    """A ball of glass and a pane before a wall, under a lamp and three spot lights."""
    T = mi.ScalarTransform4f
    glass = {"type": "dielectric", "int_ior": 1.6}
    things = {
        "ball": {"type": "sphere", "center": [0.5, -0.3, 0.5], "radius": 0.3, "bsdf": glass},
        "pane": rectangle(
            T().translate([-0.6, -0.6, 0.6]).rotate([1, 0, 0], 70).scale(0.5),
            bsdf={"type": "thindielectric"},
        ),
        "gloss": {"type": "sphere", "center": [-0.4, 0.5, 0.3], "radius": 0.3,
                  "bsdf": {"type": "roughplastic", "alpha": 0.1}},
    }  # fmt: skip
    for index, x in enumerate((-1.0, 0.0, 1.0)):
        things[f"spot_{index}"] = {
            "type": "spot", "to_world": lookat([x, -1, 1.8], [x / 2, 0, 0], [0, 1, 0]),
            "intensity": 1.0 + index, "cutoff_angle": 25.0,
        }  # fmt: skip
    return mi.load_dict(stage(camera=sensor(film=film(20, 16)), **things))


_ONE_MAP = {
    "light_map": "lights", "lobe_map": "lobes", "direction_map": "directions",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("only", [*_ONE_MAP, "all"])
def test_mean_with_maps_along_the_path(only: str) -> None:
    scene = _glass_and_spots()
    maps = {name: only in (name, "all") for name in _ONE_MAP}
    integrator = swarm(always_use=True, **maps)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 256, [1001, 1002])
    images = batches(scene, integrator, 256, [1, 2])
    assert_same_pixels_on_average(images, expected, 0.03)
    learned = integrator.statistics.learned
    assert all((word in learned) == maps[name] for name, word in _ONE_MAP.items())
    assert "uniform" not in learned


def test_records_of_bounces_know_what_comes_before_and_after() -> None:
    records = BounceRecords(2, 3)
    # Path 0 chooses at bounces 0 and 2, path 1 at bounce 1
    values = mi.Float([5, 9, 7, 4, 3, 8])
    records.density = mi.Float([1, 0, 0, 2, 0.5, 0])
    np.testing.assert_allclose(records.next_one(values).numpy()[[0, 3, 4]], [3, 0, 0])
    np.testing.assert_allclose(records.products(values).numpy()[[0, 3, 4]], [5, 4, 15])


def test_no_path_through_glass_weighs_more_than_the_share_of_uniform_numbers_allows() -> None:
    density = path_density(mi.Float([0, 1, 1e20])).numpy()
    np.testing.assert_allclose(density[:2], [0.2, 1], rtol=1e-6)
    assert 1e19 < density[2] < 1e20


def test_maps_of_lobes_lower_the_noise_of_panes() -> None:
    scene = load("panes", width=64, height=36)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 8})
    noise = batches(scene, plain, 64, [1, 2]).var(axis=0).mean()
    integrator = mi.load_dict({"type": "swarm_path", "max_depth": 8})
    ours = batches(scene, integrator, 64, [1, 2]).var(axis=0).mean()
    assert ours < 0.6 * noise
    assert "lobes: uniform" not in integrator.statistics.learned


@pytest.mark.parametrize("depth", [pytest.param(4, marks=pytest.mark.slow), -1])
def test_furnace_of_glass_is_exact(depth: int) -> None:
    scene = load("furnace_glass", width=16, height=16)
    integrator = swarm(always_use=True, max_depth=depth, rr_depth=1000)
    images = batches(scene, integrator, 64, [1, 2])
    if depth == -1:
        # Rounding at smooth glass: 4e-5 (docs/mitsuba_faults.md)
        assert_exact(images, 1.0, allowance=1e-4, precision=0.005)
        return
    plain = mi.load_dict({"type": "composed_path", "max_depth": depth, "rr_depth": 1000})
    expected = batches(scene, plain, 256, [1001, 1002])
    assert_same_pixels_on_average(images, expected, 0.01)


def test_lights_have_cells_of_their_probabilities() -> None:
    scene = mi.load_dict({
        "type": "scene",
        **{f"lamp_{i}": {"type": "point", "sampling_weight": w} for i, w in enumerate((1, 0, 3))},
    })  # fmt: skip
    widths = light_cells(scene, 0).widths
    assert sorted(widths[widths > 0]) == pytest.approx([0.25, 0.75])
    assert light_cells(scene, 1).dimension == 1


def test_learned_lights_are_refused_beside_maps_of_their_numbers() -> None:
    with pytest.raises(RuntimeError, match="lights that are not learned"):
        mi.load_dict({
            "type": "composed_path", "light_numbers": "swarm", "next_event": "contribution",
        })  # fmt: skip
