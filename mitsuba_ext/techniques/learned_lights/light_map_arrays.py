"""Light maps as arrays, for files: a map serves other views of its scene, in other processes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...scene.fingerprint import digest
from ...scene.lights.division import emitter_shapes
from ...scene.lights.light_cells import LightCells
from ...scene.regions.surface_voxels import BYTES_PER_VOXEL, SurfaceRows, voxel_edges
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .light_map import BYTES_PER_ENTRY, MOST_SQUARED, LightMap

#: The finest grid of a map, a bound of the coordinates that keeps their differences finite, and the
#: most vertices, of which a scout finds up to three for each of about 65,000 paths.
_MOST_VOXELS, _LARGEST, _MOST_VERTICES = 1024, 1e38, 1 << 22


def arrays_of(scene: mi.Scene, light_map: LightMap) -> dict[str, np.ndarray]:
    """A map as arrays.

    Returns:
        - bbox, resolution, p, n: Parameters of the rows; p and n of shape [3, vertices].
        - tests, successes, squares: The counters; shape [rows, cells]. The cells are in the order
          of their lights' digests, because the order of a scene's emitters differs from process to
          process.
    """
    rows, cells = light_map.rows, light_map.cells
    order = _cell_order(scene, cells)
    counts = {
        "tests": light_map.tests, "successes": light_map.successes, "squares": light_map.squares
    }
    return {
        "bbox": np.array([rows.bbox.min, rows.bbox.max], dtype=np.float32),
        "resolution": np.array(rows.resolution),
        "p": rows.p.numpy(),
        "n": rows.n.numpy(),
        **{name: c.numpy().reshape(-1, cells.count)[:, order] for name, c in counts.items()},
    }


def of_arrays(arrays: StoredArrays, scene: mi.Scene, max_memory: int) -> LightMap:
    """The map from the arrays of :func:`arrays_of`, for the same scene. They are checked, because
    later code computes addresses from them.

    Parameters:
        max_memory: The most bytes that a map of several voxels may take.

    Raises:
        DamagedError: They are no map, or too large.
    """
    take = arrays.take
    resolution = int(arrays.number("resolution", "iu", 1, _MOST_VOXELS))
    bbox = take("bbox", "f", (2, 3), -_LARGEST, _LARGEST)
    arrays.require(bool((bbox[0] < bbox[1]).all()), '"bbox" is no box')
    p = take("p", "f", (3, None), longest=3 * _MOST_VERTICES)
    n = take("n", "f", p.shape)
    is_inside = (bbox[0] <= p.T) & (p.T <= bbox[1])
    arrays.require(bool(is_inside.all(axis=1).any()), '"p" is outside of "bbox"')
    _check_memory(arrays, resolution, 0, max_memory)
    bbox = mi.ScalarBoundingBox3f(*bbox.astype(np.float32))
    p, n = mi.Point3f(p.astype(np.float32)), mi.Normal3f(n.astype(np.float32))
    rows = SurfaceRows(bbox, resolution, p, n)
    cells = LightCells(scene, voxel_edges(bbox, resolution))
    shape = rows.count, cells.count
    _check_memory(arrays, resolution, rows.count * cells.count, max_memory)
    counts = {
        name: take(name, "u", shape, 0, most, rows.count * cells.count)
        for name, most in (("tests", 0xFFFFFFFF), ("successes", 0xFFFFFFFF), ("squares", None))
    }
    tests = counts["tests"].astype(np.uint64)
    arrays.require(
        bool((counts["successes"] <= tests).all()), 'there are more "successes" than "tests"'
    )
    arrays.require(
        bool((counts["squares"] <= tests * MOST_SQUARED).all()), '"squares" are too large'
    )
    light_map = LightMap(scene, rows, cells)
    place = np.argsort(_cell_order(scene, cells))
    kinds = {"tests": mi.UInt32, "successes": mi.UInt32, "squares": mi.UInt64}
    light_map.restore(*(from_numpy(kind, counts[k][:, place]) for k, kind in kinds.items()))
    return light_map


def _check_memory(
    arrays: StoredArrays, resolution: int, entries: int, max_memory: int
) -> None:
    memory = entries * BYTES_PER_ENTRY + resolution**3 * BYTES_PER_VOXEL
    # Learning makes a map of one voxel in any memory
    arrays.require(
        resolution == 1 or memory <= max_memory,
        f"its map needs {memory / 2**20:.1f} MiB, more than the {max_memory / 2**20:g} of "
        f'"max_memory"',
    )


def _cell_order(scene: mi.Scene, cells: LightCells) -> np.ndarray:
    """The cells of a scene in the order of their lights' digests. Equal lights at one place are
    interchangeable."""
    lights = zip(scene.emitters(), emitter_shapes(scene))
    digests = [digest(emitter) + (digest(shape) if shape else b"") for emitter, shape in lights]
    rank = np.empty(len(digests), dtype=int)
    rank[sorted(range(len(digests)), key=digests.__getitem__)] = np.arange(len(digests))
    return np.argsort(rank[cells.emitter_index], kind="stable")
