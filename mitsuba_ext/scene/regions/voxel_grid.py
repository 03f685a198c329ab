"""A uniform grid over the scene's bounding box, with the voxels that hold geometry."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bounds import scene_bounds
from .surface_voxels import voxel_at, voxel_coordinates, voxel_number

#: The index of an empty voxel.
EMPTY = 0xFFFFFFFF

#: The distance to a voxel's face, as a fraction of the voxel's size, within which geometry belongs
#: to both neighbours: the hit points of a wall in that plane are rounded to either side.
_MARGIN = 1e-3


class VoxelGrid:
    """Voxels of the scene's bounding box, numbered without gaps over those that hold geometry.

    Parameters:
        scene: The scene whose shapes and point-like emitters occupy the voxels.
        resolution: Voxels along each axis.

    Raises:
        ValueError: The scene has no bounding box.

    Attributes:
        occupied_count (int): The number of voxels that hold geometry.
        occupied (mi.UInt32): Their indices in the full grid; shape [occupied_count].
    """

    def __init__(self, scene: mi.Scene, resolution: int) -> None:
        self.resolution = resolution
        bbox = scene_bounds(scene)
        if not bbox.valid():
            raise ValueError("a scene without geometry has no voxels")
        extent = bbox.max - bbox.min
        # Gives a flat scene's voxels some depth, and keeps points off the grid's outer faces
        padding = mi.ScalarVector3f(1e-4 * dr.max(extent) or 1.0)
        self.origin = mi.Point3f(bbox.min - padding)
        self.size = mi.Vector3f((extent + 2 * padding) / resolution)
        self._scale = 1 / self.size
        dr.make_opaque(self.origin, self.size, self._scale)
        is_occupied = dr.zeros(mi.UInt32, resolution**3)
        boxes = [
            e.bbox() for e in scene.emitters()
            if mi.has_flag(e.flags(), mi.EmitterFlags.DeltaPosition)
        ]
        for shape in scene.shapes():
            if shape.is_mesh():
                self._mark_mesh(is_occupied, shape)
            else:
                boxes.append(shape.bbox())
        self._mark_boxes(is_occupied, [box for box in boxes if box.valid()])
        dr.eval(is_occupied)
        self.occupied = dr.compress(is_occupied > 0)
        self.occupied_count = len(self.occupied)
        self._index = dr.full(mi.UInt32, EMPTY, resolution**3)
        dr.scatter(self._index, dr.arange(mi.UInt32, self.occupied_count), self.occupied)
        dr.eval(self._index)

    def index(self, p: mi.Point3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The index of the occupied voxel that holds ``p``, and whether there is one."""
        voxel, inside = voxel_at(self._relative(p), self.resolution, active)
        index = dr.gather(mi.UInt32, self._index, mi.UInt32(voxel), inside)
        return index, inside & (index != EMPTY)

    def point(self, index: mi.UInt32, sample: mi.Point3f) -> mi.Point3f:
        """The point of an occupied voxel at relative coordinates in [0, 1)³."""
        voxel = dr.gather(mi.UInt32, self.occupied, index)
        corner = mi.Point3f(*map(mi.Float, voxel_coordinates(voxel, self.resolution)))
        return self.origin + (corner + sample) * self.size

    def _mark_mesh(self, is_occupied: mi.UInt32, mesh: mi.Mesh) -> None:
        if mesh.face_count() == 0:
            return
        face = mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))
        a, b, c = (self._relative(mesh.vertex_position(face[i])) for i in range(3))
        first, last, inside = self._cells(
            dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))
        )
        normal = dr.cross(b - a, c - a)
        _mark(is_occupied, dr.opaque(mi.Int32, self.resolution), first, last, a, normal, inside)

    def _mark_boxes(self, is_occupied: mi.UInt32, boxes: list[mi.ScalarBoundingBox3f]) -> None:
        """Shapes that are not meshes occupy their bounding boxes. One launch handles all boxes, a
        lane for each layer of each box: corners are data, not literals of a kernel."""
        if not boxes:
            return
        low, high = (
            mi.Point3f(np.array([getattr(box, corner) for box in boxes], dtype=np.float32).T)
            for corner in ("min", "max")
        )
        resolution = dr.opaque(mi.Int32, self.resolution)
        lane = dr.arange(mi.Int32, len(boxes) * self.resolution)
        box = mi.UInt32(lane // resolution)
        layer = lane % resolution
        first, last, inside = self._cells(
            self._relative(dr.gather(mi.Point3f, low, box)),
            self._relative(dr.gather(mi.Point3f, high, box)),
        )
        inside &= (first.z <= layer) & (layer <= last.z)
        first.z, last.z = mi.Int32(layer), mi.Int32(layer)
        _mark(is_occupied, resolution, first, last, mi.Point3f(0), mi.Vector3f(0), inside)

    def _cells(
        self, low: mi.Point3f, high: mi.Point3f
    ) -> tuple[mi.Vector3i, mi.Vector3i, mi.Bool]:
        """The first and the last voxel of a box in units of voxels, and whether it lies in the
        grid (a box with NaN or infinite corners does not)."""
        finite = dr.all(dr.isfinite(low) & dr.isfinite(high))
        top = dr.opaque(mi.Int32, self.resolution) - 1
        first = mi.Vector3i(dr.floor(dr.select(finite, low, 0) - _MARGIN))
        last = mi.Vector3i(dr.floor(dr.select(finite, high, 0) + _MARGIN))
        inside = finite & dr.all((last >= 0) & (first <= top))
        return dr.clip(first, 0, top), dr.clip(last, 0, top), inside

    def _relative(self, p: mi.Point3f) -> mi.Point3f:
        """A point in units of voxels from the grid's origin."""
        return (p - self.origin) * self._scale


@dr.syntax
def _mark(is_occupied, resolution, first, last, p, normal, active):
    """Marks the voxels from ``first`` to ``last`` that the plane through ``p`` crosses.

    With the voxels around a triangle and the triangle's plane, this voxelises the triangle, except
    for voxels at its edges; a zero normal marks the whole box.
    """
    # The largest distance of a voxel's centre from a plane that crosses it, times |normal|
    reach = (0.5 + _MARGIN) * dr.sum(dr.abs(normal))
    cell = mi.Vector3i(first)
    while active:
        distance = dr.abs(dr.dot(normal, mi.Point3f(cell) + 0.5 - p))
        voxel = mi.UInt32(voxel_number(cell.x, cell.y, cell.z, resolution))
        dr.scatter(is_occupied, mi.UInt32(1), voxel, active & (distance <= reach))
        # The next voxel of the box, x fastest
        cell.x += 1
        wrap_x = cell.x > last.x
        cell.x = dr.select(wrap_x, first.x, cell.x)
        cell.y += dr.select(wrap_x, 1, 0)
        wrap_y = cell.y > last.y
        cell.y = dr.select(wrap_y, first.y, cell.y)
        cell.z += dr.select(wrap_y, 1, 0)
        active &= cell.z <= last.z
