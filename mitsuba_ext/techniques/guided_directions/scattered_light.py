"""The radiance that media scatter, in the voxels of a box.

It has two parts. What lamps send to a voxel is computed: paths rarely come near a lamp, where fog
is brightest, and at the edge of a beam the radiance changes within a short distance. The rest
varies slowly, and pilots learn it in regions.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.regions.surface_voxels import voxel_at, voxel_coordinates
from ...transport.numbers import HashedNumbers
from ...transport.path_decisions import SceneQuery
from ...transport.transmittance import transmittance
from ...util.arrays import channel_mean

#: The number of voxels along each axis.
RESOLUTION = 64

#: The number of points of each voxel after each pilot at which direct light is computed.
_POINTS = 4

_VOXELS = RESOLUTION**3


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

    def voxel(self, p: mi.Point3f) -> tuple[mi.UInt32, mi.Bool]:
        """The voxel of a point, and whether there is one."""
        voxel, inside = voxel_at((p - self._origin) / self._edges, RESOLUTION, mi.Bool(True))
        return mi.UInt32(voxel), inside


class ScatteredLight:
    """A table of the radiance that an isotropic medium without absorption would scatter.

    Parameters (and attributes):
        box: The voxels.
        values: The radiance in each voxel. [voxels]
        outside: The radiance outside of the box. [1]
    """

    def __init__(self, box: Box, values: mi.Float, outside: mi.Float) -> None:
        self.box, self.values, self.outside = box, values, outside
        dr.make_opaque(self.values, self.outside)

    @classmethod
    def unknown(cls, box: Box) -> ScatteredLight:
        """No light anywhere."""
        return cls(box, dr.zeros(mi.Float, _VOXELS), mi.Float(0))

    def at(self, p: mi.Point3f) -> mi.Float:
        """The radiance at a point."""
        voxel, inside = self.box.voxel(p)
        return dr.select(inside, dr.gather(mi.Float, self.values, voxel, inside), self.outside)


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

