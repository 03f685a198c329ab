"""The surfaces that cast caustics: smooth glass and metal, and slightly rough glass."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.bsdfs import contains_bsdf
from ....transport.bsdfs import sample_bsdf
from ....transport.numbers import hashed_2d
from ....util.arrays import from_numpy
from .microfacets import offset_between

#: The BSDFs whose directions follow from the shading normal alone.
_SMOOTH = ("SmoothConductor", "SmoothDielectric")
#: The same, with a microfacet normal in the place of the shading normal. (In rough metal, chains
#: have 0.2 to 0.5 times the efficiency of scattering and connections of the metal itself.)
_ROUGH = "RoughDielectric"
#: Rougher glass is left to scattering and connections, too.
_MOST_ROUGHNESS = 0.1001
#: BSDFs that change the normal, let light pass straight, or add other lobes.
_CHANGED = ("BumpMap", "NormalMap", "MaskBSDF", "BlendBSDF")
#: The shapes, besides meshes, whose normals have derivatives in Mitsuba 3.9.1.
_SHAPES = ("Sphere", "Rectangle", "Disk", "Cylinder")

#: The number of points on each caster near which searches begin: 16 KiB for each caster.
_POINTS = 1024

#: Words of a triangle: two edges and three normals. Words of a shape: see ``_shape_words``.
_TRIANGLE, _SHAPE = 16, 16
_ETA, _ROUGHNESS = 10, 12

#: The entries of the table of shapes: no caster, a caster that is no mesh; from then on, the number
#: of the first triangle.
_NONE, _NO_MESH = 0, 1


@dataclass
class CasterPoint:
    """A point of a caster.

    Attributes:
        p: The point.
        normal, shading_normal: The geometric normal, of unknown sign, and the shading normal.
        eta: The relative index of refraction of the inside; 0 for metal.
        is_one_sided: Whether it reflects on the side of its normal only.
        roughness: The parameter α of its microfacets; 0 where it is smooth.
    """

    p: mi.Point3f
    normal: mi.Normal3f
    shading_normal: mi.Normal3f
    eta: mi.Float
    is_one_sided: mi.Bool
    roughness: mi.Float


class Casters:
    """The casters of a scene. Their normals and indices of refraction lie in tables, because a
    search for chains needs nothing else of a surface, and calls of shapes and BSDFs take longer.

    Parameters:
        shapes: The casters, at least one (:func:`casters_of`).

    Attributes:
        refract: Whether some of them are glass.
        are_rough: Whether some of them are rough.
    """

    def __init__(self, shapes: list[mi.Shape]) -> None:
        self.refract = any(_transmits(shape.bsdf()) for shape in shapes)
        self.are_rough = any(_roughness(shape.bsdf()) > 0 for shape in shapes)
        self._have_meshes = any(map(_has_triangles, shapes))
        ids = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        table, words = np.zeros(max(ids) + 1, np.uint32), np.zeros((max(ids) + 1, _SHAPE))
        triangles, first = [], 0
        for index, shape in zip(ids, shapes):
            table[index], words[index] = _NO_MESH, _shape_words(shape)
            if _has_triangles(shape):
                table[index] += 1 + first
                triangles.append(_triangles(shape))
                first += len(triangles[-1])
        self._table = from_numpy(mi.UInt32, table)
        self._shapes = from_numpy(mi.Float, words.ravel())
        self._triangles = None
        if self._have_meshes:
            self._triangles = from_numpy(mi.Float, np.concatenate(triangles).ravel())
        self._points = _points(shapes)
        self._count = dr.opaque(mi.UInt32, len(shapes) * _POINTS)

    def contain(self, shape: mi.ShapePtr) -> mi.Bool:
        """Whether ``shape`` is a caster."""
        return self._entry(shape) != _NONE

    def is_rough(self, shape: mi.ShapePtr) -> mi.Bool:
        """Whether ``shape`` is a rough caster."""
        return self._word(shape, _ROUGHNESS) > 0

    def offset(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, transmits: mi.Bool
    ) -> mi.Vector2f:
        """The offset of the microfacet that scatters light between ``si.wi`` and ``wo``; 0 where
        the surface is no rough caster."""
        eta, roughness = (self._word(si.shape, i) for i in (_ETA, _ROUGHNESS))
        eta = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, eta, dr.rcp(eta))
        offset = offset_between(
            si.to_world(si.wi), si.to_world(wo), si.sh_frame.n, dr.select(transmits, eta, 1),
            roughness,
        )
        return dr.select(roughness > 0, offset, 0)

    def _word(self, shape: mi.ShapePtr, number: int) -> mi.Float:
        """A word of a caster; 0 for other shapes."""
        index, active = dr.reinterpret_array(mi.UInt32, shape), self.contain(shape)
        return dr.gather(mi.Float, self._shapes, index * _SHAPE + number, active)

    def meet(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[CasterPoint, NormalDerivative]:
        """The point of a caster in which ``ray`` meets it, and how its shading normal changes."""
        entry = self._entry(pi.shape)
        active = active & (entry != _NONE)
        index = dr.reinterpret_array(mi.UInt32, pi.shape)
        w = dr.gather(
            mi.ArrayXf, self._shapes, index, active, shape=(_SHAPE, dr.width(index))
        )
        p = ray(pi.t)
        axis, curvature = _vector(w, 3), w[9]
        to_p = p - _vector(w, 0)
        n = _vector(w, 6) + (to_p - axis * dr.dot(axis, to_p)) * curvature
        geometric, change = n, NormalDerivative(axis, curvature)
        if self._have_meshes:
            is_mesh = active & (entry > _NO_MESH)
            words = dr.gather(
                mi.ArrayXf, self._triangles, entry - (_NO_MESH + 1) + pi.prim_index, is_mesh,
                shape=(_TRIANGLE, dr.width(entry)),
            )  # fmt: skip
            e1, e2, n0, n1, n2 = (_vector(words, i) for i in range(0, 15, 3))
            b = pi.prim_uv
            shading = n0 * (1 - b.x - b.y) + n1 * b.x + n2 * b.y
            length = dr.norm(shading)
            inverse = dr.select(length > 0, dr.rcp(length), 0)
            shading *= inverse
            change.on_meshes(is_mesh, e1, e2, *(
                inverse * (x - shading * dr.dot(shading, x)) for x in (n1 - n0, n2 - n0)
            ))  # fmt: skip
            n = dr.select(is_mesh, shading, n)
            flat = dr.cross(e1, e2)
            geometric = dr.select(is_mesh, flat * dr.rsqrt(dr.squared_norm(flat)), geometric)
        point = CasterPoint(
            p, mi.Normal3f(geometric), mi.Normal3f(n), w[_ETA], w[11] > 0, w[_ROUGHNESS]
        )
        return point, change

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


def casters_of(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes of a scene that cast caustics."""
    return [shape for shape in scene.shapes() if _is_caster(shape)]


