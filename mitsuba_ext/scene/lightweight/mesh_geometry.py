"""A Mitsuba mesh whose triangles are intersected with our tree."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .geometry import Lightweight
from .mesh_tree import MeshTree, positions_and_faces


class MeshGeometry(Lightweight):
    """The geometry of a mesh that is not in Mitsuba's scene.

    Parameters:
        mesh: The mesh. Its faces are sorted by the leaves of the tree.

    Attributes:
        nbytes (int): The memory of the tree, in bytes.
    """

    def __init__(self, mesh: mi.Mesh) -> None:
        self.surface = mesh
        parameters = mi.traverse(mesh)
        positions, faces = positions_and_faces(mesh)
        self._tree = MeshTree(positions, faces)
        self.nbytes = self._tree.nbytes
        del positions
        sort_faces(parameters, faces, self._tree.order)

    def corners(self, triangle, active):
        vertices = self.surface.face_indices(triangle, active)
        return [self.surface.vertex_position(vertex, active) for vertex in vertices]

    def closest(self, ray, active):
        return self._tree.closest(ray, self, active)

    def occluded(self, ray, active):
        return self._tree.occluded(ray, self, active)


def sort_faces(parameters: mi.SceneParameters, faces: np.ndarray, order: np.ndarray) -> None:
    """Puts the triangles of a mesh into the given order."""
    for key in parameters.keys():
        if key.startswith("face_"):
            values = parameters[key].numpy().reshape(len(faces), -1)
            parameters[key] = from_numpy(mi.Float, values[order])
    parameters["faces"] = from_numpy(mi.UInt32, faces[order])
    # As if vertices had changed: Mitsuba then recomputes the areas of a light, and keeps normals
    for key in ("vertex_positions", "vertex_normals"):
        parameters.set_dirty(key)
    parameters.update()
