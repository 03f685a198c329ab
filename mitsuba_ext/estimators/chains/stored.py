"""The state of a render with chains as NumPy arrays, for files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .path_space.memory import Head, Logs, Place
from .path_target import ChainPath
from .target import Contribution

#: Arrays by name.
Arrays = dict[str, np.ndarray]

#: The part of a :class:`~mitsuba_ext.planning.learned_file.LearnedFile` that holds them.
PART = "chains"

#: The maximum number of elements of an array whose length the reader does not know.
_MAX_NUMBERS = 1 << 27

#: The minimum and the maximum value of an array or a field, by its name.
Ranges = Mapping[str, tuple[Any, Any]]


def arrays_of(value: Any, name: str) -> Arrays:
    """The arrays that make up ``value``, which may be a Dr.Jit array, a random number generator,
    one of the structures of :func:`_kinds`, or a list of these."""
    kinds = {made: kind for kind, made in _kinds().items()}
    if isinstance(value, list):
        parts = {str(index): part for index, part in enumerate(value)}
    elif isinstance(value, mi.PCG32):
        parts = {"rng.state": value.state, "rng.inc": value.inc}
    elif type(value) in kinds:
        parts = {f"{kinds[type(value)]}.{key}": part for key, part in vars(value).items()}
    else:
        return {name: value.numpy()}
    found = (arrays_of(part, f"{name}/{key}") for key, part in parts.items())
    return {key: array for arrays in found for key, array in arrays.items()}


def value_of(
    stored: StoredArrays, name: str, kind: type | list, width: int | None, ranges: Ranges
) -> Any:
    """The inverse of :func:`arrays_of`.

    Parameters:
        stored: The arrays of the file.
        name: The name passed to :func:`arrays_of`.
        kind: The type of the value, or a list of types.
        width: The number of lanes; ``None`` for any number that all parts of a structure share.
        ranges: The minimum and the maximum value of arrays and of the fields of structures, by
            name. Other real numbers must be finite.

    Raises:
        DamagedError: The file has no such value.
    """
    if isinstance(kind, list):
        parts = (f"{name}/{index}" for index in range(len(kind)))
        return [value_of(stored, part, k, width, ranges) for part, k in zip(parts, kind)]
    names = {made: name for name, made in _kinds().items()}
    if kind not in names:
        least, most = ranges.get(name) or ranges.get(_field(name)) or (None, None)
        return _array(stored, name, kind, width, least, most)
    made = dr.zeros(kind)
    fields = {"state": mi.UInt64, "inc": mi.UInt64} if kind is mi.PCG32 else {
        key: type(value) for key, value in vars(made).items()
    }  # fmt: skip
    for key, its_kind in fields.items():
        part = f"{name}/{names[kind]}.{key}"
        value = value_of(stored, part, its_kind, width, ranges)
        width = dr.width(value) if width is None else width
        setattr(made, key, value)
    return made


def _field(name: str) -> str:
    """The last part of a name: the field of a structure."""
    return name.rpartition("/")[2].rpartition(".")[2]


def _kinds() -> dict[str, type]:
    """The structures in files, by name."""
    return {
        "rng": mi.PCG32, "found": Contribution, "path": ChainPath, "head": Head, "place": Place,
        "logs": Logs,
    }  # fmt: skip


def _array(
    stored: StoredArrays, name: str, kind: type, width: int | None, least: float | None,
    most: float | None,
) -> Any:  # fmt: skip
    letter = {dr.VarType.Float32: "f", dr.VarType.Float64: "f"}.get(dr.type_v(kind), "u")
    size = () if dr.depth_v(kind) == 1 else (dr.size_v(kind),)
    longest = _MAX_NUMBERS if width is None else width * math.prod(size)
    array = stored.take(name, letter, (*size, width), least, most, longest)
    return kind(array) if size else from_numpy(kind, array)
