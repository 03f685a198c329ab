"""The numbering of voxels and of the sides of the surfaces in them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: The number of sides: the positive and the negative direction of each axis.
SIDES = 6


class VoxelSides:
    """Numbers the pairs of a voxel and a side as 6 · voxel + side.

    The side of a surface is the axis direction, positive or negative, that is nearest to its
    normal: 2 · axis, plus 1 where it is negative. The two faces of a wall that is thinner than a
    voxel have different sides, and so do the floor and the wall in a corner.

    Parameters:
        origin: The lower corner of the box that is divided into voxels.
        scale: Voxels per unit of length along each axis.
        resolution: Voxels along each axis: an integer that is compiled into the kernels, or an
            opaque ``mi.Int32`` if several resolutions share kernels.
    """

    def __init__(
        self, origin: mi.Point3f, scale: mi.Vector3f, resolution: int | mi.Int32
    ) -> None:
        self._origin, self._scale, self._resolution = origin, scale, resolution
        # Opaque so that other scenes and sensors share the kernels
        dr.make_opaque(self._origin, self._scale)

    def number(
        self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool]:
        """The number of the voxel and the side of points with normals, and whether the points are
        ``active`` and in the box; otherwise, the number has no meaning."""
        voxel, inside = voxel_at((p - self._origin) * self._scale, self._resolution, active)
        return mi.UInt32(voxel) * SIDES + _side(n), inside


def voxel_at(
    p: mi.Point3f, resolution: int | mi.Int32, active: mi.Bool
) -> tuple[mi.Int32, mi.Bool]:
    """The number of the voxel that holds ``p``, a point in units of voxels, and whether the point
    is ``active`` and there is such a voxel."""
    cell = mi.Vector3i(dr.floor(p))
    inside = active & dr.all((cell >= 0) & (cell < resolution))
    return voxel_number(cell.x, cell.y, cell.z, resolution), inside


def voxel_number(x: Any, y: Any, z: Any, resolution: Any) -> Any:
    """The number of the voxel at integer coordinates in a grid of resolution³: x changes fastest.
    Arguments are integers, or arrays of NumPy or Dr.Jit."""
    return x + resolution * (y + resolution * z)


def voxel_coordinates(number: Any, resolution: Any) -> tuple[Any, Any, Any]:
    """The inverse of :func:`voxel_number`."""
    return number % resolution, number // resolution % resolution, number // resolution**2


def sides(normals: np.ndarray) -> np.ndarray:
    """The side of each normal [n, 3], as :class:`VoxelSides` numbers them; shape [n]."""
    axis = np.abs(normals).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)


def _side(n: mi.Normal3f) -> mi.UInt32:
    a = dr.abs(n)
    x_longest = (a.x >= a.y) & (a.x >= a.z)
    y_longest = a.y >= a.z
    axis = dr.select(x_longest, mi.UInt32(0), dr.select(y_longest, mi.UInt32(1), mi.UInt32(2)))
    component = dr.select(x_longest, n.x, dr.select(y_longest, n.y, n.z))
    return 2 * axis + dr.select(component < 0, mi.UInt32(1), 0)
