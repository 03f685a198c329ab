"""Sampling meshes with few triangles by solid angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ..solid_angles.spherical_triangle import SphericalTriangle, spherical_triangle
from .surface import Surface, SurfacePoint

#: The maximum number of triangles for sampling by solid angle: each sample visits all of them.
MAX_TRIANGLES = 16

#: The number of floats per triangle in the table: a corner, two edges, a sign, and three normals.
_WORDS = 20


class MeshSurface(Surface):
    """A mesh, sampled by the solid angle of its triangles that face the point.

    A triangle is chosen in proportion to its solid angle. All directions to triangles then have the
    same density, and :meth:`pdf` does not depend on the triangle. If triangles hide each other,
    some samples are occluded.
    """

    def __init__(self, shape: mi.Shape) -> None:
        super().__init__(shape)
        table, areas, self._is_smooth = _table(shape)
        self._table = from_numpy(mi.Float, table)
        self._count = len(table)
        share = np.cumsum(areas) / max(areas.sum(), 1e-300)
        self._share = from_numpy(mi.Float, np.append(0, share))

    def _triangle(self, index: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> SphericalTriangle:
        """The triangle ``index``, seen from ``p``. A triangle that does not face ``p`` has the
        solid angle 0."""
        width = max(dr.width(index), dr.width(p))
        row = dr.gather(mi.ArrayXf, self._table, index, active, shape=(_WORDS, width))
        corner, ba, ac = (mi.Vector3f(row[i], row[i + 1], row[i + 2]) for i in (0, 3, 6))
        b = corner - p
        a = b + ba
        triangle = spherical_triangle(a, b, a + ac, ba, ac)
        if self._is_smooth:
            # Light leaves where the interpolated normal faces the point: nowhere if none of the
            # three normals faces the point from any of the three corners
            normals = (mi.Vector3f(row[i], row[i + 1], row[i + 2]) for i in (10, 13, 16))
            faces = mi.Bool(False)
            for normal in normals:
                for corner in (a, b, triangle.c):
                    faces |= dr.dot(normal, corner) < 0
        else:
            faces = row[9] * dr.dot(b, dr.cross(ba, ac)) < 0
        triangle.half_angle = dr.select(faces & active, triangle.half_angle, 0)
        return triangle

    def _sums(self, p: mi.Point3f) -> list[mi.Float]:
        """Half the solid angle of the first triangle, of the first two, and so on."""
        sums = []
        for index in range(self._count):
            half_angle = self._triangle(mi.UInt32(index), p, mi.Bool(True)).half_angle
            sums.append(sums[-1] + half_angle if sums else half_angle)
        return sums

    def sample(self, it, sample, active):
        p = it.p
        sums = self._sums(p)
        total = sums[-1]
        target = sample.x * total
        # Finds the first triangle whose running sum exceeds the target
        chosen, before = mi.UInt32(0), mi.Float(0)
        for sum in sums[:-1]:
            is_passed = (sum <= target) & (sum < total)
            chosen = dr.select(is_passed, chosen + 1, chosen)
            before = dr.select(is_passed, sum, before)
        triangle = self._triangle(chosen, p, active)
        x = dr.clip((target - before) / dr.maximum(triangle.half_angle, 1e-37), 0, 1)
        prim_uv = mi.Point2f(*triangle.sample(mi.Point2f(x, sample.y)))
        pdf = dr.select(total > 0, dr.rcp(dr.maximum(2 * total, 1e-37)), 0)
        return SurfacePoint(self._point(chosen, prim_uv, active), pdf)

    def pdf(self, it, ds):
        p = it.p
        total = 2 * self._sums(p)[-1]
        return dr.select(total > 0, dr.rcp(dr.maximum(total, 1e-37)), 0)

    def sample_area(self, sample, active):
        index = dr.binary_search(
            0, self._count - 1,
            lambda i: dr.gather(mi.Float, self._share, i + 1) <= sample.y,
        )  # fmt: skip
        low, high = (dr.gather(mi.Float, self._share, i) for i in (index, index + 1))
        y = dr.clip((sample.y - low) / dr.maximum(high - low, 1e-37), 0, 1)
        prim_uv = mi.warp.square_to_uniform_triangle(mi.Point2f(sample.x, y))
        return SurfacePoint(self._point(index, prim_uv, active), dr.rcp(self.area()))

    def _point(
        self, index: mi.UInt32, prim_uv: mi.Point2f, active: mi.Bool
    ) -> mi.SurfaceInteraction3f:
        row = dr.gather(mi.ArrayXf, self._table, index, active, shape=(_WORDS, dr.width(prim_uv)))
        corner, ba, ac = (mi.Vector3f(row[i], row[i + 1], row[i + 2]) for i in (0, 3, 6))
        # The weights of the corners b + ba and b + ba + ac
        p = mi.Point3f(corner + (prim_uv.x + prim_uv.y) * ba + prim_uv.y * ac)
        si = self.found(p, prim_uv, index, active)
        si.p = p
        return si


def triangle_count(shape: mi.Shape) -> int:
    return len(mi.traverse(shape)["faces"]) // 3


def _table(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray, bool]:
    """A row for each triangle, its area, and whether the mesh has interpolated normals."""
    parameters = mi.traverse(shape)
    vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    corners = vertices[faces]
    ba, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
    normal = np.cross(ba, ac)
    area = 0.5 * np.linalg.norm(normal, axis=1)
    sign = -1.0 if shape.has_flipped_normals() else 1.0
    table = np.zeros((len(faces), _WORDS), dtype=np.float32)
    table[:, :3], table[:, 3:6], table[:, 6:9] = corners[:, 0], ba, ac
    table[:, 9] = sign
    stored = np.array(parameters["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    if len(stored) == 0:
        return table, area, False
    shading = stored[faces]
    table[:, 10:19] = sign * shading.reshape(-1, 9)
    cosine = (shading * normal[:, None]).sum(-1) / np.maximum(2 * area[:, None], 1e-300)
    # The light emits to the side of the interpolated normals
    table[:, 9] *= np.where(cosine[:, 0] < 0, -1, 1)
    is_smooth = bool(np.any(np.abs(cosine[area > 0]) < 1 - 1e-4))
    return table, area, is_smooth
