"""Light maps in files: what was learned from one view of a scene serves the others."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..files import replacing
from ..lights.light_cells import LightCells
from .light_map import LightMap
from .surface_rows import SurfaceRows, voxel_edges

_FORMAT = 1

#: What a file holds besides its format.
_ARRAYS = {"scene", "bbox", "resolution", "p", "n", "tests", "successes", "squares"}


def save(path: Path, scene: mi.Scene, light_map: LightMap) -> None:
    """Writes a map, with a fingerprint of the scene that it belongs to."""
    rows = light_map.rows
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            format=_FORMAT,
            scene=fingerprint(scene),
            bbox=np.array([rows.bbox.min, rows.bbox.max]),
            resolution=rows.resolution,
            p=rows.p.numpy(),
            n=rows.n.numpy(),
            tests=light_map.tests.numpy(),
            successes=light_map.successes.numpy(),
            squares=light_map.squares.numpy(),
        )


def load(path: Path, scene: mi.Scene, samples: int = 0) -> LightMap:
    """Reads a map, to which about so many ``samples`` will be added.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no light map, or one of another scene.
    """
    try:
        with np.load(path) as data:
            stored = dict(data)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, FileNotFoundError):
            raise FileNotFoundError(f'there is no light map "{path}"') from None
        raise ValueError(f'"{path}" is not a light map: {error}') from None
    if stored.get("format") != _FORMAT or not stored.keys() >= _ARRAYS:
        raise ValueError(f'"{path}" is not a light map of this version')
    if str(stored["scene"]) != fingerprint(scene):
        raise ValueError(
            f'the light map "{path}" belongs to another scene, or this one has changed since: '
            f"delete it, and learn it again"
        )
    bbox = mi.ScalarBoundingBox3f(*stored["bbox"])
    p, n = mi.Point3f(stored["p"]), mi.Normal3f(stored["n"])
    rows = SurfaceRows(bbox, int(stored["resolution"]), p, n)
    cells = LightCells(scene, voxel_edges(bbox, rows.resolution))
    light_map = LightMap(scene, rows, cells, samples)
    if len(light_map.tests) != len(stored["tests"]):
        raise ValueError(f'the light map "{path}" has been damaged: delete it, and learn it again')
    light_map.restore(
        *(mi.UInt32(stored[name]) for name in ("tests", "successes")),
        mi.UInt64(stored["squares"]),
    )
    return light_map


def fingerprint(scene: mi.Scene) -> str:
    """A hash of shapes, materials and lights; sensors and films do not count."""
    # Sorted: their order differs from one loading of a scene to the next
    digests = sorted(_of(part) for part in [*scene.shapes(), *scene.emitters()])
    return hashlib.sha256(b"".join(digests)).hexdigest()


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
