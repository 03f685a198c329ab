"""The emission of an environment emitter, as a table of texels of latitude and longitude."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.spectra import brightness, comparison_wavelengths
from .environment_directions import EnvironmentDirections
from .sun import SunDisk

#: The numbers of columns and rows of nodes at which emitters without a map are evaluated. Features
#: smaller than the 0.35° between two nodes are found only if the emitter's own sampling finds them.
#: The disk of the sun is excluded.
_NODES = (1024, 513)

#: Columns and rows of nodes of a constant emitter, for which only sin θ is interpolated.
_CONSTANT_NODES = (64, 33)

#: The number of samples taken with the emitter's own sampling if it has no map.
_OWN_SAMPLES = 1 << 16

#: The weight of black texels, relative to the mean.
_FLOOR = 1e-3


class EnvironmentTexels:
    """The brightness of an environment at the corners of texels, between which it is interpolated.

    For maps, these are the nodes between which Mitsuba's ``envmap`` interpolates, so a density
    interpolated in the same way is proportional to the emission.

    Parameters:
        scene: The scene with the environment emitter.

    Attributes:
        directions (EnvironmentDirections): The directions of the emitter.
        sun (SunDisk | None): The sun of a ``sunsky``. Its emission is not in the table.
        columns, rows (int): Numbers of texels.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.directions = EnvironmentDirections(scene)
        emitter = self.directions.emitter
        self.sun = SunDisk.of(emitter)
        if self.directions.is_map:
            height, width = mi.traverse(emitter)["data"].shape[:2]
            # Mitsuba adds two columns, both copies. The first and the last row are the poles
            self.columns, self.rows = width - 2, height - 1
        else:
            is_constant = emitter.class_name() == "ConstantBackgroundEmitter"
            columns, rows = _CONSTANT_NODES if is_constant else _NODES
            self.columns, self.rows = columns, rows - 1
        # The nodes of a map are at the middles of its columns
        self._shift = 0.5 / self.columns

    def corners(self) -> np.ndarray:
        """Brightness times sin θ at the corners of each texel, all positive; shape [rows · columns,
        4]. Computed at each call, so that large maps are not kept in memory twice."""
        node = self.nodes()
        corners = np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]], axis=-1)
        return corners.reshape(-1, 4)

    @property
    def area(self) -> float:
        """The factor that converts the mean over texels of brightness times sin θ to the integral
        of the brightness over the sphere."""
        return 2 * np.pi**2

    def sun_emission(self) -> float:
        """The integral of the brightness over the disk of the sun; 0 without one."""
        if self.sun is None:
            return 0.0
        n = 64
        x, y = dr.meshgrid(*2 * [(dr.arange(mi.Float, n) + 0.5) / n])
        si = dr.zeros(mi.SurfaceInteraction3f, n * n)
        si.wi = -self.sun.sample(mi.Point2f(x, y))
        si.wavelengths = comparison_wavelengths(n * n)
        value = float(dr.mean(brightness(self.directions.emitter.eval(si)))[0])
        return value * self.sun.solid_angle

    def direction(
        self, texel: mi.UInt32, point: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.Float, mi.Point2f]:
        """The direction of a point of a texel, the sine of its polar angle, and its ``uv``."""
        row = texel // self.columns
        uv = mi.Point2f(
            (mi.Float(texel - row * self.columns) + point.x) / self.columns + self._shift,
            (mi.Float(row) + point.y) / self.rows,
        )
        return *self.directions.direction(uv), uv

    def node_direction(self, x: mi.UInt32, y: mi.UInt32) -> mi.Vector3f:
        """The direction of a corner of texels."""
        u = mi.Float(x) / self.columns + self._shift
        return self.directions.direction(mi.Point2f(u, mi.Float(y) / self.rows))[0]

    def find(self, d: mi.Vector3f) -> tuple[mi.UInt32, mi.UInt32, mi.Point2f, mi.Float]:
        """Column and row of the texel of a direction, the point of the texel, and the sine of the
        polar angle."""
        uv, sin_theta = self.directions.uv(d)
        u = uv.x - self._shift
        x, y = (u - dr.floor(u)) * self.columns, uv.y * self.rows
        column = dr.minimum(mi.UInt32(x), self.columns - 1)
        row = dr.minimum(mi.UInt32(y), self.rows - 1)
        return column, row, mi.Point2f(x - mi.Float(column), y - mi.Float(row)), sin_theta

    def radiance(
        self, ref: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool
    ) -> mi.Spectrum:
        """The radiance from the direction of ``ds``, whose ``uv`` is known."""
        if self.directions.is_map:
            # From the sample's uv, without searching for the texel
            return self.directions.emitter.eval_direction(ref, ds, active)
        return self.directions.radiance(ref, ds.d, active)

    def nodes(self) -> np.ndarray:
        """Brightness times sin θ at the corners of texels, all positive, the first column repeated;
        shape [rows + 1, columns + 1]."""
        columns, rows = self.columns, self.rows
        index = dr.arange(mi.UInt32, columns * (rows + 1))
        row = index // columns
        u = mi.Float(index - row * columns) / columns + self._shift
        # Not exactly at the poles, where a direction belongs to no column
        v = dr.clip(mi.Float(row), 1e-2, rows - 1e-2) / rows
        value = self._brightness(mi.Point2f(u, v)).numpy().reshape(rows + 1, columns)
        if not self.directions.is_map:
            # The largest value around each node, and the values of the emitter's own samples there,
            # so that features between the nodes are not missed
            value = np.maximum(value, self._own_samples(value.shape))
            wide = np.maximum(value, np.maximum(np.roll(value, 1, 1), np.roll(value, -1, 1)))
            padded = np.pad(wide, ((1, 1), (0, 0)), mode="edge")
            value = np.maximum(wide, np.maximum(padded[:-2], padded[2:]))
        value = value + _FLOOR * value.mean() + 1e-30
        sin_theta = np.sin(np.linspace(0, np.pi, rows + 1))
        # Not zero at the poles, where a texel still has an area
        sin_theta[[0, -1]] = 0.25 * np.sin(np.pi / rows)
        value = value * sin_theta[:, None]
        return np.concatenate([value, value[:, :1]], axis=1)

    def _own_samples(self, shape: tuple[int, int]) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, _OWN_SAMPLES)
        ref = dr.zeros(mi.Interaction3f, _OWN_SAMPLES)
        ref.p = self.directions.center
        ref.wavelengths = comparison_wavelengths(_OWN_SAMPLES)
        ds, weight = self.directions.emitter.sample_direction(ref, sampler.next_2d())
        value = brightness(weight) * ds.pdf
        if self.sun is not None:
            value = dr.select(self.sun.contains(ds.d), 0, value)
        value = (value + dr.zeros(mi.Float, _OWN_SAMPLES)).numpy()
        uv = self.directions.uv(ds.d)[0].numpy()
        result = np.zeros(shape)
        u = uv[0] - self._shift
        x = np.minimum(((u - np.floor(u)) * self.columns).astype(int), self.columns - 1)
        y = np.minimum((uv[1] * self.rows).round().astype(int), self.rows)
        np.maximum.at(result, (y, x), np.where(np.isfinite(value), value, 0))
        return result

    def _brightness(self, uv: mi.Point2f) -> mi.Float:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.wi = -self.directions.direction(uv)[0]
        si.wavelengths = comparison_wavelengths(dr.width(uv))
        value = brightness(self.directions.emitter.eval(si))
        counts = dr.isfinite(value)
        if self.sun is not None:
            counts &= ~self.sun.contains(-si.wi)
        return dr.select(counts, value, dr.zeros(mi.Float, dr.width(uv)))
