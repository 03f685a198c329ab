"""Sorts the rows of a table."""

from __future__ import annotations

import numpy as np

_LOW = np.uint64(0xFFFFFFFF)


def separated(values: np.ndarray, left: int) -> np.ndarray:
    """The order, over all rows, in which each row begins with its ``left`` smallest values.

    Parameters:
        values: Shape (rows, size), float32. Overwritten.

    Returns:
        Indices of the flattened table. Shape (rows * size,), int64.
    """
    keys = _keys(values)
    del values  # for one row with all triangles, this is much
    keys.partition(left, axis=1)
    return _places(keys)


def sorted_rows(values: np.ndarray) -> np.ndarray:
    """The order, over all rows, in which each row is sorted; see :func:`separated`."""
    keys = _keys(values)
    keys.sort(axis=1)
    return _places(keys)


def _keys(values: np.ndarray) -> np.ndarray:
    """Integers that sort as the values do, with their places in the lower half."""
    bits = values.view(np.uint32)
    bits ^= (bits.view(np.int32) >> 31).view(np.uint32) | np.uint32(1 << 31)
    keys = bits.astype(np.uint64)
    keys <<= np.uint64(32)
    keys |= np.arange(values.shape[1], dtype=np.uint32)
    return keys


def _places(keys: np.ndarray) -> np.ndarray:
    rows, size = keys.shape
    keys &= _LOW
    keys += np.arange(rows, dtype=np.uint64)[:, None] * np.uint64(size)
    return keys.ravel().view(np.int64)
