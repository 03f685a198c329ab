"""How often directions of an environment are visible, by tile of the film.

Source: Cline, PhD dissertation, chapter 6. Instead of maps at the corners of a grid, of which the
four around a pixel must agree, samples are counted in tiles, and the tiles around each one are a
prior. Instead of three classes (visible, occluded, uncertain), there are probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering.film_tiles import FilmTiles
from ...transport.observer import Observer
from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from ...util.stored_arrays import StoredArrays

#: The least edge of a tile in pixels, and the most tiles of a film.
_TILE, _MOST_TILES = 8, 8192

#: The weight, in tests, of the priors: a cell's counts in the tile and those around it, whose prior
#: is the sum over all cells of these tiles.
_PRIOR_TESTS = 1.0


@dataclass
class Tile:
    """The maps for a vertex.

    Attributes:
        number: Number of the tile.
        is_known: Whether the maps apply to this vertex. Later vertices of a path lie elsewhere.
    """

    number: mi.UInt32
    is_known: mi.Bool


@dataclass
class Cell:
    """Where a connection lies in the maps.

    Attributes:
        index: The number of the cell among the cells of all tiles.
        is_known: Whether the connection belongs to a cell.
    """

    index: mi.UInt32
    is_known: mi.Bool


class VisibilityCounts(Observer):
    """Counts the shadow rays of each cell of each tile, and how many were unoccluded.

    Parameters:
        width, height: Size of the film in pixels, with its border where that is sampled.
        columns, rows: Number of columns and rows of the cells of a tile.
    """

    def __init__(self, width: int, height: int, columns: int, rows: int) -> None:
        self.tiles = FilmTiles(width, height, _TILE)
        while self.tiles.count > _MOST_TILES:
            self.tiles = FilmTiles(width, height, self.tiles.edge + 1)
        self.columns, self.rows = columns, rows
        # Tests in the low half, successes in the high one: one addition counts both
        self._counts = dr.zeros(mi.UInt64, self.tiles.count * columns * rows)

    def cell(self, tile: mi.UInt32, point: mi.Point2f) -> mi.UInt32:
        """The cell of a point of the unit square."""
        x, y = (
            mi.UInt32(dr.clip(value, 0, ONE_MINUS_EPSILON) * count)
            for value, count in ((point.x, self.columns), (point.y, self.rows))
        )
        return (tile * self.rows + y) * self.columns + x

    def connection(
        self, choice: Cell, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        dr.scatter_add(
            self._counts, dr.select(visible, mi.UInt64((1 << 32) + 1), 1), choice.index,
            tested & choice.is_known,
        )  # fmt: skip

    @property
    def counts(self) -> np.ndarray:
        return self._counts.numpy()

    def restore(self, state: StoredArrays) -> None:
        """Sets the counts to the array ``counts``, made for a film of the same size.

        Raises:
            DamagedError: They are no such counts.
        """
        counts = state.take("counts", "u", (len(self._counts),)).astype(np.uint64)
        is_sound = (counts >> 32) <= (counts & 0xFFFFFFFF)
        state.require(bool(is_sound.all()), 'there are more successes than tests in "counts"')
        self._counts = from_numpy(mi.UInt64, counts)

    def release(self) -> None:
        """Frees the counts."""
        self._counts = mi.UInt64()

    def visibility(self) -> mi.Float64:
        """The probability that a shadow ray arrives, never 0; shape [tiles · rows · columns]."""
        size = self.rows * self.columns
        near = self._with_neighbours()
        # The same for all cells of these tiles
        all_near = dr.repeat(dr.block_sum(near, size), size)
        # Half a success in one more test keeps the prior from being 0
        prior = (_seen(all_near) + 0.5) / (_tests(all_near) + 1)
        for counts in (near, self._counts):
            prior = (_seen(counts) + _PRIOR_TESTS * prior) / (_tests(counts) + _PRIOR_TESTS)
        dr.eval(prior)
        return prior

    def _with_neighbours(self) -> mi.UInt64:
        """The sum over each tile and the eight around it."""
        size = self.rows * self.columns
        height, width = (dr.opaque(mi.Int32, x) for x in (self.tiles.rows, self.tiles.columns))
        index = dr.arange(mi.UInt32, len(self._counts))
        tile = mi.Int32(index // size)
        y = tile // width
        x, total = tile - y * width, mi.UInt64(0)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                is_there = (y + down >= 0) & (y + down < height)
                is_there &= (x + right >= 0) & (x + right < width)
                near = index + mi.UInt32((down * width + right) * size)
                total += dr.gather(mi.UInt64, self._counts, near, is_there)
        return total

    def __str__(self) -> str:
        tests, seen = (
            int(dr.sum(x)[0]) for x in (self._counts & 0xFFFFFFFF, self._counts >> 32)
        )
        tiles = self.tiles
        return (
            f"visibility: {tiles.columns} x {tiles.rows} tiles of {tiles.edge} pixels, "
            f"{self.columns} x {self.rows} cells, {seen / max(tests, 1):.1%} of {tests} shadow "
            f"rays arrived"
        )


def _tests(counts: mi.UInt64) -> mi.Float64:
    return mi.Float64(counts & 0xFFFFFFFF)


def _seen(counts: mi.UInt64) -> mi.Float64:
    return mi.Float64(counts >> 32)


class PrimaryVisibility:
    """Warps the random numbers of connections: cells of the unit square get more of them, the more
    often their connections were unoccluded.

    Parameters:
        counts: The counts of these cells.
        reallocated: The share of the numbers that is distributed so; the rest stays uniform.
    """

    def __init__(self, counts: VisibilityCounts, reallocated: float) -> None:
        # The variance is least where the density is the root of the mean square
        weight, size = dr.sqrt(counts.visibility()), counts.rows * counts.columns
        mean = dr.repeat(dr.block_sum(weight, size), size) / size
        weight = (1 - reallocated) + reallocated * (weight / mean)
        self._density = mi.Float(weight)
        self._of_rows = _cumulative(dr.block_sum(weight, counts.columns), counts.rows)
        self._of_columns = _cumulative(weight, counts.columns)
        dr.eval(self._density, self._of_rows, self._of_columns)
        self._counts = counts

    def sample(
        self, tile: Tile, point: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float]:
        """Warps uniform numbers; returns the numbers and their density."""
        counts, active, uniform = self._counts, active & tile.is_known, point
        first = tile.number * counts.rows
        row, y = _search(self._of_rows, first, counts.rows, point.y, active)
        first = (first + row) * counts.columns
        column, x = _search(self._of_columns, first, counts.columns, point.x, active)
        density = dr.gather(mi.Float, self._density, first + column, active)
        point = mi.Point2f((column + x) / counts.columns, (row + y) / counts.rows)
        return dr.select(active, point, uniform), dr.select(active, density, 1)

    def density(self, tile: Tile, point: mi.Point2f, active: mi.Bool) -> mi.Float:
        """The density of numbers."""
        active = active & tile.is_known
        cell = self._counts.cell(tile.number, point)
        return dr.select(active, dr.gather(mi.Float, self._density, cell, active), 1)


def _cumulative(weight: mi.Float64, count: int) -> mi.Float:
    """Sums up to and including each entry of its group of ``count`` entries, scaled so that the
    last is 1."""
    sums = _running(weight, count)
    last = dr.arange(mi.UInt32, len(weight)) // count * count + (count - 1)
    return mi.Float(sums / dr.gather(mi.Float64, sums, last))


def _running(values: mi.Float64, count: int) -> mi.Float64:
    """Running sums of each group of ``count`` values."""
    return dr.block_prefix_reduce(dr.ReduceOp.Add, values, count, exclusive=False)


def _search(table: mi.Float, first: mi.UInt32, count: int, number: mi.Float, active):
    """The entry that a number chooses, and the rest of the number, stretched to [0, 1)."""
    index = mi.UInt32(0)
    step = 1 << (count - 1).bit_length() - 1
    while step > 0:
        below = dr.gather(mi.Float, table, first + index + (step - 1), active)
        index += dr.select(number >= below, mi.UInt32(step), 0)
        step >>= 1
    low = dr.gather(mi.Float, table, first + index - 1, active & (index > 0))
    high = dr.gather(mi.Float, table, first + index, active)
    left = (number - low) / dr.maximum(high - low, 1e-12)
    return index, dr.clip(left, 0, ONE_MINUS_EPSILON)


class WorldVisibility:
    """Weights of rectangles of an environment by their visibility.

    Parameters:
        counts: The counts of cells, which have equal size in the environment map.
        reallocated: The share of the samples that follow visibility; the rest ignores it.
        emission: The share of each cell in the total emission; shape [rows, columns].
        columns, rows: Number of columns and rows of the texels of the environment map.
    """

    def __init__(
        self, counts: VisibilityCounts, reallocated: float, emission: np.ndarray, columns: int,
        rows: int,
    ) -> None:  # fmt: skip
        weight, size = dr.sqrt(counts.visibility()), counts.rows * counts.columns
        share = dr.tile(from_numpy(mi.Float64, emission), counts.tiles.count)
        mean = dr.repeat(dr.block_sum(weight * share, size), size)
        weight = (1 - reallocated) * mean + reallocated * weight
        # Summed-area tables of the weights and of their squares
        tables = (_summed_areas(x, counts) for x in (weight, dr.square(weight)))
        self._sums = dr.ravel(mi.Point2f(*tables))
        # No literal: it differs from render to render, and the kernel must not
        self._least = mi.Float(dr.min(weight))
        dr.eval(self._sums, self._least)
        self._counts = counts
        self._x, self._y = counts.columns / columns, counts.rows / rows

    def seen(
        self, tile: Tile, x0: mi.UInt32, y0: mi.UInt32, x1: mi.UInt32, y1: mi.UInt32,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:  # fmt: skip
        """The mean weight of the cells that a rectangle of texels touches, positive, and the
        standard deviation between them; a constant where the tile is not known."""
        counts, active = self._counts, active & tile.is_known
        a, c = mi.UInt32(mi.Float(x0) * self._x), mi.UInt32(mi.Float(y0) * self._y)
        b = dr.maximum(mi.UInt32(dr.ceil(mi.Float(x1) * self._x)), a + 1)
        d = dr.maximum(mi.UInt32(dr.ceil(mi.Float(y1) * self._y)), c + 1)
        b, d = dr.minimum(b, counts.columns), dr.minimum(d, counts.rows)
        stride = counts.columns + 1
        first = tile.number * (stride * (counts.rows + 1))
        s = [
            dr.gather(mi.Point2f, self._sums, first + y * stride + x, active)
            for x, y in ((a, c), (b, c), (a, d), (b, d))
        ]
        both = ((s[3] - s[2]) - (s[1] - s[0])) / mi.Float((b - a) * (d - c))
        mean = dr.maximum(both.x, self._least)
        return mean, dr.sqrt(dr.maximum(both.y - dr.square(mean), 0))


def _summed_areas(values: mi.Float64, counts: VisibilityCounts) -> mi.Float:
    """The sums over all cells of a tile above and to the left of each corner, for values of shape
    [tiles, rows, columns]; shape [tiles, rows + 1, columns + 1]."""
    rows, columns, tiles = counts.rows, counts.columns, counts.tiles.count
    sums = _running(values, columns)
    index = dr.arange(mi.UInt32, len(values))
    column, row = index // rows % columns, index % rows
    place = (index // (rows * columns) * rows + row) * columns + column
    # Columns follow one another from here on
    sums = _running(dr.gather(mi.Float64, sums, place), rows)
    index = dr.arange(mi.UInt32, tiles * (rows + 1) * (columns + 1))
    x, y = index % (columns + 1), index // (columns + 1) % (rows + 1)
    place = (index // ((rows + 1) * (columns + 1)) * columns + x - 1) * rows + y - 1
    return mi.Float(dr.gather(mi.Float64, sums, place, (x > 0) & (y > 0)))
