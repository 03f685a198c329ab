"""Convex polygons, sampled in proportion to the cosine with a receiver's normal.

The Nusselt analog: the polygon's part of the unit sphere, projected on the plane of the receiver,
is a region of the unit disk. Projected solid angle sampling chooses a uniform point of this region
(J. Arvo, *Stratified Sampling of 2-Manifolds*; course, 4.4). The region is sampled in polar
coordinates: first the angle, then the squared radius, which is uniform between two edges. Parts
above and below the horizon are two regions.

Twice the area between the pole and an edge, up to an angle, is the arc length times the z component
of the normal of the edge's plane (Eq. 4.53). If the pole lies in the polygon, the area is inverted
edge by edge. Otherwise, the region lies between a near and a far chain of edges, and the difference
of their areas is inverted by Newton's method.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: The maximum number of steps of Newton's method, each kept inside a bracket, and the tolerated
#: error as a fraction of the area: the rounding error of single precision.
_STEPS, _TOLERANCE = 9, 3e-7

_TINY = 1e-30


@dataclass
class _Edge:
    """A part of a great circle above the horizon.

    Attributes:
        start, end: Its ends, unit vectors.
        normal: Normal of its plane, about which the edge turns counterclockwise from start to end.
        length: The angle between its ends; 0 if it lies below the horizon.
    """

    start: mi.Vector3f
    end: mi.Vector3f
    normal: mi.Vector3f
    length: mi.Float

    def at(self, angle: mi.Float) -> mi.Vector3f:
        sin, cos = dr.sincos(angle)
        return cos * self.start + sin * dr.cross(self.normal, self.start)


class ProjectedPolygon:
    """The part of a convex polygon on one side of the horizon: where z > 0.

    Parameters:
        corners: Unit vectors, in the frame of the receiver.
        normals: Normals of the planes through the origin and the edges (corner k to k + 1).
        side: 1, or -1 for the part below the horizon, which is reflected up.

    Attributes:
        area: Its projected solid angle.
    """

    def __init__(
        self, corners: list[mi.Vector3f], normals: list[mi.Vector3f], side: mi.Float | float = 1.0
    ) -> None:
        corners = [mi.Vector3f(v.x, v.y, side * v.z) for v in corners]
        normals = [mi.Vector3f(side * n.x, side * n.y, n.z) for n in normals]
        leave, enter = mi.Vector3f(1, 0, 0), mi.Vector3f(1, 0, 0)
        self._edges, total = [], mi.Float(0)
        self._holds_pole = mi.Bool(True)
        for k, (a, normal) in enumerate(zip(corners, normals)):
            b = corners[(k + 1) % len(corners)]
            above_a, above_b = a.z > 0, b.z > 0
            crosses = above_a != above_b
            t = a.z / dr.select(crosses, a.z - b.z, 1)
            crossing = dr.fma(b - a, t, a)
            crossing.z = 0
            crossing /= dr.maximum(dr.norm(crossing), _TINY)
            leave = dr.select(crosses & above_a, crossing, leave)
            enter = dr.select(crosses & above_b, crossing, enter)
            start, end = dr.select(above_a, a, crossing), dr.select(above_b, b, crossing)
            edge = _Edge(start, end, normal, _angle(start, end))
            edge.length = dr.select(above_a | above_b, edge.length, 0)
            self._edges.append(edge)
            total += normal.z * edge.length
        # Along the horizon, from where the polygon leaves the upper half space to where it enters
        turn = dr.select(leave.x * enter.y < leave.y * enter.x, mi.Float(-1), 1)
        horizon = _Edge(leave, enter, mi.Vector3f(0, 0, turn), _angle(leave, enter))
        self._edges.append(horizon)
        total += turn * horizon.length
        # Polygons seen from behind are clockwise
        self._turn = dr.select(total < 0, mi.Float(-1), 1)
        for normal in normals:
            self._holds_pole &= self._turn * normal.z > 0
        self.area = 0.5 * dr.abs(total)

    def sample(self, sample: mi.Point2f, active: mi.Bool = True) -> mi.Vector3f:
        """Samples a unit vector in the polygon, with a density proportional to its z."""
        target = 2 * self.area * sample.x
        # ----- The pole inside: an edge, a point of it, and a point between this and the pole -----
        before, chosen, passed = mi.Float(0), self._edges[0], mi.Float(0)
        for edge in self._edges:
            is_next = (target >= before) & (edge.length > 0)
            chosen = dr.select(is_next, edge, chosen)
            passed = dr.select(is_next, before, passed)
            before = before + self._turn * edge.normal.z * edge.length
        slope = self._turn * chosen.normal.z
        angle = (target - passed) / dr.select(slope > _TINY, slope, 1)
        rim = chosen.at(dr.clip(angle, 0, chosen.length))
        # ----- The pole outside: an azimuth, relative to the middle of the polygon -----
        middle = dr.zeros(mi.Vector3f)
        for edge in self._edges:
            middle += dr.select(edge.length > 0, edge.start + edge.end, 0)
        middle = mi.Vector2f(middle.x, middle.y) / dr.maximum(
            dr.sqrt(dr.square(middle.x) + dr.square(middle.y)), _TINY
        )
        chains = [_Arc.of(edge, self._turn, middle) for edge in self._edges]
        azimuth = _invert(chains, target, 2 * self.area, active & ~self._holds_pole)
        low, high = _radii(chains, azimuth)
        sin, cos = dr.sincos(azimuth)
        x, y = cos * middle.x - sin * middle.y, cos * middle.y + sin * middle.x
        # ----- The squared radius is uniform -----
        radius_2 = dr.square(rim.x) + dr.square(rim.y)
        length = dr.sqrt(dr.maximum(radius_2, _TINY))
        x = dr.select(self._holds_pole, rim.x / length, x)
        y = dr.select(self._holds_pole, rim.y / length, y)
        low, high = dr.select(self._holds_pole, 0, low), dr.select(self._holds_pole, radius_2, high)
        r_2 = dr.clip(dr.lerp(low, high, sample.y), 0, 1)
        r = dr.sqrt(r_2)
        return mi.Vector3f(r * x, r * y, dr.sqrt(1 - r_2))


@dataclass
class _Arc:
    """An edge in the polar coordinates of a pole outside the polygon.

    Attributes:
        low, high: Azimuths of its ends, relative to the middle of the polygon.
        end: Its end with the lower azimuth.
        across: Vector in its plane, perpendicular to ``end``, towards the other end.
        normal: Normal of its plane, with a positive z.
        weight: ± the z component of the normal: + for edges far from the pole, − for near ones.
    """

    low: mi.Float
    high: mi.Float
    end: mi.Vector3f
    across: mi.Vector3f
    normal: mi.Vector3f
    weight: mi.Float

    @staticmethod
    def of(edge: _Edge, turn: mi.Float, middle: mi.Vector2f) -> _Arc:
        def turned(v: mi.Vector3f) -> mi.Vector3f:
            return mi.Vector3f(
                v.x * middle.x + v.y * middle.y, v.y * middle.x - v.x * middle.y, v.z
            )

        start, end, normal = (turned(v) for v in (edge.start, edge.end, edge.normal))
        first, last = dr.atan2(start.y, start.x), dr.atan2(end.y, end.x)
        is_backwards = normal.z < 0
        first, last = dr.select(is_backwards, last, first), dr.select(is_backwards, first, last)
        weight = dr.select(edge.length > 0, turn * normal.z, 0)
        start = dr.select(is_backwards, end, start)
        normal = dr.select(is_backwards, -normal, normal)
        return _Arc(
            first, dr.maximum(first, last), start, dr.cross(normal, start), normal, weight
        )

    def passed(self, azimuth: mi.Float) -> mi.Float:
        """Twice the area between the pole and the part of the edge below this azimuth, with the
        sign of ``weight``."""
        sin, cos = dr.sincos(dr.clip(azimuth, self.low, self.high))
        slope = self.normal.x * cos + self.normal.y * sin
        point = mi.Vector3f(cos * self.normal.z, sin * self.normal.z, -slope)
        angle = dr.atan2(dr.dot(point, self.across), dr.dot(point, self.end))
        return self.weight * dr.maximum(angle, 0)

    def radius_2(self, cos: mi.Float, sin: mi.Float) -> mi.Float:
        """The squared distance from the pole in the disk."""
        z_2 = dr.square(self.normal.z)
        slope = self.normal.x * cos + self.normal.y * sin
        return z_2 / dr.maximum(z_2 + dr.square(slope), _TINY)


def _invert(
    arcs: list[_Arc], target: mi.Float, total: mi.Float, is_needed: mi.Bool
) -> mi.Float:
    """The azimuth below which twice the area of the polygon is ``target``. ``total`` is twice the
    whole area."""
    low, high = mi.Float(dr.inf), mi.Float(-dr.inf)
    for arc in arcs:
        low = dr.select(arc.weight != 0, dr.minimum(low, arc.low), low)
        high = dr.select(arc.weight != 0, dr.maximum(high, arc.high), high)
    low, high = dr.select(dr.isfinite(low), low, 0), dr.select(dr.isfinite(high), high, 0)
    azimuth = dr.lerp(low, high, target / dr.maximum(total, _TINY))

    def improve(step, azimuth, low, high):
        sum = mi.Float(0)
        for arc in arcs:
            sum += arc.passed(azimuth)
        near, far = _radii(arcs, azimuth)
        is_below, gap = sum < target, target - sum
        low, high = dr.select(is_below, azimuth, low), dr.select(is_below, high, azimuth)
        next = azimuth + gap / dr.maximum(far - near, _TINY)
        next = dr.select((next >= low) & (next <= high), next, 0.5 * (low + high))
        is_found = dr.abs(gap) <= _TOLERANCE * total
        return dr.select(is_found, _STEPS, step + 1), next, low, high

    width = max(dr.width(azimuth), dr.width(target))
    state = dr.select(is_needed, dr.zeros(mi.UInt32, width), _STEPS), azimuth, low, high
    return dr.while_loop(state, lambda step, *_: step < _STEPS, improve)[1]


def _radii(arcs: list[_Arc], azimuth: mi.Float) -> tuple[mi.Float, mi.Float]:
    """The squared radii between which the polygon lies at an azimuth."""
    near, far = mi.Float(0), mi.Float(0)
    sin, cos = dr.sincos(azimuth)
    for arc in arcs:
        is_there = (azimuth >= arc.low) & (azimuth <= arc.high)
        radius_2 = arc.radius_2(cos, sin)
        near = dr.select(is_there & (arc.weight < 0), dr.maximum(near, radius_2), near)
        far = dr.select(is_there & (arc.weight > 0), dr.maximum(far, radius_2), far)
    return dr.minimum(near, far), far


def _angle(a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    return dr.atan2(dr.norm(dr.cross(a, b)), dr.dot(a, b))
