"""The tree of a mesh: its construction, and the intersections of rays with its nodes and leaves."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .building import INNER_BITS, TOP, build
from .heap import ARITY, HEAP_BITS, LEAF_SIZE
from .nodes import MIN_EXPONENT, RANGE, WORDS, Grid, encode
from .slabs import ERROR, with_inverse
from .traversal import NONE, Hit, traverse
from .triangles import Projection

#: The number of triangles read at a time.
_CHUNK = 1 << 18

#: The number of the first leaf.
LEAF = 1 << 31

#: Stack sizes are multiples of this.
_STACK_STEP = 48


class TriangleCorners(Protocol):
    """The triangles of a mesh, in the order of the tree."""

    def corners(self, triangle: mi.UInt32, active: mi.Bool) -> list[mi.Point3f]:
        """The three corners of a triangle."""


def positions_and_faces(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of a mesh, and the vertex indices of each triangle. Shapes (vertices, 3),
    (triangles, 3). On the CPU, this is the memory of the mesh.

    Raises:
        ValueError: A vertex is not finite.
    """
    parameters = mi.traverse(mesh)
    positions = parameters["vertex_positions"].numpy().reshape(-1, 3)
    is_finite = np.isfinite(positions).all(axis=1)
    if not is_finite.all():
        raise ValueError(
            f'"lightweight_mesh": the nested mesh cannot be used: its vertex '
            f"{np.argmin(is_finite)} is not finite"
        )
    return positions, parameters["faces"].numpy().reshape(-1, 3)


class MeshTree:
    """A tree over triangles.

    Parameters:
        vertices: Positions. Shape (vertices, 3), float32.
        faces: The vertices of each triangle. Shape (triangles, 3), uint32.

    Attributes:
        order: The triangles in the order of the leaves, as in ``TriangleCorners``. Shape
            (triangles,), uint32.
        grid (Grid): The grid in whose units boxes are stored.
        nbytes (int): The memory of the nodes, in bytes.
        stack_size (int): The capacity of a traversal's stack, in nodes.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        boxes = _boxes(vertices, faces)
        self.grid = Grid.over(boxes[:3].min(axis=1), boxes[3:].max(axis=1))
        hierarchy = build(boxes)
        del boxes
        words = self.words(hierarchy.children)
        self.order = hierarchy.order
        # Rounded up to one of few sizes, so that trees share the kernel
        self.stack_size = -(-hierarchy.stack_size // _STACK_STEP) * _STACK_STEP
        self.nbytes = words.nbytes + hierarchy.headers.nbytes
        self.nodes = from_numpy(mi.UInt32, words)
        self.headers = from_numpy(mi.UInt32, hierarchy.headers)
        self.low, self.scale = mi.Point3f(self.grid.low), mi.Vector3f(self.grid.scale)
        self.size = mi.UInt32(len(faces))
        # Opaque so that the trees of other meshes share the kernel
        dr.make_opaque(self.low, self.scale, self.size)

    def words(self, children: np.ndarray) -> np.ndarray:
        """The nodes as they are stored. Shape (nodes, words)."""
        return encode(children, self.grid)

    def closest(self, ray: mi.Ray3f, corners: TriangleCorners, active: mi.Bool) -> Hit:
        """The closest hit of each ray before ``ray.maxt``."""
        return traverse(RaysInTree(self, ray, corners), ray, active, any_hit=False)

    def occluded(self, ray: mi.Ray3f, corners: TriangleCorners, active: mi.Bool) -> mi.Bool:
        """Whether there is a hit before ``ray.maxt``."""
        return traverse(RaysInTree(self, ray, corners), ray, active, any_hit=True)[1] != NONE


class RaysInTree:
    """Rays that traverse a tree."""

    root = 0

    def __init__(self, tree: MeshTree, ray: mi.Ray3f, corners: TriangleCorners) -> None:
        self._tree, self._corners, self._projection = tree, corners, Projection(ray)
        self.stack_size = tree.stack_size
        # In the space of the grid, with the same distances
        self._o = (ray.o - tree.low) * tree.scale
        self._inverse = with_inverse(ray.d * tree.scale)[1]
        self._error = ERROR * (dr.abs(self._o) + RANGE) * dr.abs(self._inverse)

    def is_leaf(self, node):
        return node >= LEAF

    def children(self, node, maxt):
        number, index = node >> HEAP_BITS, node & ((1 << HEAP_BITS) - 1)
        address, first = dr.gather(mi.Array2u, self._tree.headers, number)
        inner, address = address & TOP, address >> INNER_BITS

        def child(c):
            in_heap = ARITY * index + 1 + c
            is_leaf = in_heap >= inner
            in_treelet = dr.select(is_leaf, LEAF + first - inner + in_heap, node - index + in_heap)
            return dr.select(inner == TOP, (first + c) << HEAP_BITS, in_treelet)

        return self.distances(address + index, maxt), child

    def distances(self, address, maxt):
        """For each child of a node, the distance of its box, and whether rays meet it."""
        words = [
            word
            for half in range(2)
            for word in dr.gather(mi.Array4u, self._tree.nodes, WORDS // 4 * address + half)
        ]
        x_y, z_and_exponents = words[6:]
        corner = [x_y & 0xFFFF, x_y >> 16, z_and_exponents & 0xFFFF]
        near, far, start, end, unit = [], [], [], [], []
        for k in range(3):
            exponent = (z_and_exponents >> (16 + 4 * k)) & 15
            power = dr.reinterpret_array(mi.Float, (exponent + (127 + MIN_EXPONENT)) << 23)
            unit.append(power * self._inverse[k])
            distance = (mi.Float(mi.Int32(corner[k])) - self._o[k]) * self._inverse[k]
            start.append(distance - self._error[k])
            end.append(distance + self._error[k])
            is_reversed = self._inverse[k] < 0
            near.append(dr.select(is_reversed, words[3 + k], words[k]))
            far.append(dr.select(is_reversed, words[k], words[3 + k]))
        results = []
        for c in range(ARITY):
            enter, leave = mi.Float(0), maxt
            for k in range(3):
                enter = dr.maximum(enter, dr.fma(_byte(near[k], c), unit[k], start[k]))
                leave = dr.minimum(leave, dr.fma(_byte(far[k], c), unit[k], end[k]))
            results.append((enter, enter <= leave))
        return results

    def intersect(self, leaf, hit):
        t, triangle, uv = hit
        first = (leaf - LEAF) * LEAF_SIZE
        for k in range(LEAF_SIZE):
            index = first + k
            exists = index < self._tree.size
            corners = self._corners.corners(index, exists)
            is_hit, new_t, new_uv = self._projection.intersect(t, corners)
            is_hit &= exists
            t, triangle = dr.select(is_hit, new_t, t), dr.select(is_hit, index, triangle)
            uv = dr.select(is_hit, new_uv, uv)
        return t, triangle, uv


def _byte(word: mi.UInt32, number: int) -> mi.Float:
    return mi.Float(mi.Int32(word >> (8 * number) & 0xFF))


def _boxes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The boxes of triangles: lower and upper corners. Shape (6, triangles), float32."""
    boxes = np.empty((6, len(faces)), dtype=np.float32)
    for first in range(0, len(faces), _CHUNK):
        part = slice(first, first + _CHUNK)
        corners = vertices[faces[part]]
        boxes[:3, part] = corners.min(axis=1).T
        boxes[3:, part] = corners.max(axis=1).T
    return boxes
