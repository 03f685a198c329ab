"""The radiance that media scatter, in the voxels of a box.

It has two parts. What lamps send to a voxel is computed: paths rarely come near a lamp, where fog
is brightest, and at the edge of a beam the radiance changes within a short distance. The rest
varies slowly, and pilots learn it in regions.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.regions.surface_voxels import voxel_coordinates
from ...transport.numbers import HashedNumbers
from ...transport.path_decisions import SceneQuery
from ...transport.transmittance import transmittance
from ...util.arrays import channel_mean, from_numpy

#: The number of voxels along each axis.
RESOLUTION = 64

#: The number of points of each voxel after each pilot at which direct light is computed.
_POINTS = 2

_VOXELS, _LEVELS = RESOLUTION**3, RESOLUTION.bit_length() - 1


class Box:
    """A box that is divided into voxels.

    Parameters:
        origin, size: Its lower corner, and its edges.
    """

    def __init__(self, origin: np.ndarray, size: np.ndarray) -> None:
        self.origin, self.size = np.asarray(origin), np.asarray(size)
        self._origin, self._edges = mi.Point3f(self.origin), mi.Vector3f(self.size / RESOLUTION)
        dr.make_opaque(self._origin, self._edges)

    def point(self, voxel: mi.UInt32, sample: mi.Point3f) -> mi.Point3f:
        """The point of a voxel at relative coordinates in [0, 1)³."""
        corner = mi.Point3f(*map(mi.Float, voxel_coordinates(voxel, RESOLUTION)))
        return self._origin + (corner + sample) * self._edges

    def in_voxels(self, p: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Point3f, mi.Vector3f]:
        """A point and a vector in units of voxels, from the lower corner."""
        return mi.Point3f((p - self._origin) / self._edges), d / self._edges


class ScatteredLight:
    """The radiance that an isotropic medium without absorption would scatter: a table of voxels,
    and of cubes of 2, 4, 8, … voxels along each edge. A cube has the root mean square of its
    voxels and (a quarter along each axis) of those around it, which is best for a ray that crosses
    it at an unknown place.

    Parameters (and attributes):
        box: The voxels.
        values: The radiance in each voxel. [voxels]
        outside: The radiance outside of the box. [1]
    """

    def __init__(self, box: Box, values: mi.Float, outside: mi.Float) -> None:
        self.box, self.values, self.outside = box, values, outside
        self._cubes = from_numpy(mi.Float, _cubes(values.numpy()))
        dr.make_opaque(self.values, self.outside)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.box, self._cubes, self.outside

    @classmethod
    def unknown(cls, box: Box) -> ScatteredLight:
        """No light anywhere."""
        return cls(box, dr.zeros(mi.Float, _VOXELS), mi.Float(0))

    def around(self, p: mi.Point3f, size: mi.Float) -> mi.Float:
        """The radiance in the cube around a point whose edge is between a half of ``size`` and
        ``size``, or in a voxel. The units are voxels (:meth:`Box.in_voxels`)."""
        # The exponent of a number of single precision
        level = mi.Int32(dr.reinterpret_array(mi.UInt32, mi.Float32(size)) >> 23) - 127
        level = dr.clip(level, 0, _LEVELS)
        count = RESOLUTION >> mi.UInt32(level)
        x, y, z = (
            mi.UInt32(mi.Int32(dr.floor(x))) for x in p * (mi.Float(count) / RESOLUTION)
        )
        # As unsigned numbers, negative ones are large
        inside = (x < count) & (y < count) & (z < count)
        index = x + count * (y + count * (z + count))
        return dr.select(inside, dr.gather(mi.Float, self._cubes, index, inside), self.outside)


def _cubes(values: np.ndarray) -> np.ndarray:
    """The table of all cubes: a grid of n³ cubes begins at n³."""
    cubes, size = np.zeros(2 * _VOXELS, np.float32), RESOLUTION
    cubes[_VOXELS:] = values
    square = np.square(values, dtype=np.float64).reshape([size] * 3)
    while size > 1:
        size //= 2
        # A part of a ray whose middle is in a cube may end beside it
        wide = _halved(_halved(_halved(square, 0), 1), 2)
        cubes[size**3 : 2 * size**3] = np.sqrt(wide).ravel()
        square = square.reshape(size, 2, size, 2, size, 2).mean(axis=(1, 3, 5))
    return cubes


def _halved(x: np.ndarray, axis: int) -> np.ndarray:
    """Means of pairs along an axis, to which the neighbours of a pair contribute a quarter."""
    padded = np.pad(np.moveaxis(x, axis, 0), ((1, 1), (0, 0), (0, 0)), "edge")
    before, first, second, after = (padded[i : i + x.shape[axis] : 2] for i in range(4))
    return np.moveaxis((before + 3 * first + 3 * second + after) / 8, 0, axis)


class DirectLight:
    """Estimates what lamps send to each voxel, unscattered.

    Parameters:
        box: The voxels.

    Attributes:
        points (int): The number of points in each voxel.
    """

    def __init__(self, box: Box) -> None:
        self._box, self.points = box, 0
        self._total = dr.zeros(mi.Float, _VOXELS)
        dr.make_opaque(self._total)

    @property
    def mean(self) -> mi.Float:
        """The means over the points, divided by 4π. [voxels]"""
        return self._total / dr.opaque(mi.Float, max(self.points, 1))

    def add(
        self,
        scene: mi.Scene,
        query: SceneQuery,
        medium: mi.MediumPtr,
        has_grids: bool,
        time: float,
    ) -> None:
        """Adds some points of each voxel.

        Parameters:
            query: How rays intersect the scene.
            medium: The medium of each voxel; null where it is unknown, and the voxel stays dark.
            has_grids: Whether there may be media that are not homogeneous.
            time: The time at which things that move are where light meets them.
        """
        for _ in range(_POINTS):
            self._add_point(scene, query, medium, has_grids, time)

    def _add_point(self, scene, query, medium, has_grids, time) -> None:
        voxel = dr.arange(mi.UInt32, _VOXELS)
        first = dr.opaque(mi.UInt32, self.points * _VOXELS)
        numbers = HashedNumbers(voxel + first, dr.zeros(mi.UInt32, _VOXELS))
        u, v = numbers.next_2d(), numbers.next_2d()
        si = dr.zeros(mi.SurfaceInteraction3f, _VOXELS)
        si.p = self._box.point(voxel, mi.Point3f(u.x, u.y, v.x))
        si.t, si.time = mi.Float(0), dr.opaque(mi.Float, time)
        if mi.is_spectral:
            si.wavelengths, _ = mi.sample_rgb_spectrum(mi.sample_shifted(v.y))
        active = medium != None  # noqa: E711
        ds, radiance = scene.sample_emitter_direction(si, numbers.next_2d(), False, active)
        active &= ds.pdf > 0
        T, _, _ = transmittance(
            query, scene, si, ds, medium, mi.UInt32(0), has_grids, True, False, numbers, active
        )
        found = channel_mean(mi.unpolarized_spectrum(radiance) * mi.unpolarized_spectrum(T))
        self._total += dr.select(active & dr.isfinite(found), found * dr.inv_four_pi, 0)
        self.points += 1
        dr.eval(self._total)

