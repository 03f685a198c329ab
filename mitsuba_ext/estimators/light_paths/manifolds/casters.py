"""The surfaces that cast caustics: smooth glass and smooth metal."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.bsdfs import contains_bsdf
from ....transport.numbers import hashed_2d
from ....util.arrays import from_numpy

#: The BSDFs whose directions follow from the shading normal alone.
_SMOOTH = ("SmoothConductor", "SmoothDielectric")
#: BSDFs that change the normal, let light pass straight, or add other lobes.
_CHANGED = ("BumpMap", "NormalMap", "MaskBSDF", "BlendBSDF")
#: The shapes, besides meshes, whose normals have derivatives in Mitsuba 3.9.1.
_SHAPES = ("Sphere", "Rectangle", "Disk", "Cylinder")

#: The number of points on each caster near which searches begin: 16 KiB for each caster.
_POINTS = 1024

#: Words of a triangle: two edges and three normals.
_WORDS = 16

#: The entries of the table of shapes: no caster, a caster that is no mesh; from then on, the number
#: of the first triangle.
_NONE, _NO_MESH = 0, 1


class Casters:
    """The casters of a scene.

    Attributes:
        exist: Whether there are any.
        refract: Whether some of them are glass.
        has_meshes: Whether some of them are meshes.
    """

    def __init__(self, scene: mi.Scene) -> None:
        shapes = [shape for shape in scene.shapes() if _is_caster(shape)]
        self.exist = bool(shapes)
        if not shapes:
            return
        transmits = int(mi.BSDFFlags.DeltaTransmission)
        self.refract = any(int(shape.bsdf().flags()) & transmits for shape in shapes)
        self.has_meshes = any(map(_has_triangles, shapes))
        ids = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        table, triangles, first = np.zeros(max(ids) + 1, np.uint32), [], 0
        for index, shape in zip(ids, shapes):
            table[index] = _NO_MESH
            if _has_triangles(shape):
                table[index] += 1 + first
                triangles.append(_triangles(shape))
                first += len(triangles[-1])
        self._table = from_numpy(mi.UInt32, table)
        self._triangles = None
        if self.has_meshes:
            self._triangles = from_numpy(mi.Float, np.concatenate(triangles).ravel())
        self._points = _points(shapes)
        self._count = dr.opaque(mi.UInt32, len(shapes) * _POINTS)

    def contain(self, shape: mi.ShapePtr) -> mi.Bool:
        """Whether ``shape`` is a caster."""
        return self._entry(shape) != _NONE

    def triangle(
        self, shape: mi.ShapePtr, index: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Bool, list[mi.Vector3f]]:
        """Whether ``shape`` is a mesh, and two edges and three normals of its triangle ``index``:
        both edges begin at the first corner. Normals are 0 where they are not interpolated."""
        entry = self._entry(shape)
        is_mesh = active & (entry > _NO_MESH)
        words = dr.gather(
            mi.ArrayXf, self._triangles, entry - (_NO_MESH + 1) + index, is_mesh,
            shape=(_WORDS, dr.width(entry)),
        )  # fmt: skip
        return is_mesh, [mi.Vector3f(words[i], words[i + 1], words[i + 2]) for i in range(0, 15, 3)]

    def near(self, u: mi.Float, v: mi.Vector3f, w: mi.Float) -> mi.Point3f:
        """A random point near a caster. Its density is positive everywhere: a caster may be long
        and thin, and have no point of the table near its end.

        Parameters:
            u: Uniform number, which chooses a point of the table.
            v, w: Four more, which move it. ``w`` decides how far at most: k times the usual
                distance with a probability of 1 / k².
        """
        index = dr.minimum(mi.UInt32(u * mi.Float(self._count)), self._count - 1)
        entry = dr.gather(mi.Vector4f, self._points, index)
        reach = entry.w * dr.rsqrt(1 - w)
        return mi.Point3f(entry.x, entry.y, entry.z) + reach * (2 * v - 1)

    def _entry(self, shape: mi.ShapePtr) -> mi.UInt32:
        index = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.UInt32, self._table, index, index < dr.width(self._table))


def _is_caster(shape: mi.Shape) -> bool:
    bsdf = shape.bsdf()
    if bsdf is None or not (_has_triangles(shape) or shape.class_name() in _SHAPES):
        return False
    if bsdf.class_name() == "TwoSidedBRDF":
        has_smooth_lobes = int(bsdf.flags()) & int(mi.BSDFFlags.Smooth)
        is_metal = contains_bsdf(bsdf, _SMOOTH) and not contains_bsdf(bsdf, _CHANGED)
        return is_metal and not has_smooth_lobes
    return bsdf.class_name() in _SMOOTH


def _has_triangles(shape: mi.Shape) -> bool:
    """Whether the normals of a shape belong to the corners of triangles."""
    return shape.is_mesh() and shape.class_name() not in _SHAPES


def _triangles(mesh: mi.Mesh) -> np.ndarray:
    """The words of the triangles of a mesh; shape [triangles, words]."""
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    p0, p1, p2 = (np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)[i] for i in faces.T)
    words = np.zeros((len(faces), _WORDS), np.float32)
    words[:, 0:3], words[:, 3:6] = p1 - p0, p2 - p0
    if mesh.has_vertex_normals():
        normals = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)
        words[:, 6:15] = normals[faces].reshape(-1, 9)
    return words


def _points(shapes: list[mi.Shape]) -> mi.Float:
    """Points on the shapes, each with about twice the distance to the next one."""
    numbers = hashed_2d(mi.UInt32(0), dr.arange(mi.UInt32, _POINTS))
    table = np.zeros((len(shapes), _POINTS, 4), np.float32)
    for row, shape in zip(table, shapes):
        row[:, :3] = np.array(shape.sample_position(mi.Float(0), numbers).p).T
        row[:, 3] = 2 * np.sqrt(np.array(shape.surface_area()).ravel()[0] / _POINTS)
    return from_numpy(mi.Float, table.ravel())
