"""The nodes of the tree: the boxes of four children in 32 bytes.

Cline 2007 stores boxes as bytes or shorts relative to the box of the mesh. Bytes are too coarse for
meshes of more than a few thousand triangles, and shorts take twice the memory of bytes. Here, bytes
are relative to the node itself. Its lower corner is a point of a grid over the mesh, with 16 bits
for each coordinate. For each axis, the unit of its bytes is a power of two times the grid's unit
(as in [1]). All these numbers are exact in single precision. With four triangles in a leaf, nodes
take 3.2 bytes per triangle (with shorts, 4.7), and boxes are nearly as tight as with floats.

[1] Ylitie, Karras, Laine. Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs.
HPG 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .heap import ARITY

#: The number of words of a node, and the largest coordinate of the grid.
WORDS, RANGE = 8, 255 * 256

#: The exponent of the unit of bytes that is stored as 0: the unit is 2**(stored + this).
MIN_EXPONENT = -7
_MAX_EXPONENT = 8

#: The number of nodes encoded at a time.
_CHUNK = 1 << 16


@dataclass(frozen=True)
class Grid:
    """The grid over a mesh: the world space position of a point is ``low + point / scale``.

    Attributes:
        low: The lower corner of the mesh. Shape (3,), float32.
        scale: The number of grid units per unit of world space. Shape (3,), float32.
    """

    low: np.ndarray
    scale: np.ndarray

    @classmethod
    def over(cls, low: np.ndarray, high: np.ndarray) -> Grid:
        """The grid over a box."""
        # No axis is much finer than the others, because flat meshes have an axis without extent
        extent = np.maximum(high.astype(np.float64) - low, 1e-6 * max(np.ptp([low, high]), 1e-30))
        scale = np.nextafter((RANGE / extent).astype(np.float32), np.float32(0))
        return cls(low.astype(np.float32), scale)

    def points(self, p: np.ndarray) -> np.ndarray:
        """Points of world space in units of the grid, float64."""
        return (p.astype(np.float64) - self.low) * self.scale


def encode(children: np.ndarray, grid: Grid) -> np.ndarray:
    """The words of inner nodes.

    Parameters:
        children: The boxes of the children of each node, as in ``Hierarchy``. Shape (6, nodes, 4).

    Returns:
        For each node, six words with the bytes of its four children (lower x, y, z; upper x, y, z),
        then two with its corner (three times 16 bits) and its exponents (three times 4 bits).
        Shape (nodes, 8), uint32.
    """
    nodes = children.shape[1]
    words = np.empty((nodes, WORDS), dtype=np.uint32)
    for first in range(0, nodes, _CHUNK):
        part = children[:, first : first + _CHUNK]
        words[first : first + _CHUNK] = _encode(part.reshape(2, 3, -1, ARITY), grid)
    return words


def _encode(children: np.ndarray, grid: Grid) -> np.ndarray:
    low, high = (grid.points(c.reshape(3, -1).T).T.reshape(c.shape) for c in children)
    is_empty = np.isinf(low[0])
    corner = np.floor(low.min(axis=2))
    extent = np.where(is_empty, -np.inf, high).max(axis=2) - corner
    exponent = np.ceil(np.log2(np.maximum(extent, 1e-9) / 255))
    exponent += extent > 255 * np.exp2(exponent)  # if the logarithm was rounded down
    exponent = np.clip(exponent, MIN_EXPONENT, _MAX_EXPONENT)
    unit = np.exp2(exponent)
    low = np.floor((low - corner[..., None]) / unit[..., None])
    high = np.ceil((high - corner[..., None]) / unit[..., None])
    # No ray meets a box whose lower side is above its upper one
    low = np.where(is_empty, 255, low).astype(np.uint32)
    high = np.where(is_empty, 0, np.minimum(high, 255)).astype(np.uint32)
    bytes_ = [sum(side[..., c] << np.uint32(8 * c) for c in range(ARITY)) for side in (low, high)]
    x, y, z = corner.astype(np.uint32)
    ex, ey, ez = (exponent - MIN_EXPONENT).astype(np.uint32)
    frame = [x | y << 16, z | ex << 16 | ey << 20 | ez << 24]
    return np.stack([*bytes_[0], *bytes_[1], *frame], axis=1)
