"""Sorts the rows of a table."""

from __future__ import annotations

import numpy as np

_LOW = np.uint64(0xFFFFFFFF)

#: The number of columns numbered at a time.
_CHUNK = 1 << 16


def separated(values: np.ndarray, left: int) -> np.ndarray:
    """The order, over all rows, in which each row begins with its ``left`` smallest values.

    Parameters:
        values: Shape (rows, size), float32. Overwritten.

    Returns:
        Indices of the flattened table. Shape (rows * size,), int64.
    """
    keys = _keys(values)
    del values  # a single row with all triangles takes much memory
    keys.partition(left, axis=1)
    return _places(keys)


def sorted_rows(values: np.ndarray) -> np.ndarray:
    """The order, over all rows, in which each row is sorted; see :func:`separated`."""
    keys = _keys(values)
    keys.sort(axis=1)
    return _places(keys)


def _keys(values: np.ndarray) -> np.ndarray:
    """Integers that sort like the values, with their columns in the lower half."""
    bits = values.view(np.uint32)
    # All bits of negative numbers, the sign bit of others
    flips = bits.view(np.int32) >> 31
    flips |= np.int32(-(1 << 31))
    bits ^= flips.view(np.uint32)
    del flips
    keys = np.empty(values.shape, dtype="<u8")
    halves = keys.view("<u4").reshape(*values.shape, 2)
    halves[:, :, 1] = bits
    for first in range(0, values.shape[1], _CHUNK):
        columns = halves[:, first : first + _CHUNK, 0]
        columns[:] = np.arange(first, first + columns.shape[1], dtype="<u4")
    return keys


def _places(keys: np.ndarray) -> np.ndarray:
    rows, size = keys.shape
    keys &= _LOW
    keys += np.arange(rows, dtype=np.uint64)[:, None] * np.uint64(size)
    return keys.ravel().view(np.int64)
