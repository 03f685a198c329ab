"""Estimates densities over cells for all tiles of a film, from few samples of each.

The estimate of a tile is a compromise between its own counts and the counts of the larger tile
around it, which weigh more the less the two differ beyond chance: an empirical Bayes estimate. It
proceeds from the largest tiles, whose prior is uniform, to the smallest, and in each tile from the
root of the tree of cells to its leaves. At a node, with ``h`` the share of the left half among
``n`` samples, and ``p`` its estimate in the tile around, it is the mean of a beta distribution::

    (n h + κ p) / (n + κ)

The true difference between tiles and the ones around them, ρ = 1 / (κ + 1), is estimated from all
nodes of a tile and its neighbours (the variance of ``h`` is p (1 − p) (1 / n + ρ (1 − 1 / n))).
Where no difference exceeds chance, ρ is 0, and the tile has the map of the one around it.

Samples from an uncertain density have the least variance where the density is the root of the
expected square of a share, not its expectation: uncertain cells get slightly more. Without that,
bright cells that the few samples of a tile have missed leave spots.

All tiles of one size are estimated together, on the device: a map of 8 million cells takes a tenth
of a second. The sum over a node of a tree is the difference of two prefix sums over cells.

Source: the propagation in two rows of D. Cline, PhD dissertation, BYU 2007, section 9.2.3, is
replaced; the estimate is the beta-binomial one by moments (J. C. Kleinman, *Proportions with
Extraneous Variance*, 1973).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from .nodes import Nodes, sums_before


class Form(NamedTuple):
    """How the density of a cell follows from the contributions of its samples.

    Attributes:
        is_root: Whether it is in proportion to the root of the mean of a cell, not to the mean. The
            variance is least with the mean where all samples of a cell contribute the same, and
            with the root where some of them contribute nothing.
        floor: The share of uniform numbers.
    """

    is_root: bool
    floor: float


#: The most sizes of tiles: the largest are 2^(this - 1) times as wide as the smallest.
_LEVELS = 6

#: The largest ρ: with ρ = 1 (κ = 0), a single sample would decide.
_LARGEST_DIFFERENCE = 0.5

#: When tiles are compared, probabilities are clipped to this distance from 0 and 1.
_LEAST_PROBABILITY = 0.02


@dataclass
class Grid:
    """Tables of the tiles of a film, row by row.

    Attributes:
        rows, columns: Numbers of rows and columns of tiles.
        maps: Number of tables of each tile.
    """

    rows: int
    columns: int
    maps: int

    def __post_init__(self) -> None:
        # Opaque: grids of all sizes share the kernels
        self._last_row, self._last_column, self._columns = (
            dr.opaque(mi.UInt32, n) for n in (self.rows - 1, self.columns - 1, self.columns)
        )

    @property
    def count(self) -> int:
        """Number of tables."""
        return self.rows * self.columns * self.maps

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.rows * self.columns

    @property
    def larger(self) -> Grid:
        """The grid of tiles that are twice as large."""
        return Grid(-(-self.rows // 2), -(-self.columns // 2), self.maps)

    def all_places(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """:meth:`places` of all tables, one after the other."""
        return self.places(dr.arange(mi.UInt32, self.count))

    def places(self, table: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Row, column and number of the map, of each table."""
        tile = table // self.maps
        row = tile // self._columns
        return row, tile - row * self._columns, table - tile * self.maps

    def table(self, row: mi.UInt32, column: mi.UInt32, which: mi.UInt32) -> mi.UInt32:
        """The number of a table."""
        return (row * self._columns + column) * self.maps + which

    def has(self, row: mi.UInt32, column: mi.UInt32) -> mi.Bool:
        """Whether there is such a tile."""
        return (row <= self._last_row) & (column <= self._last_column)

    def nearest(self, row: mi.Int32, column: mi.Int32) -> tuple[mi.UInt32, mi.UInt32]:
        """Row and column of the tile that is nearest to a place."""
        return (
            mi.UInt32(dr.clip(row, 0, mi.Int32(self._last_row))),
            mi.UInt32(dr.clip(column, 0, mi.Int32(self._last_column))),
        )