def _is_caster(shape: mi.Shape) -> bool:
    bsdf = shape.bsdf()
    if bsdf is None or not (_has_triangles(shape) or shape.class_name() in _SHAPES):
        return False
    if bsdf.class_name() == _ROUGH:
        return 0 < _roughness(bsdf) <= _MOST_ROUGHNESS
    if bsdf.class_name() == "TwoSidedBRDF":
        has_smooth_lobes = int(bsdf.flags()) & int(mi.BSDFFlags.Smooth)
        is_metal = contains_bsdf(bsdf, _SMOOTH) and not contains_bsdf(bsdf, _CHANGED)
        return is_metal and not has_smooth_lobes
    return bsdf.class_name() in _SMOOTH


def _has_triangles(shape: mi.Shape) -> bool:
    """Whether the normals of a shape belong to the corners of triangles."""
    return shape.is_mesh() and shape.class_name() not in _SHAPES


def _shape_words(shape: mi.Shape) -> np.ndarray:
    """The words of a shape. The normal at p is n + curvature · (v - axis (axis · v)), where v =
    p - centre: words 0 to 2 are the centre, 3 to 5 the axis, 6 to 8 n, and 9 the curvature; they
    are 0 for meshes. 10: the relative index of refraction, 0 for metal. 11: whether only one side
    reflects. 12: the roughness."""
    bsdf, words = shape.bsdf(), np.zeros(_SHAPE)
    words[10:13] = _eta(bsdf), bsdf.class_name() == "SmoothConductor", _roughness(bsdf)
    if _has_triangles(shape):
        return words
    p, n = _some_points(shape)
    if shape.class_name() in ("Rectangle", "Disk"):
        words[6:9] = n[0]
        return words
    if shape.class_name() == "Cylinder":
        # All its normals are perpendicular to its axis
        words[3:6] = np.linalg.eigh(n.T @ n)[1][:, 0]
        p -= np.outer(p @ words[3:6], words[3:6])
    # p = centre + n / curvature
    dp, dn = p - p.mean(0), n - n.mean(0)
    words[9] = (dn * dn).sum() / (dp * dn).sum()
    words[0:3] = p.mean(0) - n.mean(0) / words[9]
    return words


def _transmits(bsdf: mi.BSDF) -> bool:
    return bool(int(bsdf.flags()) & int(mi.BSDFFlags.Transmission))


def _roughness(bsdf: mi.BSDF) -> float:
    """The parameter α of rough glass, the larger one of both directions; 0 of other BSDFs, and
    infinite where a texture has it."""
    if bsdf.class_name() != _ROUGH:
        return 0.0
    parameters = mi.traverse(bsdf)
    names = [key for key in parameters.keys() if "alpha" in key]
    if not all(key.endswith(".value") for key in names):
        return np.inf
    return max(float(np.array(parameters[key]).max()) for key in names)


