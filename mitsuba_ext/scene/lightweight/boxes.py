"""Boxes as rows of lower and upper corners (swapped in empty boxes). Shape (6, …), float32."""

from __future__ import annotations

import functools

import numpy as np

#: The axis length below which NumPy's reductions are slow.
_SHORT_AXIS = 8


def around(boxes: np.ndarray) -> np.ndarray:
    """The bounding boxes of the boxes along the last axis."""
    return np.concatenate([_reduced(np.minimum, boxes[:3]), _reduced(np.maximum, boxes[3:])])


def area(boxes: np.ndarray) -> np.ndarray:
    """Half the surface area of each box."""
    x, y, z = boxes[3:] - boxes[:3]
    return x * y + y * z + z * x


def _reduced(union: np.ufunc, values: np.ndarray) -> np.ndarray:
    while (size := values.shape[-1]) > _SHORT_AXIS:
        half = size // 2
        folded = union(values[..., :half], values[..., half : 2 * half])
        if size % 2:
            folded[..., 0] = union(folded[..., 0], values[..., -1])
        values = folded
    return functools.reduce(union, (values[..., k] for k in range(values.shape[-1])))
