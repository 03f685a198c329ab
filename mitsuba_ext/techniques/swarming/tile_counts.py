"""Sums of the contributions of pilot samples, by tile and cell. They are integers, so that equal
seeds give equal sums."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...images.box_filter import RADIUS, box_means
from ...rendering.film_tiles import FilmTiles
from ...util.arrays import from_numpy

#: Fixed point of counts and of their squares, of radiance, and of squared radiance.
_ONE, _ONE_X, _ONE_X2 = 2.0**12, 2.0**16, 2.0**12

#: Contributions are clipped to the first, in units of the root mean square contribution of samples
#: of the tile; their squares to the second when gains are measured.
_LARGEST, _LARGEST_MEASURED = 32.0, 4096.0

#: The largest radiance that is counted, in units of the mean radiance of the film.
_BRIGHTEST = 1024.0

#: Added to the squared radiance of a tile, in units of the squared mean of the film.
_FLOOR = 1e-2

#: (table, cell) → the density of the cell, relative to uniform numbers.
Candidate = Callable[[Any, Any], Any]


@dataclass
class Choices:
    """The choices of a decision in a pass.

    Attributes:
        map: Which map of the lane's tile was used.
        cell: The chosen cell of the map.
        density: The density of the numbers, relative to uniform ones.
        value: The contribution after the choice, divided by all densities.
        active: Where the decision was taken.
        lane: The lane of each choice; ``None`` for one in each lane.
        share: The share of the decisions that the maps take; another distribution takes the rest.
        scale: The density of uniform numbers, in units of the density of that other distribution;
            used where ``share`` is below 1. ``density`` is in these units then.
        later: The part of ``value`` after later choices of the same path. It is measured with
            these, whose ``density`` contains both choices, and not a second time here.
    """

    map: mi.UInt32
    cell: mi.UInt32
    density: mi.Float
    value: mi.Float
    active: mi.Bool
    lane: mi.UInt32 | None = None
    share: float = 1.0
    scale: mi.Float | float = 1.0
    later: mi.Float | float = 0.0

    def under(self, q: mi.Float) -> mi.Float:
        """``density`` if the density of the maps, relative to uniform numbers, were ``q``."""
        return q if self.share == 1 else (1 - self.share) + self.share * self.scale * q


class TileCounts:
    """Counters of one kind of map.

    Parameters:
        tiles: Tiles of the film.
        maps: Number of maps of a tile.
        cells: Number of cells of a map.

    Attributes:
        candidates: Densities that are tried on the samples of the running stage.
        samples: Number of samples that were counted.
    """

    def __init__(self, tiles: FilmTiles, maps: int, cells: int) -> None:
        self._tiles, self._maps, self._cells = tiles, maps, cells
        self._counts = dr.zeros(mi.UInt32, tiles.count * maps * cells)
        self._squares = dr.zeros(mi.UInt64, tiles.count * maps)
        self.candidates: list[Candidate] = []
        self.samples = 0
        #: Second moments under uniform numbers, by table, and variances of all pixels, of all
        #: samples and of those of the stage
        self._second, self._variance = np.zeros(tiles.count * maps), 0.0
        self.begin_stage([])

    @property
    def bytes(self) -> int:
        """Memory of the counters."""
        return 4 * len(self._counts) + 8 * len(self._squares)

    def begin_stage(self, candidates: Sequence[Candidate]) -> None:
        """Begins a stage, whose samples measure the gains of ``candidates``."""
        self.candidates = list(candidates)
        #: Squares as they were drawn, under uniform numbers, and under each candidate
        self._moments, self._stage_variance = np.zeros(2 + len(candidates)), 0.0

    def gains(self) -> np.ndarray:
        """The reduction of the image's variance by each candidate, relative to the variance with
        uniform numbers, estimated from the samples of the stage."""
        drawn, uniform, *tried = self._moments
        variance = self._stage_variance + uniform - drawn
        return (uniform - np.array(tried)) / variance if variance > 0 else np.zeros(len(tried))

    def expected_gain(self, ratios: np.ndarray) -> float:
        """The same for maps whose second moments, relative to uniform numbers, are ``ratios``, by
        table; estimated from all samples."""
        saved = (self._second * (1 - ratios)).sum()
        return float(saved) / self._variance if self._variance > 0 else 0.0

    def divide(self, tiles: FilmTiles) -> None:
        """Replaces the tiles by smaller ones, among which the counts are divided evenly."""
        parts = (self._tiles.edge // tiles.edge) ** 2
        source = self._larger(tiles)
        self._second = self._second[source.numpy()] / parts
        self._squares = dr.gather(mi.UInt64, self._squares, source) // parts
        lane = dr.arange(mi.UInt32, len(source) * self._cells)
        table = lane // self._cells
        cell = dr.gather(mi.UInt32, source, table) * self._cells + (lane - table * self._cells)
        self._counts = dr.gather(mi.UInt32, self._counts, cell) // parts
        dr.eval(self._counts, self._squares)
        self._tiles = tiles

    def _larger(self, tiles: FilmTiles) -> mi.UInt32:
        """For each table of smaller tiles, the table of the tile that contains them."""
        step, which = self._tiles.edge // tiles.edge, np.arange(self._maps)
        rows, columns = np.arange(tiles.rows) // step, np.arange(tiles.columns) // step
        tile = rows[:, None] * self._tiles.columns + columns
        return from_numpy(mi.UInt32, tile[..., None] * self._maps + which)

    def sums(self) -> tuple[mi.Float, mi.Float]:
        """Counts, by table and cell, and sums of squares, by table."""
        return mi.Float(self._counts), mi.Float(self._squares) * _ONE

    def add(self, pixel: mi.UInt32, radiance: mi.Float, choices: Choices) -> None:
        """Adds the samples of a pass; ``radiance`` is the contribution of each to its pixel."""
        self.samples += len(pixel)
        tile, count = self._tiles.tile(pixel), self._tiles.count
        radiance = dr.select(dr.isfinite(radiance), radiance, 0)
        mean = float(dr.mean(radiance)[0])
        if not mean > 0:
            return
        # Rounded to a power of two: the mean depends on the order of additions
        inverse_unit = dr.opaque(mi.Float, 2.0 ** -round(np.log2(mean)))
        x = dr.minimum(radiance * inverse_unit, _BRIGHTEST)
        first, second, samples = _sums(
            count, tile, [x * _ONE_X, dr.square(x) * _ONE_X2, mi.Float(1)]
        )
        samples = np.maximum(samples, 1)
        first, second = first / samples / _ONE_X, second / samples / _ONE_X2
        floor = _FLOOR * np.average(first, weights=samples) ** 2
        scale, brightness = second + floor, np.square(self._smooth(first)) + floor
        weight = np.repeat(scale / brightness, self._maps)
        if choices.lane is not None:
            tile = dr.gather(mi.UInt32, tile, choices.lane)
        unit = inverse_unit * dr.gather(mi.Float, from_numpy(mi.Float, 1 / np.sqrt(scale)), tile)
        value, later = (
            dr.select(choices.active & dr.isfinite(x), x, 0) * unit
            for x in (choices.value, choices.later)
        )
        self._add_choices(tile, choices, value, later, weight)
        variance = np.maximum(second - np.square(first), 0) / brightness
        total = float((samples * variance).sum())
        self._variance += total
        self._stage_variance += total

    def _smooth(self, means: np.ndarray) -> np.ndarray:
        """The mean radiance of each tile and its neighbours, as for pixels in
        :mod:`..pixel_estimates`. A rare bright sample would make its own tile bright, so that its
        error would hardly count."""
        image = means.reshape(self._tiles.rows, self._tiles.columns)
        return box_means(image, RADIUS // self._tiles.edge).ravel()

    def _add_choices(self, tile, choices: Choices, value, later, weight: np.ndarray) -> None:
        """``value`` and ``later`` are relative to the root mean square contribution of samples of
        the tile; ``weight`` turns their squares into squares of relative errors, by table."""
        table = tile * self._maps + choices.map
        cell = table * self._cells + choices.cell
        # Values are divided by the density of their samples: their sum estimates an integral
        fixed = mi.UInt32(dr.minimum(value, _LARGEST) * _ONE + 0.5)
        dr.scatter_add(self._counts, fixed, cell, choices.active)
        wide = mi.UInt64(fixed)
        dr.scatter_add(self._squares, (wide * wide) // int(_ONE), table, choices.active)
        # The square without the square of the later part, which is measured with the later choice
        square, square_of_later = (
            dr.minimum(dr.square(x), _LARGEST_MEASURED) for x in (value, later)
        )
        square = dr.maximum(square - square_of_later, 0) * _ONE
        # The mean of value² · density is the second moment under uniform numbers
        uniform = square * choices.density
        tried = [
            uniform / dr.select(choices.active, choices.under(q(table, choices.cell)), 1)
            for q in self.candidates
        ]
        sums = _sums(len(weight), table, [square, uniform, *tried], choices.active)
        dr.eval(self._counts, self._squares)
        self._second += sums[1] * weight / _ONE
        self._moments += [float((total * weight).sum()) / _ONE for total in sums]


def _sums(
    size: int, index: mi.UInt32, values: Sequence[mi.Float], active: mi.Bool | bool = True
) -> list[np.ndarray]:
    """Sums of values by their index; each value is rounded down to an integer."""
    totals = [dr.zeros(mi.UInt64, size) for _ in values]
    for total, value in zip(totals, values):
        dr.scatter_add(total, mi.UInt64(value), index, mi.Bool(active))
    dr.eval(totals)
    return [total.numpy().astype(np.float64) for total in totals]
