"""Rigid motion in time: its description, its bounds, and its poses on the device.

A motion maps a point p of the *rest frame* to R(t) · (p − center) + position(t). It is a sequence
of segments. During each, the position moves at constant velocity, and the rotation has a constant
angular velocity about an axis that is fixed in the world. There is no motion before the first
segment or after the last one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from ...util.arrays import from_numpy

#: The maximum angle and the maximum number of the steps in which the bounds of a rotation are
#: computed.
_BOUNDS_STEP = math.radians(3)
_MAX_BOUNDS_STEPS = 4096

#: The number of 4-vectors that describe a segment on the device.
_ROW = 5


@dataclass(frozen=True)
class Motion:
    """A rigid motion of S segments.

    Attributes:
        times: Start times of the segments, and the end time of the last one: [S + 1], increasing.
        positions: Positions of the center at these times: [S + 1, 3].
        starts: Rotations at the start of the segments, as quaternions (x, y, z, w): [S, 4].
        turns: Rotation vectors of the segments (axis times angle in radians, which may exceed a
            full turn): [S, 3].
        center: The point of the rest frame about which rotations turn: [3].
    """

    times: np.ndarray
    positions: np.ndarray
    starts: np.ndarray
    turns: np.ndarray
    center: np.ndarray

    @staticmethod
    def uniform(
        begin: float,
        end: float,
        translate: Sequence[float],
        turn: Sequence[float] = (0, 0, 0),
        center: Sequence[float] = (0, 0, 0),
    ) -> Motion:
        """A motion that starts at ``begin`` and ends at ``end``. It displaces everything by
        ``translate``, and rotates it by the rotation vector ``turn`` (radians) about ``center``,
        which is displaced as well."""
        center = np.array(center, dtype=np.float64)
        return Motion(
            times=np.array([begin, end], dtype=np.float64),
            positions=np.stack([center, center + np.asarray(translate, dtype=np.float64)]),
            starts=np.array([[0.0, 0.0, 0.0, 1.0]]),
            turns=np.array([turn], dtype=np.float64),
            center=center,
        )

    @staticmethod
    def keyed(times: Sequence[float], poses: Sequence[np.ndarray]) -> Motion:
        """A motion through ``poses`` (rigid 4×4 matrices) at ``times``. In between, positions of
        the rest frame's origin are interpolated linearly, rotations by slerp (the shorter way)."""
        matrices = np.asarray(poses, dtype=np.float64)
        rotations = Rotation.from_matrix(matrices[:, :3, :3])
        return Motion(
            times=np.array(times, dtype=np.float64),
            positions=matrices[:, :3, 3],
            starts=rotations[:-1].as_quat(),
            turns=(rotations[1:] * rotations[:-1].inv()).as_rotvec(),
            center=np.zeros(3),
        )

    def move(self, points: np.ndarray, time: float) -> np.ndarray:
        """The positions, at ``time``, of points [n, 3] of the rest frame."""
        k = int(np.clip(np.searchsorted(self.times, time, "right") - 1, 0, len(self.turns) - 1))
        x = np.clip((time - self.times[k]) / (self.times[k + 1] - self.times[k]), 0, 1)
        return self._move_in_segment(np.asarray(points), k, x)

    def bounds(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A box that holds the convex hull of ``corners`` [n, 3], given in the rest frame, at all
        times.

        Returns:
            Its lower and its upper corner.
        """
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for k, turn in enumerate(self.turns):
            angle = np.linalg.norm(turn)
            steps = int(np.clip(math.ceil(angle / _BOUNDS_STEP), 1, _MAX_BOUNDS_STEPS))
            moved = np.stack(
                [self._move_in_segment(corners, k, i / steps) for i in range(steps + 1)]
            )
            # Between two steps, a corner deviates from the straight line by at most the sagitta of
            # an arc of the largest radius
            radius = np.linalg.norm(corners - self.center, axis=1).max()
            sagitta = radius * (1 - math.cos(min(angle / steps / 2, math.pi)))
            low = np.minimum(low, moved.min(axis=(0, 1)) - sagitta)
            high = np.maximum(high, moved.max(axis=(0, 1)) + sagitta)
        return low, high

    def box(self, at_rest: mi.ScalarBoundingBox3f) -> mi.ScalarBoundingBox3f:
        """:meth:`bounds` of a box."""
        corners = np.array([list(at_rest.corner(i)) for i in range(8)], dtype=np.float64)
        return mi.ScalarBoundingBox3f(*self.bounds(corners))

    def _move_in_segment(self, points: np.ndarray, k: int, x: float) -> np.ndarray:
        rotation = Rotation.from_rotvec(self.turns[k] * x) * Rotation.from_quat(self.starts[k])
        position = (1 - x) * self.positions[k] + x * self.positions[k + 1]
        return rotation.apply(points - self.center) + position


@dataclass
class Pose:
    """The pose of a mover at one time per lane."""

    rotation: mi.Matrix3f
    position: mi.Point3f
    center: mi.Point3f

    def to_rest(self, ray: mi.Ray3f) -> mi.Ray3f:
        """The ray in the rest frame; distances along it stay the same."""
        moved = mi.Ray3f(ray)
        moved.o = self.point_to_rest(ray.o)
        moved.d = self.rotation.T @ ray.d
        return moved

    def ray_to_rest(self, ray: mi.RayDifferential3f) -> mi.RayDifferential3f:
        """:meth:`to_rest` of a ray and its differentials."""
        return _moved(ray, self.point_to_rest, self.rotation.T)

    def ray_to_world(self, ray: mi.Ray3f) -> mi.Ray3f:
        """The ray of the rest frame, with its differentials if it has them, in the world."""
        return _moved(ray, self.point_to_world, self.rotation)

    def point_to_rest(self, p: mi.Point3f) -> mi.Point3f:
        """The point in the rest frame."""
        return self.rotation.T @ (p - self.position) + self.center

    def point_to_world(self, p: mi.Point3f) -> mi.Point3f:
        """The point of the rest frame in the world."""
        return self.rotation @ (p - self.center) + self.position

    def to_world(self, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """Transforms an interaction from the rest frame to the world. ``wi``, which is relative to
        the shading frame, and ``uv`` stay the same."""
        R = self.rotation
        si.p = self.point_to_world(si.p)
        si.n = R @ si.n
        frame = si.sh_frame
        si.sh_frame = mi.Frame3f(R @ frame.s, R @ frame.t, R @ frame.n)
        si.dp_du, si.dp_dv = R @ si.dp_du, R @ si.dp_dv
        si.dn_du, si.dn_dv = R @ si.dn_du, R @ si.dn_dv
        return si


def _moved(ray: mi.Ray3f, move: Callable, rotation: mi.Matrix3f) -> mi.Ray3f:
    moved = type(ray)(ray)
    parts = [("o", "d")]
    if isinstance(ray, mi.RayDifferential3f):
        moved.has_differentials = ray.has_differentials
        parts += [("o_x", "d_x"), ("o_y", "d_y")]
    for o, d in parts:
        setattr(moved, o, move(getattr(ray, o)))
        setattr(moved, d, rotation @ getattr(ray, d))
    return moved


class PoseTable:
    """Several motions on the device."""

    def __init__(self, motions: Sequence[Motion]) -> None:
        # Each motion gets as many rows as the longest one has; the excess rows are never reached
        self._stride = max(len(motion.turns) for motion in motions)
        rows = np.zeros((len(motions), self._stride, _ROW, 4))
        rows[:, :, 2, 3] = np.inf  # the time when a row's segment begins
        for index, motion in enumerate(motions):
            rows[index, : len(motion.turns)] = _rows(motion)
        self._rows = from_numpy(mi.Float, rows)

    def pose(self, index: mi.UInt32, time: mi.Float) -> Pose:
        """The pose of the motion ``index`` at ``time``."""
        row = self._segment(index * self._stride, time)
        start, turn, origin, path, center = (self._column(row, column) for column in range(_ROW))
        x = dr.clip((time - origin.w) * path.w, 0, 1)
        sin, cos = dr.sincos(turn.w * x)
        axis = turn.xyz
        q = mi.Quaternion4f(axis.x * sin, axis.y * sin, axis.z * sin, cos) * mi.Quaternion4f(start)
        return Pose(
            rotation=dr.quat_to_matrix(mi.Matrix3f, q),
            position=mi.Point3f(dr.fma(path.xyz, x, origin.xyz)),
            center=mi.Point3f(center.xyz),
        )

    def _segment(self, first: mi.UInt32, time: mi.Float) -> mi.UInt32:
        """The row of the last segment that began before ``time``; ``first`` if none did."""
        if self._stride == 1:
            return first
        last = self._stride - 1

        def has_begun(k: mi.UInt32) -> mi.Bool:
            # The search also evaluates k = last, and ignores the result
            return self._column(first + dr.minimum(k + 1, last), 2).w <= time

        return first + dr.binary_search(0, last, has_begun)

    def _column(self, row: mi.UInt32, column: int) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, self._rows, row * _ROW + column)


def _rows(motion: Motion) -> np.ndarray:
    """The segments in the layout of the device: start; axis and half the angle; position and time
    at the start; displacement and 1 / duration; center. Shape [S, _ROW, 4]."""
    angles = np.linalg.norm(motion.turns, axis=1, keepdims=True)
    axes = np.divide(motion.turns, angles, out=np.zeros_like(motion.turns), where=angles > 0)
    durations = np.diff(motion.times)[:, None]
    count = len(motion.turns)
    columns = [
        motion.starts,
        np.hstack([axes, angles / 2]),
        np.hstack([motion.positions[:-1], motion.times[:-1, None]]),
        np.hstack([np.diff(motion.positions, axis=0), 1 / durations]),
        np.hstack([np.tile(motion.center, (count, 1)), np.zeros((count, 1))]),
    ]
    return np.stack(columns, axis=1)
