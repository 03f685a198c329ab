"""Nodes as in the source of ``lightweight_mesh``: boxes as floats, or as shorts or bytes relative
to the mesh. For ``lightweight.py``."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.arrays import from_numpy
from mitsuba_ext.lightweight.heap import ARITY, LEAF_SIZE, Heap
from mitsuba_ext.lightweight.mesh_geometry import MeshGeometry
from mitsuba_ext.lightweight.mesh_tree import RaysInTree
from mitsuba_ext.lightweight.traversal import NONE, traverse


@dataclass(frozen=True)
class Precision:
    """Bits of a coordinate, and the largest number (0 for floats)."""

    bits: int
    largest: int


PRECISIONS = {
    "floats": Precision(32, 0), "shorts": Precision(16, 65535), "bytes": Precision(8, 255),
}  # fmt: skip


class PreciseGeometry(MeshGeometry):
    """A mesh whose tree has other nodes."""

    def __init__(self, mesh: mi.Mesh, name: str) -> None:
        super().__init__(mesh)
        self._precision = PRECISIONS[name]
        parameters = mi.traverse(mesh)
        positions = parameters["vertex_positions"].numpy().reshape(-1, 3)
        faces = parameters["faces"].numpy().reshape(-1, 3)
        boxes = self._boxes_of_nodes(positions, faces)
        self._words, self._unit = self._encoded(boxes)
        self.nbytes = 4 * dr.width(self._words)

    def closest(self, ray, active):
        return traverse(_Rays(self, ray), ray, active, any_hit=False)

    def occluded(self, ray, active):
        return traverse(_Rays(self, ray), ray, active, any_hit=True)[1] != NONE

    def _boxes_of_nodes(self, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Shape (nodes, 2, 3)."""
        heap = Heap(len(faces))
        boxes = np.empty((len(heap.counts), 2, 3), dtype=np.float32)
        boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
        starts = np.arange(0, len(faces), LEAF_SIZE)
        leaves = slice(heap.inner, heap.inner + len(starts))
        for axis in range(3):
            corners = positions[:, axis][faces]
            boxes[leaves, 0, axis] = np.minimum.reduceat(corners.min(axis=1), starts)
            boxes[leaves, 1, axis] = np.maximum.reduceat(corners.max(axis=1), starts)
        for level in reversed(heap.levels):
            below = boxes[ARITY * level.start + 1 : ARITY * level.stop + 1].reshape(-1, ARITY, 2, 3)
            boxes[level.start : level.stop, 0] = below[:, :, 0].min(axis=1)
            boxes[level.start : level.stop, 1] = below[:, :, 1].max(axis=1)
        return boxes

    def _encoded(self, boxes: np.ndarray) -> tuple[mi.UInt32, list[float]]:
        """The words of each node's children: lower x, y, z, upper x, y, z of the four, in turn."""
        children = boxes[1:].reshape(-1, ARITY, 2, 3)
        if not self._precision.largest:
            words = np.ascontiguousarray(children.transpose(0, 2, 3, 1)).view(np.uint32)
            return from_numpy(mi.UInt32, words), [1.0, 1.0, 1.0]
        low = boxes[0, 0].astype(np.float64)
        unit = (boxes[0, 1] - low) / self._precision.largest
        numbers = (children - low) / np.where(unit > 0, unit, 1)
        numbers[:, :, 0] = np.where(np.isinf(numbers[:, :, 0]), 1, np.floor(numbers[:, :, 0]))
        numbers[:, :, 1] = np.where(np.isinf(numbers[:, :, 1]), 0, np.ceil(numbers[:, :, 1]))
        numbers = numbers.clip(0, self._precision.largest).transpose(0, 2, 3, 1)
        kind = "<u2" if self._precision.bits == 16 else "u1"
        words = np.ascontiguousarray(numbers.astype(kind)).view("<u4")
        return from_numpy(mi.UInt32, words), unit.tolist()


class _Rays(RaysInTree):
    def __init__(self, geometry: PreciseGeometry, ray: mi.Ray3f) -> None:
        super().__init__(geometry._tree, ray, geometry)
        self._geometry = geometry
        low = self._tree.low if geometry._precision.largest else mi.Point3f(0)
        self._start = [(low[k] - ray.o[k]) / ray.d[k] for k in range(3)]
        self._per_unit = [geometry._unit[k] / ray.d[k] for k in range(3)]
        dr.make_opaque(self._start, self._per_unit)
        self._error_world = [2.0**-21 * dr.abs(s) for s in self._start]

    def distances(self, node, maxt):
        bits = self._geometry._precision.bits
        packets = [
            word
            for i in range(6 * bits // 32)
            for word in dr.gather(mi.Array4u, self._geometry._words, 6 * bits // 32 * node + i)
        ] if bits > 8 else self._six(node)  # fmt: skip
        results = []
        for c in range(ARITY):
            enter, leave = mi.Float(0), maxt
            for k in range(3):
                low, high = (self._number(packets, bits, side * 3 + k, c) for side in (0, 1))
                a, b = (dr.fma(n, self._per_unit[k], self._start[k]) for n in (low, high))
                enter = dr.maximum(enter, dr.minimum(a, b) - self._error_world[k])
                leave = dr.minimum(leave, dr.maximum(a, b) + self._error_world[k])
            results.append((enter, enter <= leave))
        return results

    def _six(self, node):
        return [dr.gather(mi.UInt32, self._geometry._words, 6 * node + i) for i in range(6)]

    def _number(self, words, bits: int, row: int, c: int) -> mi.Float:
        if bits == 32:
            return dr.reinterpret_array(mi.Float, words[4 * row + c])
        per = 32 // bits
        index = 4 * row + c
        shift = bits * (index % per)
        return mi.Float(mi.Int32(words[index // per] >> shift & (1 << bits) - 1))
