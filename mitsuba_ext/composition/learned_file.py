"""Files with everything that a render has learned."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..files import replacing
from ..maps.light_map_file import fingerprint

#: Version of the format of these files.
_FORMAT = 2

#: For each slot, the arrays from which the decision of the last stage is made.
States = dict[str, dict[str, np.ndarray]]


def save(path: Path, scene: mi.Scene, made_by: str, states: Mapping[str, Mapping]) -> None:
    """Writes what was learned.

    Parameters:
        path: The file.
        scene: The scene for which it was learned.
        made_by: The parameters of the decisions that learned, and the size of the film.
        states: For each slot, the result of ``Learner.state``.
    """
    arrays = {
        f"{slot}/{name}": array for slot, state in states.items() for name, array in state.items()
    }
    header = {
        "format": np.array(_FORMAT),
        "scene": np.array(fingerprint(scene)),
        "made_by": np.array(made_by),
        "digest": np.array(_digest(arrays)),
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **header, **arrays)


def load(path: Path, scene: mi.Scene, made_by: str, parameter: str) -> States:
    """Reads what :func:`save` has written.

    Parameters:
        path, scene, made_by: As for :func:`save`.
        parameter: The name, in error messages, of the parameter that names the file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is of another kind, damaged, or of another scene or other parameters.
    """
    if not path.exists():
        raise FileNotFoundError(
            f'{parameter} names "{path}", which does not exist: give it a file that "save_learned" '
            f"wrote"
        )
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except Exception:  # NumPy, zipfile and zlib raise many kinds of exceptions
        raise ValueError(f'{parameter} names "{path}", which is damaged, or no such file') from None
    header = {key: str(arrays.pop(key, "")) for key in ("format", "scene", "made_by", "digest")}
    if header["format"] != str(_FORMAT) or header["digest"] != _digest(arrays):
        raise ValueError(
            f'{parameter} names "{path}", which has been damaged, or comes from another version: '
            f"delete it, and begin again"
        )
    if header["scene"] != fingerprint(scene):
        raise ValueError(
            f'{parameter} names "{path}", which belongs to another scene, or this one has changed: '
            f"delete it, and begin again"
        )
    if header["made_by"] != made_by:
        raise ValueError(
            f'{parameter} names "{path}", which was made with other parameters: '
            f'{header["made_by"]} instead of {made_by}'
        )
    states: States = {}
    for key, array in arrays.items():
        slot, _, name = key.partition("/")
        states.setdefault(slot, {})[name] = array
    return states


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
