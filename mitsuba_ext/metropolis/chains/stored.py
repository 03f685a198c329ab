"""The state of a render with chains as arrays of NumPy, for files."""

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
    """Where the state of a render is kept."""

    def load(self) -> Arrays | None:
        """What was saved; ``None`` if nothing was yet."""

    def save(self, arrays: Arrays) -> None:
        """Keeps this, and nothing else."""


def arrays_of(value: Any, name: str) -> Arrays:
    """The arrays of which ``value`` consists: an array of Dr.Jit, a generator of random numbers,
    what chains keep of paths, or a list of such."""
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
    """What :func:`arrays_of` has taken apart."""
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
        # Arrays do not say whether they are points or colours
        wanted = type(getattr(made, field))
        setattr(made, field, part if isinstance(part, wanted) else wanted(part))
    return made


def _kinds() -> dict[str, type]:
    """What files call structures."""
    return {
        "rng": mi.PCG32, "found": Contribution, "path": PathState, "head": Head, "place": Place,
        "logs": Logs,
    }  # fmt: skip


def _array(array: np.ndarray) -> Any:
    if array.ndim == 2:
        return {2: mi.Point2f, 3: mi.Color3f}[len(array)](array)
    kinds = {"float32": mi.Float, "uint32": mi.UInt32, "uint64": mi.UInt64}
    return from_numpy(kinds[array.dtype.name], array)
