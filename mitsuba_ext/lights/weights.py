"""How much each light matters, before anything is learned."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..learning.surface_rows import SurfaceRows
from ..learning.voxel_grid import VoxelGrid
from .environment import brightness, some_wavelengths
from .light_cells import LightCells

#: Least weight of a cell, relative to the mean of its row (pbrt's).
_FLOOR = 1e-3

#: Samples of an emitter's power.
_POWER_SAMPLES = 256

#: Points of a row at which a cell is evaluated, at least and at most. In voxels, most are pbrt's
#: number; on surfaces, fewer than four make what is expected of a thousand lamps too noisy.
_VOXEL_POINTS, _SURFACE_POINTS = (1, 128), (4, 8)

#: Evaluations of all cells in all rows, about, between these bounds.
_EVALUATIONS = 1 << 22

#: Added to the cosine at a surface, whose shading normal may differ.
_LEAST_COSINE = 0.02

#: Evaluations of one kernel.
_CHUNK = 1 << 21


def uniform_weights(scene: mi.Scene, cells: LightCells) -> mi.Float:
    """Each emitter by its ``sampling_weight``, as Mitsuba chooses; shape [cells]."""
    weights = np.array([e.sampling_weight() for e in scene.emitters()])
    return mi.Float((weights[cells.emitter_index] * cells.share).astype(np.float32))


def power_weights(scene: mi.Scene, cells: LightCells) -> mi.Float:
    """Each emitter by its power times its ``sampling_weight``; shape [cells]."""
    count = len(scene.emitters())
    lanes = count * _POWER_SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, lanes)
    index = dr.arange(mi.UInt32, lanes) // _POWER_SAMPLES
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)
    _ray, weight = emitter.sample_ray(
        0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), mi.Bool(True)
    )
    value = brightness(weight)
    power = dr.block_sum(dr.select(dr.isfinite(value), value, 0), _POWER_SAMPLES).numpy()
    weights = power * np.array([e.sampling_weight() for e in scene.emitters()])
    cell = weights[cells.emitter_index] * cells.share
    # A weight that is lost in rounding would leave a point light dark
    cell = np.where(weights[cells.emitter_index] > 0, np.maximum(cell, _FLOOR * cell.mean()), 0)
    return mi.Float(cell.astype(np.float32))


class VoxelRows:
    """A row for each occupied voxel; the last one stands for all other points."""

    def __init__(self, voxels: VoxelGrid) -> None:
        self.voxels = voxels
        self.count = voxels.occupied_count + 1

    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        voxel, known = self.voxels.index(si.p, active)
        return dr.select(known, voxel, self.count - 1)


def spatial_weights(scene: mi.Scene, rows: VoxelRows, cells: LightCells) -> mi.Float:
    """The mean radiance / pdf with which each cell arrives at points of a voxel, whether visible or
    not (as in pbrt-v3's ``SpatialLightDistribution``); shape [rows · cells]."""

    def random_point(row: mi.UInt32, sampler: mi.Sampler) -> mi.Point3f:
        sample = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
        return rows.voxels.point(row, sample)

    parts = []
    for _p, value, _d, points in _evaluations(rows.count - 1, cells, _VOXEL_POINTS, random_point):
        parts.append(dr.block_sum(value, points) / points)
        dr.eval(parts[-1])
    return _with_last_row(scene, cells, dr.concat(parts))


def unoccluded_weights(scene: mi.Scene, rows: SurfaceRows, cells: LightCells) -> mi.Float:
    """The root of the mean square of what each cell contributes to a white diffuse surface of each
    row if nothing is in between; shape [rows · cells]."""

    def vertex(row: mi.UInt32, sampler: mi.Sampler) -> mi.UInt32:
        size = dr.gather(mi.UInt32, rows.size, row)
        index = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(size)), size - 1)
        return dr.gather(mi.UInt32, rows.first, row) + index

    parts = []
    evaluations = _evaluations(rows.count - 1, cells, _SURFACE_POINTS, vertex, rows.p)
    for where, value, d, points in evaluations:
        cosine = dr.maximum(dr.dot(d, dr.gather(mi.Normal3f, rows.n, where)), 0) + _LEAST_COSINE
        parts.append(dr.sqrt(dr.block_sum(dr.square(value * cosine), points) / points))
        dr.eval(parts[-1])
    return _with_last_row(scene, cells, dr.concat(parts))


def _evaluations(
    rows: int,
    cells: LightCells,
    bounds: tuple[int, int],
    draw: Callable[[mi.UInt32, mi.Sampler], mi.Point3f | mi.UInt32],
    vertices: mi.Point3f | None = None,
) -> Iterator[tuple[mi.Point3f | mi.UInt32, mi.Float, mi.Vector3f, int]]:
    """Samples every cell from points of every row, as many of them for each as all can have.

    Parameters:
        bounds: The least and the largest number of points.
        draw: Returns a point of each row, or the index of one of ``vertices``.

    Yields:
        For consecutive pairs (row, cell): what was drawn, the brightness of radiance / pdf, the
        direction of the sample, and the number of points of each pair.
    """
    pair_count = rows * cells.count
    points = max(bounds[0], min(bounds[1], _EVALUATIONS // pair_count))
    sampler = mi.load_dict({"type": "independent"})
    step = max(1, _CHUNK // points)
    for begin in range(0, pair_count, step):
        lanes = min(step, pair_count - begin) * points
        sampler.seed(begin, lanes)
        pair = dr.opaque(mi.UInt32, begin) + dr.arange(mi.UInt32, lanes) // points
        row = pair // cells.count
        where = draw(row, sampler)
        ref = dr.zeros(mi.SurfaceInteraction3f, lanes)
        ref.p = where if vertices is None else dr.gather(mi.Point3f, vertices, where)
        ref.wavelengths = some_wavelengths(lanes)
        ds, weight = cells.sample(pair - row * cells.count, ref, sampler.next_2d(), mi.Bool(True))
        value = brightness(weight)
        # Some emitters send the same everywhere: one number for all lanes
        value = dr.select(dr.isfinite(value), value, dr.zeros(mi.Float, lanes))
        yield where, value, ds.d, points


def _with_last_row(scene: mi.Scene, cells: LightCells, weights: mi.Float) -> mi.Float:
    """Honours ``sampling_weight``, gives no cell less than a share of its row's mean, and appends
    the row of all other points, which is the mean of the others."""
    count = cells.count
    sampling_weight = np.array([e.sampling_weight() for e in scene.emitters()], dtype=np.float32)
    factor = mi.Float(sampling_weight[cells.emitter_index])
    cell = dr.arange(mi.UInt32, len(weights)) % count
    weights *= dr.gather(mi.Float, factor, cell)
    mean = dr.repeat(dr.block_sum(weights, count), count) / count
    weights = dr.maximum(weights, _FLOOR * mean)
    weights = dr.select(dr.gather(mi.Float, factor, cell) > 0, weights, 0)
    last = weights.numpy().reshape(-1, count).mean(axis=0)
    return dr.concat([weights, mi.Float(last)])