def estimate(counts: mi.Float, squares: mi.Float, grid: Grid, widths: mi.Float) -> mi.Float:
    """Estimates the share of each cell in the contributions of the samples of its table.

    Parameters:
        counts: Sums of the contributions of samples, by table and cell.
        squares: Sums of their squares, by table, which determine the effective sample size.
        grid: The tables.
        widths: The share of each cell among uniform numbers, which is the first prior.

    Returns:
        Shares, in the order of ``counts``; the shares of a table add up to one.
    """
    cells = len(widths)
    levels = [(grid, counts, squares)]
    while len(levels) < _LEVELS and levels[-1][0].tiles > 1:
        levels.append(_halved(*levels[-1], cells))
    above, shares = levels[-1][0], widths
    if above.count > 1:
        shares = dr.tile(widths, above.count)
    variance = dr.zeros(mi.Float, len(shares))
    while levels:
        grid, counts, squares = levels.pop()
        if above is not grid:
            shares, variance = _enlarged(grid, above, (shares, variance), cells)
        nodes = Nodes(grid.count, cells)
        left, variance = _updated(grid, nodes, shares, variance, counts, squares)
        if not levels:
            # The root of the expected square
            a, b = (dr.sqrt(dr.square(x) + variance) for x in (left, 1 - left))
            left = a / (a + b)
        shares = nodes.masses(left)
        dr.eval(shares, variance)
        above = grid
    return shares


