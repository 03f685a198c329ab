"""Maps of numbers that tiles of pixels share: their densities, estimates and stages."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.dither import dithered_parts
from mitsuba_ext.rendering.film_tiles import FilmTiles
from mitsuba_ext.techniques.swarming.cells import CellDensities, Cells
from mitsuba_ext.techniques.swarming.estimate import Form, Grid, Shares, estimate
from mitsuba_ext.techniques.swarming.tile_counts import Choices, TileCounts

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
    # A number lies in its cell, except for rounding at the edges
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
    """Estimates from counts by row, column, map and cell; by default, each sample counts one."""
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


def test_one_sample_changes_no_density() -> None:
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


def test_few_samples_of_a_tile_have_a_small_influence() -> None:
    counts = np.zeros((1, 2, 1, 2))
    counts[0, 0, 0], counts[0, 1, 0] = (12, 0), (4, 8)
    film, variance = _believed(np.array([2 / 3]), 1 / 2, 24, 0, 1)
    left, variance = _believed(np.array([1, 1 / 3]), film, 12, variance, 2)
    a, b = np.sqrt(left**2 + variance), np.sqrt((1 - left) ** 2 + variance)
    np.testing.assert_allclose(_estimated(counts)[0, :, 0, 0], a / (a + b), rtol=1e-4)
    assert (np.abs(a / (a + b) - [1, 1 / 3]) > 0.03).all()


def test_smaller_tiles_continue_the_counts_of_larger_tiles() -> None:
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


def test_rare_bright_samples_count_in_gains() -> None:
    """A map that suits the frequent contributions makes more noise of the rare ones, which make
    most of the variance: each must not make its own tile bright, so that its error hardly
    counts."""
    density = np.array([2.5, 0.5, 0.5, 0.5])
    frequent, rare, chance = 4.0, 300.0, 1 / 2000
    # Frequent: in the first cell. Rare: in any
    before, after = frequent**2 / 4, frequent**2 / 4 / density[0]
    rare_square = rare**2 * chance
    variance = before + rare_square - (frequent / 4 + rare * chance) ** 2
    exact = (before - after + rare_square * (1 - np.mean(1 / density))) / variance
    tiles = FilmTiles(64, 64, 2)
    counts = TileCounts(tiles, 1, 4)
    counts.begin_stage([lambda table, cell: dr.gather(mi.Float, mi.Float(density), cell)])
    rng = np.random.default_rng(3)
    pixel = np.repeat(np.arange(64 * 64), 16)
    cell = rng.integers(0, 4, len(pixel))
    value = frequent * (cell == 0) + rare * (rng.random(len(pixel)) < chance)
    radiance = mi.Float(value)
    choices = Choices(mi.UInt32(0), mi.UInt32(cell), mi.Float(1), radiance, mi.Bool(True))
    counts.add(mi.UInt32(pixel), radiance, choices)
    assert exact < -0.4
    np.testing.assert_allclose(counts.gains(), [exact], atol=0.2)


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
