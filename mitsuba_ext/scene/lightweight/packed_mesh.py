"""A mesh in at most 16 bytes per triangle, including the tree.

Corners are points of a grid, with 16 bits for each coordinate. Triangles refer to their corners
with 16-bit indices: each block of triangles has a separate table of corners, and corners shared
between blocks are repeated. Triangles with a common edge compute its ends from the same numbers, so
there is no gap between them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.octahedral import from_octahedral, octahedral
from .geometry import Lightweight
from .interaction import Triangle, surface_interaction
from .mesh_tree import MeshTree, positions_and_faces
from .shorts import LARGEST, Pairs, Quantizer, Triples

#: The number of triangles in a block, small enough for 16-bit indices of their corners.
_BLOCK = 1 << 14

#: The number of vertices decoded at a time.
_CHUNK = 1 << 20


class PackedMesh(Lightweight):
    """A mesh with quantized vertices.

    Parameters:
        mesh: The mesh to pack. It is not kept.

    Attributes:
        nbytes (int): The memory of the tree, the triangles and the vertices, in bytes.
    """

    def __init__(self, mesh: mi.Mesh) -> None:
        self._is_flipped = mesh.has_flipped_normals()
        parameters = mi.traverse(mesh)
        positions, faces = positions_and_faces(mesh)
        self._position = Quantizer(positions)
        points = self._position.encode(positions)
        del positions
        self._tree = MeshTree(self._decoded(points), faces)
        vertices, local, first = _blocks(faces[self._tree.order])
        del faces
        self._faces, self._first = Triples(local), from_numpy(mi.UInt32, first)
        self._points = Triples(points[vertices])
        self._normals = self._uv = None
        tables = [self._faces, self._points]
        if mesh.has_vertex_normals():
            normals = parameters["vertex_normals"].numpy().reshape(-1, 3)[vertices]
            self._normals = Pairs(_packed_directions(normals))
            tables.append(self._normals)
        if mesh.has_vertex_texcoords():
            uv = parameters["vertex_texcoords"].numpy().reshape(-1, 2)[vertices]
            self._texcoord = Quantizer(uv)
            self._uv = Pairs(self._texcoord.encode(uv))
            tables.append(self._uv)
        self.nbytes = self._tree.nbytes + first.nbytes + sum(table.nbytes for table in tables)

    def closest(self, ray, active):
        return self._tree.closest(ray, self, active)

    def occluded(self, ray, active):
        return self._tree.occluded(ray, self, active)

    def interaction(self, pi, ray):
        vertices = self._vertices(pi.prim_index, pi.valid)
        normals = uv = None
        if self._normals is not None:
            normals = [_direction(*self._normals(vertex, pi.valid)) for vertex in vertices]
        if self._uv is not None:
            uv = [
                mi.Point2f(self._texcoord.decode(self._uv(vertex, pi.valid)))
                for vertex in vertices
            ]
        corners = [self._point(vertex, pi.valid) for vertex in vertices]
        return surface_interaction(ray, pi, Triangle(corners, normals, uv, self._is_flipped))

    def corners(self, triangle, active):
        return [self._point(vertex, active) for vertex in self._vertices(triangle, active)]

    def _vertices(self, triangle: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
        first = dr.gather(mi.UInt32, self._first, triangle // _BLOCK, active)
        return [first + local for local in self._faces(triangle, active)]

    def _point(self, vertex: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        return mi.Point3f(self._position.decode(self._points(vertex, active)))

    def _decoded(self, points: np.ndarray) -> np.ndarray:
        """The positions of points, exactly as the device computes them. Shape (points, 3)."""
        positions = np.empty(points.shape, dtype=np.float32)
        for first in range(0, len(points), _CHUNK):
            part = slice(first, first + _CHUNK)
            numbers = tuple(from_numpy(mi.UInt32, column) for column in points[part].T)
            positions[part] = np.array(self._position.decode(numbers)).T
        return positions


def _blocks(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gives each block of triangles its own vertices.

    Parameters:
        faces: The vertices of each triangle. Shape (triangles, 3).

    Returns:
        The old indices of the new vertices; for each triangle, its new vertex indices relative to
        the first vertex of its block, as uint16; and the index of the first vertex of each block.
    """
    vertices, first = [], [0]
    local = np.empty(faces.shape, dtype=np.uint16)
    for start in range(0, len(faces), _BLOCK):
        part = slice(start, start + _BLOCK)
        mine, numbers = np.unique(faces[part], return_inverse=True)
        vertices.append(mine)
        local[part] = numbers.reshape(-1, 3)
        first.append(first[-1] + len(mine))
    return np.concatenate(vertices), local, np.array(first[:-1], dtype=np.uint32)


def _packed_directions(normals: np.ndarray) -> np.ndarray:
    """Directions as points of a square, with 16 bits per coordinate. Shape (normals, 2), uint16."""
    square = np.array(octahedral(mi.Vector3f(normals.T))).T
    # A vertex without triangles has no normal
    return np.rint((np.nan_to_num(square) + 1) * (LARGEST / 2)).astype(np.uint16)


def _direction(x: mi.UInt32, y: mi.UInt32) -> mi.Normal3f:
    return mi.Normal3f(
        from_octahedral(mi.Float(x) * (2 / LARGEST) - 1, mi.Float(y) * (2 / LARGEST) - 1)
    )
