"""Sampling rectangles, possibly sheared to parallelograms, by solid angle."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ..solid_angles.projected_polygon import ProjectedPolygon
from ..solid_angles.spherical_polygon import SphericalPolygon, spherical_polygon
from .surface import Surface, SurfacePoint

#: The fraction of samples taken by solid angle in projected solid angle sampling.
_DIRECT_FRACTION = 0.1

#: The minimum projected solid angle of a light for sampling by it: for smaller lights, the sum over
#: their edges would be inexact.
_MIN_AREA = 1e-3


class RectangleSurface(Surface):
    """A rectangle, sampled by its solid angle."""

    def __init__(self, shape: mi.Shape) -> None:
        super().__init__(shape)
        matrix = mi.traverse(shape)["to_world"].matrix
        x, y, origin = (_column(matrix, j) for j in (0, 1, 3))
        self._corner = mi.Point3f(_data(origin - x - y))
        self._edges = [_data(2 * x), _data(2 * y)]

    def _seen_from(self, p: mi.Point3f) -> SphericalPolygon:
        x, y = self._edges
        corner = self._corner - p
        corners = [corner, corner + x, corner + x + y, corner + y]
        return spherical_polygon(corners, [x, y, -x, -y])

    def sample(self, it, sample, active):
        polygon = self._seen_from(it.p)
        return self._point(self._uv(polygon, sample), _reciprocal(polygon.solid_angle), active)

    def pdf(self, it, ds):
        return _reciprocal(self._seen_from(it.p).solid_angle)

    def _uv(self, polygon: SphericalPolygon, sample: mi.Point2f) -> mi.Point2f:
        """A point that is uniformly distributed by solid angle, as coordinates ``uv``."""
        index, a, b = polygon.sample(sample)
        # The corners of the two triangles are 1 and 2, and 2 and 3
        is_first = index == 0
        return mi.Point2f(dr.select(is_first, a + b, a), dr.select(is_first, b, a + b))

    def _point(self, uv: mi.Point2f, pdf: mi.Float, active: mi.Bool) -> SurfacePoint:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.p = self._corner + uv.x * self._edges[0] + uv.y * self._edges[1]
        si.uv = uv
        si.n = self.shape.sample_position(0, mi.Point2f(0.5), active).n
        si.sh_frame = mi.Frame3f(si.n)
        return SurfacePoint(si, pdf)


class ProjectedRectangleSurface(RectangleSurface):
    """A rectangle, sampled by its projected solid angle: in proportion to the cosine with the
    receiver's normal. A fraction of the samples is taken by solid angle instead. These bound the
    weights at receivers that scatter light even where this cosine is 0 (shading normals,
    transmission). The side of the receiver that scatters the light is unknown, so directions below
    the horizon are sampled too, by the absolute value of the cosine.

    Small lights are sampled by solid angle, and so are all lights at receivers without a normal."""

    def sample(self, it, sample, active):
        polygon = self._seen_from(it.p)
        sides = self._sides(it, polygon)
        area = sides.above.area + sides.below.area
        is_projected = area > _MIN_AREA
        x = (sample.x - _DIRECT_FRACTION) / (1 - _DIRECT_FRACTION)
        # ----- By solid angle -----
        is_direct = ~is_projected | (x < 0)
        rest = dr.select(is_projected, sample.x / _DIRECT_FRACTION, sample.x)
        uv = self._uv(polygon, mi.Point2f(dr.minimum(rest, 1), sample.y))
        # ----- By projected solid angle: the part above or below the horizon -----
        above = sides.above.area / dr.maximum(area, 1e-37)
        is_above = x < above
        x = dr.select(is_above, x / above, (x - above) / dr.maximum(1 - above, 1e-37))
        side = dr.select(is_above, mi.Float(1), -1)
        part = ProjectedPolygon(sides.corners, sides.normals, side)
        local = part.sample(mi.Point2f(dr.clip(x, 0, 1), sample.y), active & ~is_direct)
        d = sides.frame.to_world(mi.Vector3f(local.x, local.y, side * local.z))
        uv = dr.select(is_direct, uv, self._hit(it.p, d))
        point = self._point(uv, mi.Float(0), active)
        point.pdf = self._density(sides, polygon, it, point.si.p - it.p)
        return point

    def pdf(self, it, ds):
        polygon = self._seen_from(it.p)
        return self._density(self._sides(it, polygon), polygon, it, ds.p - it.p)

    def _sides(self, it: mi.Interaction3f, polygon: SphericalPolygon) -> _Sides:
        has_normal = dr.squared_norm(it.n) > 0.5
        frame = mi.Frame3f(dr.select(has_normal, it.n, mi.Normal3f(0, 0, 1)))
        first, second = polygon.triangles
        x, y = self._edges
        corners = [first.b, first.a, first.c, second.c]
        normals = [dr.cross(a, edge) for a, edge in zip(corners, (x, y, -x, -y))]
        corners, normals = (
            [frame.to_local(v / dr.maximum(dr.norm(v), 1e-37)) for v in vectors]
            for vectors in (corners, normals)
        )
        above, below = (ProjectedPolygon(corners, normals, side) for side in (1.0, -1.0))
        for part in (above, below):
            part.area = dr.select(has_normal, part.area, 0)
        return _Sides(frame, corners, normals, above, below)

    def _density(
        self, sides: _Sides, polygon: SphericalPolygon, it: mi.Interaction3f, d: mi.Vector3f
    ) -> mi.Float:
        area = sides.above.area + sides.below.area
        is_projected = area > _MIN_AREA
        cosine = dr.abs(dr.dot(d, it.n)) * dr.rsqrt(dr.maximum(dr.squared_norm(d), 1e-37))
        by_angle = _reciprocal(polygon.solid_angle)
        mixed = dr.lerp(cosine / dr.select(is_projected, area, 1), by_angle, _DIRECT_FRACTION)
        return dr.select(is_projected, mixed, by_angle)

    def _hit(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Point2f:
        """The point where a ray hits the plane of the rectangle, clipped to the rectangle, as
        coordinates ``uv``."""
        x, y = self._edges
        offset, normal = p - self._corner, dr.cross(x, y)
        slope = dr.dot(d, normal)
        t = -dr.dot(offset, normal) / dr.select(slope != 0, slope, 1)
        hit = offset + t * d
        squared = dr.maximum(dr.squared_norm(normal), 1e-37)
        return mi.Point2f(
            dr.clip(dr.dot(dr.cross(hit, y), normal) / squared, 0, 1),
            dr.clip(dr.dot(dr.cross(x, hit), normal) / squared, 0, 1),
        )


def _column(matrix: mi.Matrix4f, index: int) -> np.ndarray:
    # Element by element, because a matrix cannot be read while Dr.Jit records a call
    return np.array([float(matrix[i, index][0]) for i in range(3)])


def _data(vector: np.ndarray) -> mi.Vector3f:
    """A vector that is not a literal, so that all rectangles share the same compiled code."""
    return mi.Vector3f(*(from_numpy(mi.Float, [x]) for x in vector))


@dataclass
class _Sides:
    """A polygon in the frame of a receiver: directions of its corners, normals of the planes of its
    edges, and the parts above and below the horizon."""

    frame: mi.Frame3f
    corners: list[mi.Vector3f]
    normals: list[mi.Vector3f]
    above: ProjectedPolygon
    below: ProjectedPolygon


def _reciprocal(solid_angle: mi.Float) -> mi.Float:
    return dr.select(solid_angle > 0, dr.rcp(dr.maximum(solid_angle, 1e-37)), 0)
