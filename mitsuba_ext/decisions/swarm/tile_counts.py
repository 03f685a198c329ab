"""What the samples of pilots have brought, by tile and cell: integers, so that equal seeds count
equally."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .film_tiles import FilmTiles

#: Fixed point of counts, of radiance, and of squared radiance.
_ONE, _ONE_X, _ONE_X2 = 2.0**12, 2.0**16, 2.0**12

#: The largest sample, in units of the mean square of its tile; when the gain is measured, a larger
#: one is believed.
_LARGEST, _LARGEST_MEASURED = 64.0, 4096.0

#: The largest radiance that is counted, in units of that of the film.
_BRIGHTEST = 1024.0

#: Squared radiance of a dark tile, in units of the squared mean of the film.
_FLOOR = 1e-2


@dataclass
class Choices:
    """What one decision has chosen in each lane of a pass.

    Attributes:
        map: Which map of the lane's tile was asked.
        cell: Its cell.
        density: The density of the numbers, relative to uniform ones.
        square: The square of what followed from it, divided by all densities.
        active: Lanes in which the decision was taken.
    """

    map: mi.UInt32
    cell: mi.UInt32
    density: mi.Float
    square: mi.Float
    active: mi.Bool


class TileCounts:
    """Counters of one kind of map.

    Parameters:
        tiles: Tiles of the film.
        maps: Maps of a tile.
        cells: Cells of a map.

    Attributes:
        gain: By how much the maps of the last stage lowered the variance of the image, relatively,
            as far as its samples tell.
    """

    def __init__(self, tiles: FilmTiles, maps: int, cells: int) -> None:
        self._tiles, self._maps, self._cells = tiles, maps, cells
        self._counts = dr.zeros(mi.UInt32, tiles.count * maps * cells)
        self._squares = dr.zeros(mi.UInt64, tiles.count * maps)
        #: Of what all samples brought: second moments of the choices, and variances of the pixels
        self._second = np.zeros((tiles.count, maps))
        self._variance = self._saved = self._stage_variance = 0.0

    @property
    def bytes(self) -> int:
        """Memory of the counters."""
        return 4 * len(self._counts) + 8 * len(self._squares)

    @property
    def gain(self) -> float:
        return self._saved / self._stage_variance if self._stage_variance > 0 else 0.0

    def begin_stage(self) -> None:
        """Lets ``gain`` speak of the samples from now on."""
        self._saved = self._stage_variance = 0.0

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Counts, [row, column, map, cell], and sums of squares, [row, column, map]."""
        shape = (self._tiles.rows, self._tiles.columns, self._maps)
        counts = self._counts.numpy().reshape(*shape, self._cells)
        return counts, self._squares.numpy().reshape(shape).astype(np.float64) * _ONE

    def expected_gain(self, predicted: np.ndarray) -> float:
        """By how much maps would lower the variance whose second moments, relative to uniform
        numbers, are ``predicted``, [row, column, map]."""
        if self._variance <= 0:
            return 0.0
        saved = self._second * (1 - predicted.reshape(self._second.shape))
        return float(saved.sum()) / self._variance

    def add(self, pixel: mi.UInt32, radiance: mi.Float, choices: Choices) -> None:
        """Adds the samples of a pass; ``radiance`` is what each brought to its pixel."""
        tile, count = self._tiles.tile(pixel), self._tiles.count
        radiance = dr.select(dr.isfinite(radiance), radiance, 0)
        mean = float(dr.mean(radiance)[0])
        if not mean > 0:
            return
        # A power of two: no sum that depends on the order of additions decides
        unit = 2.0 ** round(np.log2(mean))
        x = dr.minimum(radiance * dr.opaque(mi.Float, 1 / unit), _BRIGHTEST)
        sums = [dr.zeros(mi.UInt64, count) for _ in range(3)]
        for total, value in zip(sums, (x * _ONE_X, dr.square(x) * _ONE_X2, mi.Float(1))):
            dr.scatter_add(total, mi.UInt64(value), tile)
        first, second, samples = (total.numpy().astype(np.float64) for total in sums)
        samples = np.maximum(samples, 1)
        first, second = first / samples / _ONE_X, second / samples / _ONE_X2
        floor = _FLOOR * np.average(first, weights=samples) ** 2
        scale = second + floor
        self._add_choices(tile, choices, unit, scale, np.square(first) + floor)
        variance = np.maximum(second - np.square(first), 0) / (np.square(first) + floor)
        self._variance += float((samples * variance).sum())
        self._stage_variance += float((samples * variance).sum())

    def _add_choices(
        self,
        tile: mi.UInt32,
        choices: Choices,
        unit: float,
        scale: np.ndarray,
        brightness: np.ndarray,
    ) -> None:
        """``scale``: mean square of the samples of each tile; ``brightness``: what relative errors
        are relative to, both in units of ``unit``²."""
        inverse = mi.Float((1 / scale).astype(np.float32))
        square = choices.square * dr.opaque(mi.Float, unit**-2.0)
        square = dr.select(choices.active & dr.isfinite(square), square, 0)
        square = dr.minimum(square * dr.gather(mi.Float, inverse, tile), _LARGEST_MEASURED)
        # Mean over uniform numbers: what was drawn with a density stands for fewer of them
        value = square * choices.density
        table = tile * self._maps + choices.map
        drawn, uniform = (dr.zeros(mi.UInt64, len(self._squares)) for _ in range(2))
        dr.scatter_add(drawn, mi.UInt64(square * _ONE), table, choices.active)
        dr.scatter_add(uniform, mi.UInt64(value * _ONE), table, choices.active)
        fixed = mi.UInt32(dr.minimum(value, _LARGEST) * _ONE + 0.5)
        dr.scatter_add(self._counts, fixed, table * self._cells + choices.cell, choices.active)
        wide = mi.UInt64(fixed)
        dr.scatter_add(
            self._squares, (wide * wide) // int(_ONE), table, choices.active
        )
        dr.eval(self._counts, self._squares, drawn, uniform)
        weight = (scale / brightness)[:, None] / _ONE
        drawn, uniform = (
            x.numpy().reshape(-1, self._maps).astype(np.float64) * weight for x in (drawn, uniform)
        )
        self._second += uniform
        self._saved += float((uniform - drawn).sum())