def _eta(bsdf: mi.BSDF) -> float:
    """The relative index of refraction of the inside; 0 for metal."""
    if not _transmits(bsdf):
        return 0.0
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    si.wavelengths = mi.Spectrum(550) if mi.is_spectral else mi.Color0f()
    bs, _weight = sample_bsdf(
        mi.BSDFPtr(bsdf), mi.BSDFContext(), si, mi.Float(1), mi.Point2f(0.5)
    )
    return float(np.array(bs.eta).ravel()[0])


def _triangles(mesh: mi.Mesh) -> np.ndarray:
    """The words of the triangles of a mesh; shape [triangles, words]."""
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    p0, p1, p2 = (np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)[i] for i in faces.T)
    words = np.zeros((len(faces), _TRIANGLE), np.float32)
    words[:, 0:3], words[:, 3:6] = p1 - p0, p2 - p0
    # The normal in the middle of each triangle, flipped as the mesh flips it
    index = dr.arange(mi.UInt32, len(faces))
    si = _interaction(mesh, mi.Point3f(0), index, mi.Point2f(1 / 3))
    middle = np.array(si.sh_frame.n).T
    words[:, 6:15] = np.tile(middle, 3)
    if mesh.has_vertex_normals():
        normals = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)[faces]
        side = np.sign((normals.sum(1) * middle).sum(1))
        words[:, 6:15] = (normals * side[:, None, None]).reshape(-1, 9)
    return words


def _vector(words: mi.ArrayXf, index: int) -> mi.Vector3f:
    return mi.Vector3f(*(words[index + i] for i in range(3)))


def _points(shapes: list[mi.Shape]) -> mi.Float:
    """Points on the shapes, each with about twice the distance to the next one."""
    table = np.zeros((len(shapes), _POINTS, 4), np.float32)
    for row, shape in zip(table, shapes):
        row[:, :3] = _some_points(shape)[0]
        row[:, 3] = 2 * np.sqrt(np.array(shape.surface_area()).ravel()[0] / _POINTS)
    return from_numpy(mi.Float, table.ravel())


def _some_points(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Points on a shape, and their normals. (In Mitsuba 3.9.1, the normals that rotated spheres
    sample are not rotated: these normals are of intersections.)"""
    numbers = hashed_2d(mi.UInt32(0), dr.arange(mi.UInt32, _POINTS))
    p = shape.sample_position(mi.Float(0), numbers).p
    n = _interaction(shape, p, mi.UInt32(0), mi.Point2f(0.5)).n
    n = dr.zeros(mi.Normal3f, _POINTS) + n  # a plane has one for all
    return np.array(p, np.float64).T, np.array(n, np.float64).T


def _interaction(
    shape: mi.Shape, p: mi.Point3f, index: mi.UInt32, uv: mi.Point2f
) -> mi.SurfaceInteraction3f:
    """The interaction of a ray that meets a shape at ``p``; on meshes, at the coordinates ``uv`` of
    a triangle."""
    count = max(dr.width(p), dr.width(index))
    pi = dr.zeros(mi.PreliminaryIntersection3f, count)
    pi.t, pi.valid, pi.shape = mi.Float(1), mi.Bool(True), mi.ShapePtr(shape)
    pi.prim_uv, pi.prim_index = uv, index
    d = mi.Vector3f(0, 0, 1)
    return pi.compute_surface_interaction(mi.Ray3f(p - d, d), mi.RayFlags.All)


class NormalDerivative:
    """How the shading normal changes along a surface: curvature · (dp - axis (axis · dp))."""

    def __init__(self, axis: mi.Vector3f, curvature: mi.Float) -> None:
        self._axis, self._curvature, self._on_mesh = axis, curvature, None

    def on_meshes(
        self, is_mesh: mi.Bool, u: mi.Vector3f, v: mi.Vector3f, n_u: mi.Vector3f, n_v: mi.Vector3f
    ) -> None:
        """Sets the changes ``n_u`` and ``n_v`` along two vectors ``u`` and ``v`` in a triangle.

        The derivatives of an interaction are wrong in Mitsuba 3.9.1 where a mesh has texture
        coordinates."""
        uu, uv, vv = dr.dot(u, u), dr.dot(u, v), dr.dot(v, v)
        det = uu * vv - uv * uv
        inverse = dr.select(det > 0, dr.rcp(det), 0)
        # The vectors whose products with a step are its coordinates
        a, b = (vv * u - uv * v) * inverse, (uu * v - uv * u) * inverse
        self._on_mesh = is_mesh, a, b, n_u, n_v

    def along(self, dp: mi.Vector3f) -> mi.Vector3f:
        """The change of the normal for a step ``dp`` along the surface."""
        change = self._curvature * (dp - self._axis * dr.dot(self._axis, dp))
        if self._on_mesh is None:
            return change
        is_mesh, a, b, n_u, n_v = self._on_mesh
        return dr.select(is_mesh, n_u * dr.dot(a, dp) + n_v * dr.dot(b, dp), change)
