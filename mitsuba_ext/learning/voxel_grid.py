"""A uniform grid over the scene's bounding box, and which of its voxels hold geometry."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Index of the voxels that hold nothing.
EMPTY = 0xFFFFFFFF

#: Geometry that touches a voxel's face within this share of its size belongs to both neighbours:
#: the hit points of a wall in that plane are rounded to either side.
_MARGIN = 1e-3


class VoxelGrid:
    """Voxels of the scene's bounding box, numbered without gaps over those that hold geometry.

    Parameters:
        scene: Its shapes, and its point-like emitters, occupy the voxels.
        resolution: Voxels along each axis.

    Raises:
        ValueError: The scene has no bounding box.

    Attributes:
        occupied_count (int): Voxels that hold geometry.
        cells (mi.UInt32): Their linear indices in the full grid; shape ``occupied_count``.
    """

    def __init__(self, scene: mi.Scene, resolution: int) -> None:
        self.resolution = resolution
        bbox = scene.bbox()
        if not bbox.valid():
            raise ValueError("a scene without geometry has no voxels")
        extent = bbox.max - bbox.min
        # A flat scene still has voxels of some depth, and no point lies on the outer faces
        padding = mi.ScalarVector3f(1e-4 * dr.max(extent) or 1.0)
        self.origin = mi.Point3f(bbox.min - padding)
        self.size = mi.Vector3f((extent + 2 * padding) / resolution)
        self._scale = 1 / self.size
        dr.make_opaque(self.origin, self.size, self._scale)
        occupied = dr.zeros(mi.UInt32, resolution**3)
        for shape in scene.shapes():
            self._mark_shape(occupied, shape)
        for emitter in scene.emitters():
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
                self._mark_box(occupied, emitter.bbox())
        dr.eval(occupied)
        self.cells = dr.compress(occupied > 0)
        self.occupied_count = len(self.cells)
        self._index = dr.full(mi.UInt32, EMPTY, resolution**3)
        dr.scatter(self._index, dr.arange(mi.UInt32, self.occupied_count), self.cells)
        dr.eval(self._index)

    def index(self, p: mi.Point3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The number of the occupied voxel that holds ``p``, and whether there is one."""
        cell = mi.Vector3i(dr.floor(self._relative(p)))
        inside = active & dr.all((cell >= 0) & (cell < self.resolution))
        index = dr.gather(mi.UInt32, self._index, self._linear(cell), inside)
        return index, inside & (index != EMPTY)

    def point(self, index: mi.UInt32, sample: mi.Point3f) -> mi.Point3f:
        """The point of an occupied voxel at relative coordinates in [0, 1)³."""
        cell = dr.gather(mi.UInt32, self.cells, index)
        r = self.resolution
        corner = mi.Point3f(mi.Float(cell % r), mi.Float(cell // r % r), mi.Float(cell // (r * r)))
        return self.origin + (corner + sample) * self.size

    def _linear(self, cell: mi.Vector3i) -> mi.UInt32:
        r = self.resolution
        return mi.UInt32(cell.x + r * (cell.y + r * cell.z))

    def _mark_shape(self, occupied: mi.UInt32, shape: mi.Shape) -> None:
        if not shape.is_mesh():
            self._mark_box(occupied, shape.bbox())
            return
        if shape.face_count() == 0:
            return
        face = shape.face_indices(dr.arange(mi.UInt32, shape.face_count()))
        a, b, c = (self._relative(shape.vertex_position(face[i])) for i in range(3))
        normal = dr.cross(b - a, c - a)
        _mark_boxes(
            occupied, self.resolution, dr.minimum(a, dr.minimum(b, c)),
            dr.maximum(a, dr.maximum(b, c)), a, normal,
        )

    def _mark_box(self, occupied: mi.UInt32, bbox: mi.ScalarBoundingBox3f) -> None:
        if not bbox.valid():
            return
        low, high = (self._relative(mi.Point3f(p)) for p in (bbox.min, bbox.max))
        _mark_boxes(occupied, self.resolution, low, high, low, mi.Vector3f(0))

    def _relative(self, p: mi.Point3f) -> mi.Point3f:
        """In units of voxels from the grid's origin."""
        return (p - self.origin) * self._scale


@dr.syntax
def _mark_boxes(occupied, resolution: int, low, high, p, normal):
    """Marks the voxels between ``low`` and ``high`` that the plane through ``p`` crosses.

    For the bounding box of a triangle and the triangle's plane that is the triangle's voxelisation,
    up to voxels at its edges; a zero normal marks the whole box.
    """
    finite = dr.all(dr.isfinite(low) & dr.isfinite(high))
    first = mi.Vector3i(dr.floor(dr.select(finite, low, 0) - _MARGIN))
    last = mi.Vector3i(dr.floor(dr.select(finite, high, 0) + _MARGIN))
    outside = dr.any((last < 0) | (first >= resolution))
    first = dr.clip(first, 0, resolution - 1)
    last = dr.clip(last, 0, resolution - 1)
    # Largest distance of a voxel's plane-crossing centre, times the length of the normal
    reach = (0.5 + _MARGIN) * dr.sum(dr.abs(normal))

    cell = mi.Vector3i(first)
    active = finite & ~outside
    while active:
        distance = dr.abs(dr.dot(normal, mi.Point3f(cell) + 0.5 - p))
        linear = mi.UInt32(cell.x + resolution * (cell.y + resolution * cell.z))
        dr.scatter(occupied, mi.UInt32(1), linear, active & (distance <= reach))
        # The next voxel of the box, x fastest
        cell.x += 1
        wrap_x = cell.x > last.x
        cell.x = dr.select(wrap_x, first.x, cell.x)
        cell.y += dr.select(wrap_x, 1, 0)
        wrap_y = cell.y > last.y
        cell.y = dr.select(wrap_y, first.y, cell.y)
        cell.z += dr.select(wrap_y, 1, 0)
        active &= cell.z <= last.z
