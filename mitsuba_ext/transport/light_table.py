"""Choosing among lights by a table of probabilities."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.lights.choice import Choice
from ..scene.lights.light_cells import LightCells
from ..util.arrays import from_numpy
from ..util.discrete_sampling import alias_tables
from .path_decisions import EmitterSampling

#: Entries of a table that are computed together, which bounds the temporary memory.
_ENTRIES_AT_ONCE = 1 << 20

#: Bytes of an entry of the table, including the weights and temporaries while it is computed.
TABLE_BYTES = 40


class Rows(Protocol):
    """Decides which row of a table a surface point uses."""

    count: int

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The row of a point."""


class OneRow:
    """The same probabilities everywhere."""

    count = 1

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        return mi.UInt32(0)


class LightTable(EmitterSampling):
    """Chooses a cell with the probabilities of the vertex's row, then a point on it.

    Parameters:
        rows: Decides which row a vertex uses.
        cells: The cells to choose from.
        weights: For each row, a weight for each cell; shape [rows · cells], not negative. A row of
            zeros chooses uniformly.
    """

    # The rest of one number, after choosing among many entries, is too coarse
    choice_dimension = 2

    def __init__(self, rows: Rows, cells: LightCells, weights: mi.Float) -> None:
        self.rows, self.cells = rows, cells
        self._table = alias_rows(weights, rows.count, cells.count)
        # Opaque: scenes that differ in it only share their kernels
        self._count = dr.opaque(mi.UInt32, cells.count)
        self._cell_of = from_numpy(mi.UInt32, cells.first_cells())

    def begin(self, sampler, ray, pixel=None) -> mi.UInt32:
        return mi.UInt32(0)

    def visit(self, state, scene, si, active) -> mi.UInt32:
        return self.rows.row(si, active)

    def sample(self, place, scene, numbers, si, active):
        row = place
        x, y = numbers.choice
        cell = dr.minimum(mi.UInt32(x * mi.Float(self._count)), self._count - 1)
        entry = dr.gather(mi.Vector4f, self._table, row * self._count + cell, active)
        is_taken = y < entry[0]
        cell = dr.select(is_taken, cell, dr.reinterpret_array(mi.UInt32, entry[1]))
        probability = dr.select(is_taken, entry[2], entry[3])
        ds, weight = self.cells.sample(cell, si, numbers.point, active)
        ds.pdf *= probability
        weight = dr.select(probability > 0, weight / probability, 0)
        return ds, weight, Choice(row, cell, probability)

    def density(self, state, scene, ref, si, ds, active):
        # Few rays hit a light: the others skip the lookups
        return if_active(active, self._density, (state, ref, si, ds, active))

    def probability(self, state, scene, ref, emitter, active):
        # Points and directions are cells of their own
        entry = state * self._count + dr.gather(mi.UInt32, self._cell_of, emitter, active)
        return dr.gather(mi.Float, self._table, 4 * entry + 2, active)

    def _density(self, row, ref, si, ds, active) -> mi.Float:
        cell, pdf = self.cells.pdf(ref, si, ds, active)
        entry = row * self._count + cell
        probability = dr.gather(mi.Float, self._table, 4 * entry + 2, active)
        # Also where the lookups above were masked, the density must be a number
        return dr.select(active, pdf * probability, 0)


def alias_rows(weights: mi.Float, rows: int, count: int) -> mi.Float:
    """Builds the alias tables of all rows. An entry holds its threshold, the cell of its alias, its
    own probability and the alias's probability; a draw reads these four in one memory access."""
    table = dr.empty(mi.Float, 4 * rows * count)
    step = max(1, _ENTRIES_AT_ONCE // count)
    for begin in range(0, rows, step):
        entry = dr.arange(mi.UInt32, min(step, rows - begin) * count)
        offset = dr.opaque(mi.UInt32, begin * count)
        part = mi.Float64(dr.gather(mi.Float, weights, entry + offset))
        total = dr.repeat(dr.block_sum(part, count), count)
        relative = dr.select(total > 0, part * (count / total), 1)
        first = entry - entry % count
        threshold, alias = alias_tables(relative, first, first + (count - 1), count)
        probability = mi.Float(relative / count)
        dr.eval(threshold, alias, probability)
        cell = dr.reinterpret_array(mi.Float, alias - first)
        values = mi.Vector4f(threshold, cell, probability, dr.gather(mi.Float, probability, alias))
        dr.scatter(table, values, entry + offset)
        dr.eval(table)
    return table


def if_active(active: mi.Bool, function, arguments: tuple) -> mi.Float:
    """``function(*arguments)`` where ``active``, 0 elsewhere."""
    return dr.if_stmt(
        arguments, active, lambda *values: function(*values), lambda *_values: mi.Float(0)
    )


def sampling_weights(scene: mi.Scene) -> LightTable:
    """The light sampling of ``path``, but with the true densities of points on meshes with
    interpolated normals."""
    cells = LightCells(scene, None)
    number = from_numpy(mi.UInt32, cells.emitter_index)
    probability = np.broadcast_to(scene.pdf_emitter(number).numpy(), cells.count)
    return LightTable(OneRow(), cells, from_numpy(mi.Float, probability * cells.share))
