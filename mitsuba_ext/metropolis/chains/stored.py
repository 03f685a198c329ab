"""The state of a render with chains as NumPy arrays, for files."""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import from_numpy
from ..path_space.memory import Head, Logs, Place
from .path_target import PathState
from .target import Contribution

#: Arrays by name.
Arrays = dict[str, np.ndarray]


class StateFile(Protocol):
    """A file that holds the state of a render."""

    def load(self) -> Arrays | None:
        """The saved state; ``None`` if none was saved yet."""

    def save(self, arrays: Arrays) -> None:
        """Saves a state, which replaces the one before."""


def arrays_of(value: Any, name: str) -> Arrays:
    """The arrays of which ``value`` consists. It may be a Dr.Jit array, a random number generator,
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


def value_of(arrays: Arrays, name: str) -> Any:
    """The inverse of :func:`arrays_of`."""
    if name in arrays:
        return _array(arrays[name])
    prefix = f"{name}/"
    keys = {k.removeprefix(prefix).partition("/")[0] for k in arrays if k.startswith(prefix)}
    parts = {key: value_of(arrays, f"{name}/{key}") for key in keys}
    kind, _, is_structure = next(iter(parts)).partition(".")
    if not is_structure:
        return [parts[key] for key in sorted(parts, key=int)]
    made = dr.zeros(_kinds()[kind])
    for key, part in parts.items():
        field = key.partition(".")[2]
        # An array alone does not tell if it is a point or a colour
        wanted = type(getattr(made, field))
        setattr(made, field, part if isinstance(part, wanted) else wanted(part))
    return made


def _kinds() -> dict[str, type]:
    """The names of structures in files."""
    return {
        "rng": mi.PCG32, "found": Contribution, "path": PathState, "head": Head, "place": Place,
        "logs": Logs,
    }  # fmt: skip


def _array(array: np.ndarray) -> Any:
    if array.ndim == 2:
        return {2: mi.Point2f, 3: mi.Color3f}[len(array)](array)
    kinds = {"float32": mi.Float, "uint32": mi.UInt32, "uint64": mi.UInt64}
    return from_numpy(kinds[array.dtype.name], array)
