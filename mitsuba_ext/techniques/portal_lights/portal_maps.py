"""An environment in coordinates in which the view through a portal is a rectangle.

Source: B. Bitterli, J. Novák, W. Jarosz, *Portal-Masked Environment Map Sampling*, Computer
Graphics Forum 34(4), 2015.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.lights.environment_directions import EnvironmentDirections
from ...scene.lights.sun import SunDisk
from ...scene.portals import Portal
from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from ...util.spectra import brightness, comparison_wavelengths

#: The fewest and the most texels of a map along each axis, which spans half a turn.
_LEAST, _MOST = 256, 2048

#: Number of directions that are evaluated in each texel, along each axis.
_LOOKS = 2

#: Number of directions that are evaluated in a sun that is a disk.
_SUN_LOOKS = 1 << 14

#: Added to each texel, relative to the mean of all.
_FLOOR = 1e-3

#: Portals whose axes agree to this number of digits share a map.
_DIGITS = 5


@dataclass
class Window:
    """The part of a map that is seen from a point through a portal.

    Attributes:
        map: The number of the map.
        low, high: Its corners, in texels.
        total: The sum of the texels inside, in units of a whole map; 0 where the portal is not seen
            from inside.
        frame: x and y along the edges of the portal, z out of the room.
    """

    map: mi.UInt32
    low: mi.Point2f
    high: mi.Point2f
    total: mi.Float64
    frame: mi.Frame3f


class PortalMaps:
    """Summed-area tables of the environment, one for each orientation of portals, in the angles α
    and β whose tangents are x / z and y / z: lines along the edges of the portal are straight.

    Parameters:
        scene: The scene with the environment emitter.
        portals: One or more.

    Attributes:
        count: Number of portals.
        resolution: Texels of a map along each axis.
    """

    def __init__(self, scene: mi.Scene, portals: list[Portal]) -> None:
        self.directions = EnvironmentDirections(scene)
        self._sun = SunDisk.of(self.directions.emitter)
        width = _LEAST
        if self.directions.is_map:
            width = mi.traverse(self.directions.emitter)["data"].shape[1]
        self.resolution = int(np.clip(width, _LEAST, _MOST))
        frames: dict[tuple, int] = {}
        rows = []
        for p in portals:
            axes = np.concatenate([p.x, p.y, p.outwards])
            number = frames.setdefault(tuple(np.round(axes, _DIGITS) + 0.0), len(frames))
            size = [p.half_width, p.half_height]
            rows.append([*p.center, *axes, *size, number])
        self.count = len(portals)
        self._portals = from_numpy(mi.Float, rows)
        self._row = len(rows[0])
        tables = [self._texels(np.array(frame).reshape(3, 3)) for frame in frames]
        n = self.resolution
        sums = np.zeros((len(tables), n + 1, n + 1))
        sums[:, 1:, 1:] = np.cumsum(np.cumsum(tables, axis=1), axis=2)
        # The same scale for all orientations: portals are chosen by these sums
        scale = 1 / sums[0, -1, -1]
        self._sums = from_numpy(mi.Float64, scale * sums)
        values = scale * (n / np.pi) ** 2 * np.ravel(tables)
        self._values = from_numpy(mi.Float, values)
        self._size = dr.opaque(mi.UInt32, n)

    # ---- From a point ----

    def window(self, index: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> Window:
        """The window of portal ``index`` from the point ``p``."""
        row = self._portal(index, active)
        x, y, z = (mi.Vector3f(*row[i : i + 3]) for i in (3, 6, 9))
        frame = mi.Frame3f(x, y, z)
        center = frame.to_local(mi.Point3f(*row[:3]) - p)
        seen = active & (center.z > 0)
        half = mi.Vector3f(row[12], row[13], 0)
        low, high = self._texel(center - half), self._texel(center + half)
        window = Window(mi.UInt32(row[14]), low, high, mi.Float64(0), frame)
        total = self._column_sum(window, high.x, seen) - self._column_sum(window, low.x, seen)
        window.total = dr.select(seen & (total > 0), total, 0)
        return window

    @dr.syntax
    def sample(
        self, window: Window, point: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float64]:
        """A direction through the portal, and the value of :meth:`emitted` there. That value
        divided by the sum of the window is the density of the sample."""
        first, end = self._range(window.low.x, window.high.x)
        before = self._column_sum(window, window.low.x, active)
        goal = before + mi.Float64(point.x) * window.total
        left, right = mi.UInt32(first), mi.UInt32(end)
        below, above = mi.Float64(before), before + window.total
        while dr.hint(active & (right - left > 1), label="columns"):
            middle = (left + right) // 2
            sum = self._column_sum(window, mi.Float(middle), active)
            is_left = goal < sum
            right, above = dr.select(is_left, middle, right), dr.select(is_left, sum, above)
            left, below = dr.select(is_left, left, middle), dr.select(is_left, below, sum)
        x = _between(goal, below, above, left, right, window.low.x, window.high.x)
        column = left

        first, end = self._range(window.low.y, window.high.y)
        before = self._row_sum(window, column, window.low.y, active)
        after = self._row_sum(window, column, window.high.y, active)
        goal = before + mi.Float64(point.y) * (after - before)
        left, right = mi.UInt32(first), mi.UInt32(end)
        below, above = mi.Float64(before), mi.Float64(after)
        while dr.hint(active & (right - left > 1), label="rows"):
            middle = (left + right) // 2
            sum = self._row_sum(window, column, mi.Float(middle), active)
            is_left = goal < sum
            right, above = dr.select(is_left, middle, right), dr.select(is_left, sum, above)
            left, below = dr.select(is_left, left, middle), dr.select(is_left, below, sum)
        y = _between(goal, below, above, left, right, window.low.y, window.high.y)

        size = mi.Float(self._size)
        tx, ty = (dr.tan((v / size - 0.5) * dr.pi) for v in (x, y))
        local = dr.normalize(mi.Vector3f(tx, ty, 1))
        value = self._emitted(window.map, column, left, local, active & (window.total > 0))
        return window.frame.to_world(local), value

    def emitted(
        self, index: mi.UInt32, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool
    ) -> mi.Float64:
        """The emission of the map in the direction ``d``, if that leads from ``p`` out through
        portal ``index``; else 0. Its integral over directions is the sum of the window."""
        row = self._portal(index, active)
        frame = mi.Frame3f(*(mi.Vector3f(*row[i : i + 3]) for i in (3, 6, 9)))
        center, local = frame.to_local(mi.Point3f(*row[:3]) - p), frame.to_local(d)
        inside = active & (center.z > 0) & (local.z > 0)
        # Where the direction meets the plane of the portal, without a division
        inside &= dr.abs(local.x * center.z - center.x * local.z) <= row[12] * local.z
        inside &= dr.abs(local.y * center.z - center.y * local.z) <= row[13] * local.z
        at = self._texel(local)
        column, row_index = (dr.minimum(mi.UInt32(v), self._size - 1) for v in (at.x, at.y))
        return self._emitted(mi.UInt32(row[14]), column, row_index, local, inside)

    def _portal(self, index: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        return [
            dr.gather(mi.Float, self._portals, index * self._row + i, active)
            for i in range(self._row)
        ]

    def _emitted(self, map, column, row, local, active) -> mi.Float64:
        texel = (map * self._size + row) * self._size + column
        value = mi.Float64(dr.gather(mi.Float, self._values, texel, active))
        # dα dβ / dω; the cosines to the edges are not 1, because z is positive
        area = (1 - dr.square(local.x)) * (1 - dr.square(local.y))
        return dr.select(active & (area > 0), value * mi.Float64(local.z / area), 0)

    def _range(self, low: mi.Float, high: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
        """The first texel of an interval, and that after the last."""
        first = dr.minimum(mi.UInt32(low), self._size - 1)
        return first, dr.clip(mi.UInt32(dr.ceil(high)), first + 1, self._size)

    def _column_sum(self, window: Window, x: mi.Float, active: mi.Bool) -> mi.Float64:
        """The sum over the columns of the window up to ``x``, plus a constant."""
        column, fx = self._split(x)
        sums = []
        for y in (window.low.y, window.high.y):
            row, fy = self._split(y)
            s00, s10, s01, s11 = (
                self._sum(window, column + i, row + j, active)
                for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
            )
            sums.append(dr.lerp(dr.lerp(s00, s10, fx), dr.lerp(s01, s11, fx), fy))
        return sums[1] - sums[0]

    def _row_sum(self, window: Window, column: mi.UInt32, y: mi.Float, active) -> mi.Float64:
        """The sum over the rows of one ``column`` up to ``y``."""
        row, fy = self._split(y)
        below, above = (
            self._sum(window, column + 1, row + j, active) - self._sum(window, column, row + j,
                                                                        active)
            for j in (0, 1)
        )  # fmt: skip
        return dr.lerp(below, above, fy)

    def _split(self, at: mi.Float) -> tuple[mi.UInt32, mi.Float64]:
        """The texel of a coordinate, and the fraction within it, in which sums are linear."""
        texel = dr.minimum(mi.UInt32(at), self._size - 1)
        return texel, mi.Float64(at - mi.Float(texel))

    def _texel(self, local: mi.Vector3f) -> mi.Point2f:
        """Coordinates of a direction out of the room, in texels."""
        size = mi.Float(self._size)
        z = dr.maximum(local.z, 1e-20)
        angles = mi.Point2f(dr.atan2(local.x, z), dr.atan2(local.y, z))
        return dr.clip((angles * dr.inv_pi + 0.5) * size, 0, size)

    def _sum(self, window, column, row, active) -> mi.Float64:
        stride = self._size + 1
        return dr.gather(mi.Float64, self._sums, (window.map * stride + row) * stride + column,
                         active)  # fmt: skip

    # ---- The maps ----

    def _texels(self, frame: np.ndarray) -> np.ndarray:
        """The brightness of each texel times its solid angle, [row, column]."""
        n = self.resolution
        fine = n * _LOOKS
        index = dr.arange(mi.UInt32, fine * fine)
        row = index // fine
        u, v = (mi.Float(i) + 0.5 for i in (index - row * fine, row))
        tx, ty = (dr.tan((x / fine - 0.5) * dr.pi) for x in (u, v))
        local = dr.normalize(mi.Vector3f(tx, ty, 1))
        area = (1 - dr.square(local.x)) * (1 - dr.square(local.y)) / local.z
        axes = [mi.Vector3f(*(float(a) for a in axis)) for axis in frame]
        value = self._brightness(mi.Frame3f(*axes).to_world(local)) * area
        values = value.numpy().astype(np.float64).reshape(n, _LOOKS, n, _LOOKS).mean(axis=(1, 3))
        values *= (np.pi / n) ** 2
        if self._sun is not None:
            values += self._sun_texels(mi.Frame3f(*axes))
        return values + _FLOOR * values.mean() + 1e-30

    def _sun_texels(self, frame: mi.Frame3f) -> np.ndarray:
        numbers = mi.PCG32(size=_SUN_LOOKS)
        d = self._sun.sample(mi.Point2f(numbers.next_float32(), numbers.next_float32()))
        value = self._light(d).numpy() * self._sun.solid_angle / _SUN_LOOKS
        local = frame.to_local(d)
        n = self.resolution
        z = dr.maximum(local.z, 1e-20)
        x, y = (
            ((np.arctan2(a.numpy(), z.numpy()) / np.pi + 0.5) * n).astype(int).clip(0, n - 1)
            for a in (local.x, local.y)
        )
        texels = np.zeros((n, n))
        np.add.at(texels, (y, x), np.where(local.z.numpy() > 0, value, 0))
        return texels

    def _brightness(self, d: mi.Vector3f) -> mi.Float:
        value = self._light(d)
        return value if self._sun is None else dr.select(self._sun.contains(d), 0, value)

    def _light(self, d: mi.Vector3f) -> mi.Float:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
        si.wi = -d
        si.wavelengths = comparison_wavelengths(dr.width(d))
        value = brightness(self.directions.emitter.eval(si))
        return dr.select(dr.isfinite(value), value, dr.zeros(mi.Float, dr.width(d)))


def _between(
    goal: mi.Float64,
    below: mi.Float64,
    above: mi.Float64,
    left: mi.UInt32,
    right: mi.UInt32,
    low: mi.Float,
    high: mi.Float,
) -> mi.Float:
    """The coordinate at which a sum reaches ``goal``: it grows linearly from ``below`` to ``above``
    over the part of [``left``, ``right``] within [``low``, ``high``]."""
    start, end = dr.maximum(mi.Float(left), low), dr.minimum(mi.Float(right), high)
    part = above - below
    t = dr.select(part > 0, mi.Float((goal - below) / part), 0.5)
    return dr.clip(dr.lerp(start, end, dr.clip(t, 0, ONE_MINUS_EPSILON)), start, end)
