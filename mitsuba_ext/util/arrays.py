"""Makes and joins Dr.Jit arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

#: Alignment of Dr.Jit's own arrays, in bytes.
_ALIGNMENT = 64

T = TypeVar("T")


def from_numpy(kind: type[T], values: Any) -> T:
    """Copies ``values``, a NumPy array or something convertible to one, to a flat Dr.Jit array.

    Dr.Jit itself uses NumPy's memory without a copy, and its kernels depend on whether that memory
    is aligned. Alignment varies by chance, so every other render would compile separate kernels.

    Parameters:
        kind: The type of the result, such as ``mi.Float``.
    """
    dtype = np.dtype(dr.type_v(kind).name.lower())
    values = np.asarray(values)
    memory = np.empty(values.size * dtype.itemsize + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    aligned = memory[start : start + values.size * dtype.itemsize].view(dtype)
    aligned[:] = values.ravel()
    return kind(aligned)


def channel_mean(value: Any) -> mi.Float:
    """The mean of the channels of a colour or spectrum, for each lane.

    ``dr.mean`` computes the same, but divides and multiplies by the number of lanes, which becomes
    a literal, so each pass length would compile a separate kernel.
    """
    return dr.sum(value) * (1 / len(value))


def to_host(*columns: Any) -> list[np.ndarray]:
    """Copies flat arrays of 32-bit numbers to the host, all at once, because each copy waits for
    the device. They have the same width, or only one element."""
    words = mi.ArrayXu([dr.reinterpret_array(dr.uint32_array_t(x), x) for x in columns])
    rows = dr.ravel(words).numpy().reshape(-1, len(columns))
    types = (np.dtype(dr.type_v(x).name.lower()) for x in columns)
    return [np.ascontiguousarray(row).view(type_) for row, type_ in zip(rows.T, types)]


def host_copy(value: Any) -> np.ndarray:
    """Copies an array of the scene to the host, and leaves the array as it is. NumPy alone would
    evaluate literals in place: later kernels would load what earlier ones contain as numbers, and
    the second render of a scene would differ from the first one by rounding."""
    copy = type(value)(value)
    dr.make_opaque(copy)
    return np.array(copy)


def add_own(target: T, value: Any, index: mi.UInt32, active: mi.Bool | bool = True) -> None:
    """Adds values to array elements, each of which belongs to one lane.

    ``dr.scatter_add`` would do the same. But because several lanes could share an element, Dr.Jit
    gives each thread a copy of any array with fewer than a million numbers, and kernels then
    contain its size: with one element per lane, each pass length would compile a separate kernel.
    """
    dr.scatter_add(target, value, index, active, dr.ReduceMode.NoConflicts)


def put(target: T, value: Any, place: mi.UInt32) -> None:
    """Writes to elements that nothing else writes to. ``dr.scatter`` alone would first evaluate
    what was written to the array before: a kernel each time instead of one for all."""
    dr.scatter(target, value, place, mode=dr.ReduceMode.Permute)


def joined(parts: Sequence[T]) -> T:
    """Concatenates arrays, vectors of arrays, or dataclasses of these or of ``None``, all of one
    type, and evaluates the result. (``dr.concat`` compiles kernels for each size.)"""
    if len(parts) == 1 and dr.depth_v(parts[0]) == 1:
        # Opaque, because the result is not a literal with several parts either
        dr.make_opaque(parts[0])
        return parts[0]
    widths = [dr.width(part) for part in parts]
    results = [dr.empty(type(column), sum(widths)) for column in _columns(parts[0])]
    offset = 0
    for part, width in zip(parts, widths):
        index = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, offset)
        for result, column in zip(results, _columns(part)):
            dr.scatter(result, column, index)
        # One kernel for all columns: the next part would evaluate each of them separately
        dr.eval(results)
        offset += width
    return _of_columns(parts[0], iter(results))


def _columns(part: Any) -> list[Any]:
    """The flat arrays in a part."""
    if part is None:
        return []
    if is_dataclass(part):
        part = [getattr(part, field.name) for field in fields(part)]
    elif dr.depth_v(part) == 1:
        return [part]
    return [column for x in part for column in _columns(x)]


def _of_columns(part: Any, columns: Iterator[Any]) -> Any:
    """An object like ``part`` with these flat arrays."""
    if part is None:
        return None
    kind = type(part)
    if kind is list:
        return [_of_columns(x, columns) for x in part]
    if is_dataclass(kind):
        return kind(*(_of_columns(getattr(part, field.name), columns) for field in fields(kind)))
    if dr.depth_v(kind) > 1:
        return kind(*(_of_columns(x, columns) for x in part))
    return next(columns)