class Shares:
    """The estimated shares of cells, and densities that follow from them.

    Parameters:
        shares: The share of each cell in the contributions of its table, by table and cell.
        widths: The share of each cell among uniform numbers.
    """

    def __init__(self, shares: mi.Float, widths: mi.Float) -> None:
        self._shares, self._widths = shares, widths
        self._roots = dr.block_sum(dr.sqrt(shares * self._every(widths)), self.cells)
        dr.eval(self._roots)

    @property
    def cells(self) -> int:
        """Number of cells of a table."""
        return len(self._widths)

    @property
    def bytes(self) -> int:
        """Memory of the tables."""
        return 4 * len(self._shares)

    def relative(self, form: Form, index: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
        """The density of cells, relative to uniform numbers; ``index`` is table · cells + cell."""
        width = dr.gather(mi.Float, self._widths, index & (self.cells - 1), active)
        # Nothing is drawn from a cell without width
        density = dr.gather(mi.Float, self._shares, index, active) / dr.maximum(width, 1e-20)
        if form.is_root:
            total = dr.gather(mi.Float, self._roots, index // self.cells, active)
            density = dr.sqrt(density) / dr.maximum(total, 1e-20)
        return dr.lerp(density, 1.0, dr.opaque(mi.Float, form.floor))

    def mass(self, form: Form) -> mi.Float:
        """The probability of each cell, by table and cell."""
        relative = self.relative(form, dr.arange(mi.UInt32, len(self._shares)))
        return relative * self._every(self._widths)

    def expected_ratio(self, form: Form) -> mi.Float:
        """The second moment of an integrand in proportion to the density that is sampled from it,
        relative to uniform numbers; by table."""
        mass = self.mass(form)
        width = self._every(self._widths)
        return dr.rcp(
            dr.block_sum(dr.select(width > 0, dr.square(mass) / width, 0), self.cells)
        )

    def _every(self, widths: mi.Float) -> mi.Float:
        """Widths of the cells of all tables."""
        lane = dr.arange(mi.UInt32, len(self._shares))
        return dr.gather(mi.Float, widths, lane & (self.cells - 1))


def _updated(
    grid: Grid, nodes: Nodes, shares: mi.Float, variance: mi.Float, counts: mi.Float,
    squares: mi.Float,
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    """Combines the counts of each tile with ``shares`` of the tile around it, which have
    this ``variance``: by node, the share of the left half, and its variance."""
    cells = nodes.cells
    own_before, expected_before = sums_before(counts, cells), sums_before(shares, cells)
    dr.eval(own_before, expected_before)
    total = dr.gather(
        mi.Float, own_before, dr.arange(mi.UInt32, grid.count) * cells + (cells - 1)
    )
    scale = dr.select(squares > 0, total / squares, 0)
    h, own = nodes.left_share(own_before)
    p, _ = nodes.left_share(expected_before)
    n = own * dr.gather(mi.Float, scale, nodes.table)
    is_known = nodes.exist & (n > 1) & (p > 0) & (p < 1)
    q = dr.clip(p, _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
    excess, weight, chance = (
        dr.block_sum(dr.select(is_known, x, 0), cells)
        for x in (n * dr.square(h - p) / (q * (1 - q)) - 1, n - 1, mi.Float(2))
    )
    dr.eval(excess, weight, chance)
    excess, weight, chance = _pooled(grid, (excess, weight, chance))
    # A low estimate of ρ (by one standard deviation) for the shares, a high one for their variance
    deviation = dr.sqrt(chance)
    rho, most = (
        dr.clip(x / dr.maximum(weight, 1e-6), 0, _LARGEST_DIFFERENCE)
        for x in (excess - deviation, dr.maximum(excess, 0) + deviation)
    )
    dr.eval(rho, most)
    rho, most = (dr.gather(mi.Float, x, nodes.table) for x in (rho, most))
    # n / (n + κ), without dividing by ρ = 0
    believed = n * rho / dr.maximum(n * rho + (1 - rho), 1e-6)
    left = dr.fma(believed, h - p, p)
    own_variance = left * (1 - left) * most / (n * most + 1)
    return left, dr.fma(dr.square(1 - believed), variance, own_variance)


def _pooled(grid: Grid, values: tuple[mi.Float, ...]) -> list[mi.Float]:
    """Sums over each tile and its neighbours."""
    row, column, which = grid.all_places()
    sums = [mi.Float(0) for _ in values]
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            # The index before 0 is the largest integer, which is outside of the grid
            y, x = row + mi.UInt32(dy & 0xFFFFFFFF), column + mi.UInt32(dx & 0xFFFFFFFF)
            table, is_there = grid.table(y, x, which), grid.has(y, x)
            sums = [s + dr.gather(mi.Float, v, table, is_there) for s, v in zip(sums, values)]
    return sums


def _halved(
    grid: Grid, counts: mi.Float, squares: mi.Float, cells: int
) -> tuple[Grid, mi.Float, mi.Float]:
    """Sums over 2 x 2 tiles."""
    larger = grid.larger
    row, column, which = larger.all_places()
    parts = [
        (grid.table(2 * row + dy, 2 * column + dx, which), grid.has(2 * row + dy, 2 * column + dx))
        for dy in (0, 1)
        for dx in (0, 1)
    ]
    dr.eval(parts)
    lane = dr.arange(mi.UInt32, larger.count * cells)
    table, cell = lane // cells, lane & (cells - 1)
    sums, sums_of_squares = mi.Float(0), mi.Float(0)
    for part, is_there in parts:
        sums_of_squares += dr.gather(mi.Float, squares, part, is_there)
        source = dr.gather(mi.UInt32, part, table) * cells + cell
        sums += dr.gather(mi.Float, counts, source, dr.gather(mi.Bool, is_there, table))
    dr.eval(sums, sums_of_squares)
    return larger, sums, sums_of_squares


def _enlarged(
    grid: Grid, above: Grid, values: tuple[mi.Float, ...], cells: int
) -> list[mi.Float]:
    """Values of tiles half as large, by bilinear interpolation."""
    row, column, which = grid.all_places()
    nearest = mi.Int32(row >> 1), mi.Int32(column >> 1)
    towards = [mi.Int32(2 * (i & 1)) - 1 for i in (row, column)]
    parts = [
        above.table(*above.nearest(nearest[0] + y * towards[0], nearest[1] + x * towards[1]), which)
        for y in (0, 1)
        for x in (0, 1)
    ]
    dr.eval(parts)
    lane = dr.arange(mi.UInt32, grid.count * cells)
    table, cell = lane // cells, lane & (cells - 1)
    results = [mi.Float(0) for _ in values]
    for part, weight in zip(parts, (9 / 16, 3 / 16, 3 / 16, 1 / 16)):
        source = dr.gather(mi.UInt32, part, table) * cells + cell
        results = [
            dr.fma(weight, dr.gather(mi.Float, value, source), result)
            for value, result in zip(values, results)
        ]
    return results
