"""Light maps in files: a map that was learned from one view of a scene serves other views."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from ..files import replacing
from ..lights.division import emitter_shapes
from ..lights.light_cells import LightCells
from ..regions.surface_rows import BYTES_PER_VOXEL, SurfaceRows, voxel_edges
from .light_map import BYTES_PER_ENTRY, MOST_SQUARED, LightMap

_FORMAT = 2

#: The finest grid of a map, and a bound of the coordinates that keeps their differences finite.
_MOST_VOXELS, _LARGEST = 1024, 1e38


@dataclass
class _Stored:
    """The contents of a file, besides the number of its format.

    Attributes:
        scene: Fingerprint of the scene.
        bbox, resolution, p, n: Parameters of the rows; p and n of shape [3, vertices].
        tests, successes, squares: The counters; shape [rows, cells]. The cells are in the order
            of their lights' digests: that of a scene's emitters differs from process to process.
    """

    scene: np.ndarray
    bbox: np.ndarray
    resolution: np.ndarray
    p: np.ndarray
    n: np.ndarray
    tests: np.ndarray
    successes: np.ndarray
    squares: np.ndarray


#: Kinds of types and numbers of dimensions of these arrays.
_TYPES = {
    "scene": ("U", 0), "bbox": ("f", 2), "resolution": ("iu", 0), "p": ("f", 2), "n": ("f", 2),
    "tests": ("u", 2), "successes": ("u", 2), "squares": ("u", 2),
}  # fmt: skip


def arrays_of(scene: mi.Scene, light_map: LightMap) -> dict[str, np.ndarray]:
    """A map as arrays, with a fingerprint of the scene that it belongs to."""
    rows, cells = light_map.rows, light_map.cells
    order = _cell_order(scene, cells)
    counts = (light_map.tests, light_map.successes, light_map.squares)
    tests, successes, squares = (c.numpy().reshape(-1, cells.count)[:, order] for c in counts)
    stored = _Stored(
        scene=np.array(fingerprint(scene)),
        bbox=np.array([rows.bbox.min, rows.bbox.max], dtype=np.float32),
        resolution=np.array(rows.resolution),
        p=rows.p.numpy(),
        n=rows.n.numpy(),
        tests=tests,
        successes=successes,
        squares=squares,
    )
    return vars(stored)


def save(path: Path, scene: mi.Scene, light_map: LightMap) -> None:
    """Writes a map."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, format=_FORMAT, **arrays_of(scene, light_map))


def of_arrays(arrays: dict[str, np.ndarray], scene: mi.Scene) -> LightMap:
    """The map from the arrays of :func:`arrays_of`, for the same scene."""
    return _light_map(_Stored(**arrays), scene, 0)


def load(
    path: Path, scene: mi.Scene, samples: int, max_memory: int, parameter: str = "load_map"
) -> LightMap:
    """Reads a map.

    Parameters:
        path: The file.
        scene: The scene of the map.
        samples: Approximate number of samples that will be observed in addition.
        max_memory: The most bytes that the map may take.
        parameter: The parameter that named the file, for errors.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no light map, damaged, too large, or the map of another scene.
    """
    if not path.exists():
        raise FileNotFoundError(
            f'{parameter} names "{path}", which does not exist: give it a file that "save_map" '
            f"wrote"
        )
    try:
        return _load(path, scene, samples, max_memory)
    except ValueError as error:
        raise ValueError(f'{parameter} names "{path}", which {error}') from None


def _load(path: Path, scene: mi.Scene, samples: int, max_memory: int) -> LightMap:
    stored = _read(path)
    if str(stored.scene) != fingerprint(scene):
        raise ValueError(
            "belongs to another scene, or this one has changed since: delete it, and learn it again"
        )
    _check(stored)
    resolution = int(stored.resolution)
    memory = stored.tests.size * BYTES_PER_ENTRY + resolution**3 * BYTES_PER_VOXEL
    if memory > max_memory:
        raise ValueError(
            f"needs {memory / 2**20:.1f} MiB, more than the {max_memory / 2**20:g} of "
            f'"max_memory": raise it, or learn a coarser map'
        )
    return _light_map(stored, scene, samples)


