"""Nodes as in the source of ``lightweight_mesh``: boxes as floats, or as shorts or bytes relative
to the mesh. For ``lightweight.py``."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.lightweight.heap import ARITY
from mitsuba_ext.scene.lightweight.mesh_geometry import MeshGeometry, sort_faces
from mitsuba_ext.scene.lightweight.mesh_tree import (
    Corners,
    MeshTree,
    RaysInTree,
    positions_and_faces,
)
from mitsuba_ext.scene.lightweight.nodes import RANGE
from mitsuba_ext.scene.lightweight.traversal import NONE, traverse


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
        self.surface = mesh
        positions, faces = positions_and_faces(mesh)
        self._tree = _Tree(positions, faces, PRECISIONS[name])
        self.nbytes = self._tree.nbytes
        sort_faces(mi.traverse(mesh), faces, self._tree.order)


class _Tree(MeshTree):
    def __init__(self, positions: np.ndarray, faces: np.ndarray, precision: Precision) -> None:
        self.precision = precision
        super().__init__(positions, faces)

    def closest(self, ray, corners, active):
        return traverse(_Rays(self, ray, corners), ray, active, any_hit=False)

    def occluded(self, ray, corners, active):
        return traverse(_Rays(self, ray, corners), ray, active, any_hit=True)[1] != NONE

    def words(self, children: np.ndarray) -> np.ndarray:
        """For each node, lower x, y, z, upper x, y, z of its children, in turn."""
        children = children.transpose(1, 0, 2)
        if not self.precision.largest:
            self.unit = [1.0, 1.0, 1.0]
            return np.ascontiguousarray(children).view(np.uint32)
        low = self.grid.low.astype(np.float64)
        unit = (RANGE / self.grid.scale.astype(np.float64)) / self.precision.largest
        self.unit = unit.tolist()
        numbers = (children - np.tile(low, 2)[:, None]) / np.tile(unit, 2)[:, None]
        lower, upper = numbers[:, :3], numbers[:, 3:]
        numbers[:, :3] = np.where(np.isinf(lower), 1, np.floor(lower))
        numbers[:, 3:] = np.where(np.isinf(upper), 0, np.ceil(upper))
        kind = "<u2" if self.precision.bits == 16 else "u1"
        numbers = numbers.clip(0, self.precision.largest).astype(kind)
        return np.ascontiguousarray(numbers).view("<u4")


class _Rays(RaysInTree):
    def __init__(self, tree: _Tree, ray: mi.Ray3f, corners: Corners) -> None:
        super().__init__(tree, ray, corners)
        low = tree.low if tree.precision.largest else mi.Point3f(0)
        self._start = [(low[k] - ray.o[k]) / ray.d[k] for k in range(3)]
        self._per_unit = [tree.unit[k] / ray.d[k] for k in range(3)]
        dr.make_opaque(self._start, self._per_unit)
        self._error_world = [2.0**-21 * dr.abs(s) for s in self._start]

    def distances(self, node, maxt):
        bits = self._tree.precision.bits
        packets = [
            word
            for i in range(6 * bits // 32)
            for word in dr.gather(mi.Array4u, self._tree.nodes, 6 * bits // 32 * node + i)
        ] if bits > 8 else self._six(node)  # fmt: skip
        results = []
        for c in range(ARITY):
            enter, leave, exists = mi.Float(0), maxt, mi.Bool(True)
            for k in range(3):
                low, high = (self._number(packets, bits, side * 3 + k, c) for side in (0, 1))
                exists &= low <= high
                a, b = (dr.fma(n, self._per_unit[k], self._start[k]) for n in (low, high))
                enter = dr.maximum(enter, dr.minimum(a, b) - self._error_world[k])
                leave = dr.minimum(leave, dr.maximum(a, b) + self._error_world[k])
            results.append((enter, exists & (enter <= leave)))
        return results

    def _six(self, node):
        return [dr.gather(mi.UInt32, self._tree.nodes, 6 * node + i) for i in range(6)]

    def _number(self, words, bits: int, row: int, c: int) -> mi.Float:
        if bits == 32:
            return dr.reinterpret_array(mi.Float, words[4 * row + c])
        per = 32 // bits
        index = 4 * row + c
        shift = bits * (index % per)
        return mi.Float(mi.Int32(words[index // per] >> shift & (1 << bits) - 1))
