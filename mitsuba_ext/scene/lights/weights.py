"""The weights of light cells before anything is learned: uniform, by power, by contribution."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy, joined
from ...util.spectra import brightness, comparison_wavelengths
from ..regions.surface_voxels import SurfaceRows
from ..regions.voxel_grid import VoxelGrid
from .light_cells import LightCells
from .power import emitter_powers
from .shutter_times import ShutterTimes

#: The minimum weight of a cell, relative to the mean of its row (as in pbrt).
_FLOOR = 1e-3

#: The minimum and maximum numbers of a row's points at which a cell is evaluated (voxels: pbrt's).
_VOXEL_POINTS, _SURFACE_POINTS = (1, 128), (2, 16)

#: The approximate number of evaluations of all cells in all rows, within these bounds, and again
#: for the brighter cells.
EVALUATIONS = 1 << 22

#: Added to the cosine at a surface because its shading normal may differ from the geometric one.
_ADDED_COSINE = 0.02

#: The number of evaluations per kernel launch.
_CHUNK = 1 << 21


def uniform_weights(scene: mi.Scene, cells: LightCells) -> mi.Float:
    """The weights with which Mitsuba chooses: the ``sampling_weight`` of each emitter, divided
    among its cells by area; shape [cells]."""
    weights = np.array([e.sampling_weight() for e in scene.emitters()])
    return from_numpy(mi.Float, weights[cells.emitter_index] * cells.share)


def power_weights(scene: mi.Scene, cells: LightCells) -> mi.Float:
    """The power of each emitter times its ``sampling_weight``, in units of the largest product,
    divided among its cells by area; shape [cells]. A weight is 0 only where the ``sampling_weight``
    is 0."""
    sampling_weight = np.array([e.sampling_weight() for e in scene.emitters()])
    weights = emitter_powers(scene) * sampling_weight
    weights /= max(weights.max(), 1e-300)
    cell = weights[cells.emitter_index] * cells.share
    # An emitter whose power was estimated as 0, or is lost in rounding, must still be selectable
    cell = np.maximum(cell, _FLOOR * (cell.mean() or 1.0))
    cell[sampling_weight[cells.emitter_index] <= 0] = 0
    return from_numpy(mi.Float, cell)


class VoxelRows:
    """A row for each interval of time in each occupied voxel; the last one stands for all other
    points."""

    def __init__(self, voxels: VoxelGrid, times: ShutterTimes) -> None:
        self._voxels, self._times = voxels, times
        self.resolution = voxels.resolution
        self.count = voxels.occupied_count * times.count + 1

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        voxel, known = self._voxels.index(si.p, active)
        row = voxel
        if self._times.count > 1:
            row = voxel * self._times.count + self._times.index(si.time)
        return dr.select(known, row, self.count - 1)

    def sample(self, row: mi.UInt32, sampler: mi.Sampler) -> tuple[mi.Point3f, mi.Float]:
        """A random point of the voxel of a row, and a time of its interval."""
        sample = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
        voxel = row // self._times.count
        time = self._times.sample(row - voxel * self._times.count, sampler)
        return self._voxels.point(voxel, sample), time


def spatial_weights(scene: mi.Scene, rows: VoxelRows, cells: LightCells) -> mi.Float:
    """The mean radiance / pdf that arrives from each cell at points of a voxel, ignoring visibility
    (as in pbrt-v3's ``SpatialLightDistribution``), during an interval of time; shape [rows ·
    cells]."""

    def arrives(row: mi.UInt32, cell: mi.UInt32, sampler: mi.Sampler) -> mi.Float:
        p, time = rows.sample(row, sampler)
        return _light(cells, cell, p, time, sampler)[0]

    means = cell_means(rows.count - 1, cells.count, _VOXEL_POINTS, arrives)
    return _with_last_row(scene, cells, means)


def unoccluded_weights(scene: mi.Scene, rows: SurfaceRows, cells: LightCells) -> mi.Float:
    """The root mean square of each cell's unoccluded contribution to a white diffuse surface in
    each row; shape [rows · cells]."""
    lights = cells.tabulated()

    def squared_contribution(row: mi.UInt32, cell: mi.UInt32, sampler: mi.Sampler) -> mi.Float64:
        size = dr.gather(mi.UInt32, rows.size, row)
        index = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(size)), size - 1)
        index += dr.gather(mi.UInt32, rows.first, row)
        # Moving lights are evaluated at time 0; pilots see the other times
        value, d = _light(lights, cell, dr.gather(mi.Point3f, rows.p, index), mi.Float(0), sampler)
        cosine = dr.maximum(dr.dot(d, dr.gather(mi.Normal3f, rows.n, index)), 0) + _ADDED_COSINE
        # In double precision: the square of a bright light may exceed the range of single precision
        return dr.square(mi.Float64(value * cosine))

    means = cell_means(rows.count - 1, cells.count, _SURFACE_POINTS, squared_contribution)
    return _with_last_row(scene, cells, mi.Float(dr.sqrt(means)))


def _light(
    cells: LightCells, cell: mi.UInt32, p: mi.Point3f, time: mi.Float, sampler: mi.Sampler
) -> tuple[mi.Float, mi.Vector3f]:
    """Samples ``cell`` from ``p``: the brightness of radiance / pdf, and the direction."""
    lanes = dr.width(cell)
    ref = dr.zeros(mi.SurfaceInteraction3f, lanes)
    ref.p, ref.time, ref.wavelengths = p, time, comparison_wavelengths(lanes)
    ds, weight = cells.sample(cell, ref, sampler.next_2d(), mi.Bool(True))
    value = brightness(weight)
    # Some emitters return a single number for all lanes: it is widened
    return dr.select(dr.isfinite(value), value, dr.zeros(mi.Float, lanes)), ds.d


def cell_means(
    rows: int,
    cells: int,
    bounds: tuple[int, int],
    measure: Callable[[mi.UInt32, mi.UInt32, mi.Sampler], mi.Float | mi.Float64],
    evaluations: int = EVALUATIONS,
) -> mi.Float | mi.Float64:
    """The mean of ``measure(row, cell, sampler)`` over samples, for each row and cell; shape [rows
    · cells]. If the budget does not allow the maximum number of samples for all cells, the cells
    above the mean of their row are measured again, where it allows at least twice as many for them.

    Parameters:
        bounds: The minimum and the maximum number of samples of a cell in a row.
        evaluations: The budget: the approximate number of evaluations of ``measure``.
    """
    pairs = dr.arange(mi.UInt32, rows * cells)
    samples = _sample_count(len(pairs), bounds, evaluations)
    means = _means_of(pairs, cells, samples, measure)
    if samples < bounds[1]:
        row_mean = dr.repeat(dr.block_sum(means, cells), cells) / cells
        important = dr.compress(means > row_mean)
        more = _sample_count(len(important), bounds, evaluations)
        if len(important) > 0 and more >= 2 * samples:
            dr.scatter(means, _means_of(important, cells, more, measure), important)
    return means


def _sample_count(pairs: int, bounds: tuple[int, int], evaluations: int) -> int:
    return max(bounds[0], min(bounds[1], evaluations // max(1, pairs)))


def _means_of(
    pairs: mi.UInt32, cells: int, samples: int, measure: Callable
) -> mi.Float | mi.Float64:
    sampler = mi.load_dict({"type": "independent"})
    step = max(1, _CHUNK // samples)
    parts = []
    for begin in range(0, len(pairs), step):
        lanes = min(step, len(pairs) - begin) * samples
        sampler.seed(begin, lanes)
        index = dr.opaque(mi.UInt32, begin) + dr.arange(mi.UInt32, lanes) // samples
        pair = dr.gather(mi.UInt32, pairs, index)
        row = pair // cells
        value = measure(row, pair - row * cells, sampler)
        parts.append(dr.block_sum(value, samples) / samples)
        dr.eval(parts[-1])
    return dr.concat(parts)


def _with_last_row(scene: mi.Scene, cells: LightCells, weights: mi.Float) -> mi.Float:
    """Completes the weights: multiplies them by ``sampling_weight``, raises each to at least a
    fraction of its row's mean (in a row that no light reaches, all weights are equal), and appends
    the last row, which stands for all other points and is the mean of the others."""
    count = cells.count
    sampling_weight = np.array([e.sampling_weight() for e in scene.emitters()], dtype=np.float32)
    factor = mi.Float(sampling_weight[cells.emitter_index])
    cell = dr.arange(mi.UInt32, len(weights)) % count
    factor = dr.gather(mi.Float, factor, cell)
    weights *= factor
    mean = dr.repeat(dr.block_sum(weights, count), count) / count
    typical = dr.sum(mean) / len(mean)
    fallback = dr.select(typical > 0, typical, 1)
    weights = dr.select(mean > 0, dr.maximum(weights, _FLOOR * mean), fallback)
    weights = dr.select(factor > 0, weights, 0)
    rows = dr.opaque(mi.UInt32, len(weights) // count)
    index = dr.arange(mi.UInt32, len(weights))
    of_cell = mi.Float64(dr.gather(mi.Float, weights, index % rows * count + index // rows))
    last = dr.block_sum(of_cell, len(weights) // count) / mi.Float64(rows)
    return joined([weights, mi.Float(last)])