def _light_map(stored: _Stored, scene: mi.Scene, samples: int) -> LightMap:
    resolution = int(stored.resolution)
    bbox = mi.ScalarBoundingBox3f(*stored.bbox)
    rows = SurfaceRows(bbox, resolution, mi.Point3f(stored.p), mi.Normal3f(stored.n))
    cells = LightCells(scene, voxel_edges(bbox, resolution))
    _require(
        stored.tests.shape == (rows.count, cells.count),
        f"counts of {stored.tests.shape[0]} rows and {stored.tests.shape[1]} cells, where there "
        f"are {rows.count} and {cells.count}",
    )
    light_map = LightMap(scene, rows, cells, samples)
    place = np.argsort(_cell_order(scene, cells))
    light_map.restore(
        from_numpy(mi.UInt32, stored.tests[:, place]),
        from_numpy(mi.UInt32, stored.successes[:, place]),
        from_numpy(mi.UInt64, stored.squares[:, place]),
    )
    return light_map


def _read(path: Path) -> _Stored:
    """Reads the arrays of a file, and checks their types and dimensions."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files if name in {*_TYPES, "format"}}
    except Exception:  # NumPy, zipfile and zlib raise a dozen kinds for files that are no maps
        raise ValueError(
            'is no light map, or has been damaged: give it a file that "save_map" wrote'
        ) from None
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise ValueError("is no light map of this version: delete it, and learn it again")
    for name, (kinds, dimensions) in _TYPES.items():
        array = arrays.get(name)
        _require(array is not None, f'without the array "{name}"')
        _require(
            array.dtype.kind in kinds and array.ndim == dimensions,
            f'the array "{name}" is of type {array.dtype} and shape {array.shape}',
        )
        if kinds == "f":
            with np.errstate(over="ignore"):  # infinite ones are refused
                arrays[name] = array.astype(np.float32)
    return _Stored(**arrays)


def _check(stored: _Stored) -> None:
    """Checks the shapes and the values of the arrays: later code computes addresses from them."""
    _require(
        1 <= int(stored.resolution) <= _MOST_VOXELS, f"resolution {int(stored.resolution)}"
    )
    bbox = stored.bbox
    is_finite = bbox.shape == (2, 3) and bool((np.abs(bbox) < _LARGEST).all())
    _require(is_finite and bool((bbox[0] < bbox[1]).all()), '"bbox" is no box')
    for name in ("p", "n"):
        array = getattr(stored, name)
        _require(
            array.shape[0] == 3 and array.shape[1] > 0 and array.shape == stored.p.shape,
            f'the array "{name}" has the shape {array.shape}',
        )
        _require(bool(np.isfinite(array).all()), f'values of "{name}" are not finite')
    p = stored.p.T
    _require(bool(((bbox[0] <= p) & (p <= bbox[1])).all(axis=1).any()), '"p" is outside of "bbox"')
    for name in ("successes", "squares"):
        _require(
            getattr(stored, name).shape == stored.tests.shape,
            f'the array "{name}" has the shape {getattr(stored, name).shape} instead of '
            f"{stored.tests.shape}",
        )
    tests = stored.tests.astype(np.uint64)
    _require(bool((tests <= 0xFFFFFFFF).all()), 'values of "tests" are too large')
    _require(bool((stored.successes <= tests).all()), 'there are more "successes" than "tests"')
    _require(bool((stored.squares <= tests * MOST_SQUARED).all()), '"squares" are too large')


def _require(condition: bool, fault: str) -> None:
    if not condition:
        raise ValueError(f"has been damaged ({fault}): delete it, and learn it again")


# ---- Fingerprints of scenes and lights ----


def fingerprint(scene: mi.Scene) -> str:
    """A hash of shapes, materials and lights, without sensors and films."""
    # Sorted: their order differs from one loading of a scene to the next
    digests = sorted(_of(part) for part in [*scene.shapes(), *scene.emitters()])
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _cell_order(scene: mi.Scene, cells: LightCells) -> np.ndarray:
    """The cells of a scene in the order of their lights' digests. Equal lights at one place are
    interchangeable."""
    lights = zip(scene.emitters(), emitter_shapes(scene))
    digests = [_of(emitter) + (_of(shape) if shape else b"") for emitter, shape in lights]
    rank = np.empty(len(digests), dtype=int)
    rank[sorted(range(len(digests)), key=digests.__getitem__)] = np.arange(len(digests))
    return np.argsort(rank[cells.emitter_index], kind="stable")


def _of(scene_object: mi.Object) -> bytes:
    digest = hashlib.sha256(scene_object.class_name().encode())
    parameters = mi.traverse(scene_object)
    for key in sorted(parameters.keys()):
        value = parameters[key]
        digest.update(key.encode())
        if dr.is_tensor_v(value):
            value = value.array
        digest.update(np.ascontiguousarray(value).tobytes() if dr.is_array_v(value)
                      else repr(value).encode())
    return digest.digest()
