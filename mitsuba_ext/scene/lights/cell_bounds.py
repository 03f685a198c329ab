"""What light cells look like from afar, for light trees."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.spectra import comparison_wavelengths
from ..bounds import scene_bounds
from ..movers import is_moving_light
from .division import emitter_shapes, triangles
from .light_cells import LightCells
from .tree_construction import Lights

#: Rounding errors, relative to the largest coordinate of the scene.
_ROUNDING = 4e-6

#: The distance of a directional light, and the radius of an environment, in radii of the scene.
_FAR, _AROUND = 1e3, 10.0

#: What a tree estimates for an environment of this radius and of strength 1, times the squared
#: radius: the means of both cosines are what one estimates inside of a cluster.
_INSIDE = 0.3

#: The part of the light of an environment for which connections are wanted: walls see half of it,
#: and scattered rays find half of that. (Unlike small lights, they hit it wherever it is visible.)
_SEEN = 0.25


def cell_bounds(scene: mi.Scene, cells: LightCells, power: np.ndarray) -> tuple[Lights, np.ndarray]:
    """What the cells of a scene look like from afar. Directional lights are points far away,
    and an environment is a sphere around the scene.

    Parameters:
        power: The power of each cell, in any unit; positive. For lights at infinity, the power that
            enters the bounding sphere of the scene.

    Returns:
        The lights, in the order of the cells, and which of them are at infinity.
    """
    box = scene_bounds(scene)
    has_extent = box.valid()
    sphere = box.bounding_sphere() if has_extent else mi.ScalarBoundingSphere3f(0.0, 1.0)
    bounds = _CellBounds(cells.count, np.array(sphere.center), float(sphere.radius) or 1.0, power)
    shapes, emitters = emitter_shapes(scene), scene.emitters()
    is_part = np.bincount(cells.emitter_index, minlength=len(emitters))[cells.emitter_index] > 1
    meshes = [i for i, s in enumerate(shapes) if s is not None and _is_flat(emitters[i], s)]
    if cells.has_face_cells:
        is_part &= np.isin(cells.emitter_index, meshes, invert=True)
    meshes = np.setdiff1d(meshes, cells.emitter_index[is_part]).astype(int)
    bounds.faces(
        [shapes[i] for i in meshes], [cells.faces(i, shapes[i].face_count()) for i in meshes]
    )
    if is_part.any():
        bounds.parts(cells, shapes, np.flatnonzero(is_part))
    others = np.isin(cells.emitter_index, meshes, invert=True) & ~is_part
    for cell in np.flatnonzero(others):
        i = cells.emitter_index[cell]
        bounds.emitter(cell, emitters[i], shapes[i])
    extent = float(np.abs([box.min, box.max]).max()) if has_extent else 1.0
    return bounds.lights(_ROUNDING * extent), bounds.is_infinite


def _is_flat(emitter: mi.Emitter, shape: mi.Shape) -> bool:
    """Whether the light consists of triangles whose front sides are diffuse lights."""
    return _is_diffuse(emitter) and shape.is_mesh() and shape.face_count() > 0


def _is_diffuse(emitter: mi.Emitter) -> bool:
    """Whether the light of a surface leaves its front side evenly: ``area`` and
    ``solid_angle_area``."""
    return emitter.class_name() == "AreaLight" or type(emitter).__name__ == "SolidAngleArea"


def _vector(v: mi.Vector3f) -> np.ndarray:
    return np.array(v, dtype=np.float64).ravel()


def _axis(emitter: mi.Emitter) -> np.ndarray:
    """The direction in which an emitter shines: the z axis of its own space."""
    axis = _vector(emitter.world_transform() @ mi.Vector3f(0, 0, 1))
    return axis / max(np.linalg.norm(axis), 1e-300)


#: The number of points of a part of a light; and the steps of a sequence of points (R. Roberts,
#: *The Unreasonable Effectiveness of Quasirandom Sequences*, 2018).
_POINTS, _GOLDEN = 16, np.array([0.7548776662466927, 0.5698402909980532])


class _CellBounds:
    """Collects what cells look like. By default, a cell lies somewhere in the scene and shines in
    all directions."""

    def __init__(self, count: int, center: np.ndarray, radius: float, power: np.ndarray) -> None:
        self._scene_center, self._scene_radius = center.ravel(), radius
        self.center = np.tile(self._scene_center, (count, 1))
        self.spread, self.reach = np.full(count, 0.7 * radius), np.full(count, radius)
        self.axis, self.angle = np.zeros((count, 3)), np.full(count, np.pi)
        self.strength = np.array(power, dtype=np.float64)
        self.is_infinite = np.zeros(count, bool)

    def emitter(self, cell: int, emitter: mi.Emitter, shape: mi.Shape | None) -> None:
        """A whole emitter that is no mesh."""
        flags = emitter.flags()
        is_beam = mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        if mi.has_flag(flags, mi.EmitterFlags.Infinite):
            self._infinite(cell, _axis(emitter) if is_beam else None)
        elif is_moving_light(emitter):
            self._box(cell, emitter.bbox())
        elif mi.has_flag(flags, mi.EmitterFlags.DeltaPosition):
            self.center[cell] = _vector(emitter.world_transform() @ mi.Point3f(0))
            if emitter.bbox().valid():
                self.center[cell] = _vector(emitter.bbox().center())
            self.spread[cell] = self.reach[cell] = 0
            if emitter.class_name() == "SpotLight":
                self._spot(cell, emitter)
        elif shape is not None:
            self._shape(cell, emitter, shape)
        elif emitter.bbox().valid():
            self._box(cell, emitter.bbox())

    def _infinite(self, cell: int, direction: np.ndarray | None) -> None:
        self.is_infinite[cell] = True
        radius = self._scene_radius
        area = np.pi * radius**2
        if direction is None:
            # Irradiance of a surface in uniform light
            irradiance = self.strength[cell] / (4 * area)
            distance = self.spread[cell] = self.reach[cell] = _AROUND * radius
            self.strength[cell] = _SEEN * irradiance * distance**2 / _INSIDE
            return
        distance = _FAR * radius
        self.center[cell] = self._scene_center - distance * direction
        self.spread[cell] = self.reach[cell] = radius
        self.axis[cell], self.angle[cell] = direction, 0.0
        self.strength[cell] *= distance**2 / area

    def _spot(self, cell: int, emitter: mi.Emitter) -> None:
        values = mi.traverse(emitter)
        cutoff, beam = (
            np.radians(float(dr.slice(values[key]))) for key in ("cutoff_angle", "beam_width")
        )
        self.axis[cell], self.angle[cell] = _axis(emitter), min(cutoff, np.pi)
        # All light leaves in a cone
        self.strength[cell] /= 2 * max(1 - np.cos(0.5 * (beam + cutoff)), 1e-6)

    def _shape(self, cell: int, emitter: mi.Emitter, shape: mi.Shape) -> None:
        self._box(cell, shape.bbox())
        kind = shape.class_name()
        if kind == "Sphere":
            radius = self.reach[cell] / np.sqrt(3)
            self.spread[cell], self.reach[cell] = radius / np.sqrt(2), radius
        if kind == "Disk" and _is_diffuse(emitter):
            ps = shape.sample_position(0.0, mi.Point2f(0.5))
            self.axis[cell], self.angle[cell] = _vector(ps.n), 0.5 * np.pi

    def _box(self, cell: int, box: mi.ScalarBoundingBox3f) -> None:
        low, high = _vector(box.min), _vector(box.max)
        self.center[cell] = 0.5 * (low + high)
        self.reach[cell] = 0.5 * np.linalg.norm(high - low)
        # A uniform distribution
        self.spread[cell] = self.reach[cell] / np.sqrt(3)

    def faces(self, meshes: list[mi.Shape], cells: list[np.ndarray]) -> None:
        """Cells that consist of triangles. ``cells``: the cell of each face of each mesh."""
        if not meshes:
            return
        a, b, c = (np.concatenate(x) for x in zip(*map(triangles, meshes)))
        cell = np.concatenate(cells)
        cross = np.cross(b - a, c - a)
        area = np.linalg.norm(cross, axis=1)
        middle = (a + b + c) / 3
        corners = np.stack([a, b, c])
        count = len(self.strength)

        def mean(values: np.ndarray) -> np.ndarray:
            sums = [np.bincount(cell, area * x, count) for x in np.atleast_2d(values.T)]
            return (np.array(sums) / np.maximum(total, 1e-300)).T

        total = np.bincount(cell, area, count)
        mine = total > 0
        self.center[mine] = mean(middle)[mine]
        from_center = np.linalg.norm(corners - self.center[cell], axis=2)
        # Second moments of a triangle about its centre, and of its centre about the cell's
        within = ((corners - middle) ** 2).sum(axis=(0, 2)) / 12
        square = ((middle - self.center[cell]) ** 2).sum(axis=1) + within
        self.spread[mine] = np.sqrt(mean(square)[:, 0])[mine]
        self.reach[mine] = 0
        np.maximum.at(self.reach, cell, from_center.max(axis=0))

        # Light leaves on the side of the shading normals
        normals = np.concatenate([_normals(mesh) for mesh in meshes], axis=1)
        self.axis[mine] = mean(normals.mean(axis=0))[mine]
        length = np.linalg.norm(self.axis, axis=1)
        axis = self.axis / np.maximum(length, 1e-300)[:, None]
        has_area = area > 0
        cosine = (normals * axis[cell]).sum(axis=2).min(axis=0)[has_area]
        angle = np.zeros(count)
        np.maximum.at(angle, cell[has_area], np.arccos(np.clip(cosine, -1, 1)) + 0.5 * np.pi)
        self.angle[mine] = np.where(length > 1e-3, np.minimum(angle, np.pi), np.pi)[mine]

    def parts(
        self, cells: LightCells, shapes: list[mi.Shape | None], index: np.ndarray
    ) -> None:
        """Parts of lights, and the bins of an environment: means over points of each of them.
        ``index``: their cells."""
        lane = np.arange(len(index) * _POINTS)
        numbers = ((0.5 + lane[None] * _GOLDEN[:, None]) % 1).astype(np.float32)
        ref = dr.zeros(mi.SurfaceInteraction3f, len(lane))
        ref.p = mi.Point3f(self._scene_center)
        ref.wavelengths = comparison_wavelengths(len(lane))
        cell = from_numpy(mi.UInt32, np.repeat(index, _POINTS))
        numbers = mi.Point2f(*(from_numpy(mi.Float, x) for x in numbers))
        ds, _weight = cells.sample(cell, ref, numbers, mi.Bool(True))
        p, n, d = (mi.Vector3f(x) + dr.zeros(mi.Vector3f, len(lane)) for x in (ds.p, ds.n, ds.d))
        dr.eval(p, n, d)
        p, n, d = (
            x.numpy().T.reshape(len(index), _POINTS, 3).astype(np.float64) for x in (p, n, d)
        )
        is_bin = index >= cells.first_bin
        self._bins(cells, index[is_bin], d[is_bin])
        index, p, n = index[~is_bin], p[~is_bin], n[~is_bin]
        self.center[index] = center = p.mean(axis=1)
        self.spread[index] = np.sqrt(((p - center[:, None]) ** 2).sum(axis=2).mean(axis=1))
        self.axis[index] = n.mean(axis=1)
        for place, i in enumerate(index):
            shape = shapes[cells.emitter_index[i]]
            low, high = _vector(shape.bbox().min), _vector(shape.bbox().max)
            # No point of the whole light is farther away
            farthest = np.maximum(high - center[place], center[place] - low)
            self.reach[i] = np.linalg.norm(farthest)
            if shape.class_name() in ("Rectangle", "Disk"):
                self.angle[i] = 0.5 * np.pi

    def _bins(self, cells: LightCells, index: np.ndarray, d: np.ndarray) -> None:
        """Bins of an environment. ``d``: directions in each of them; shape [bins, points, 3]."""
        self.is_infinite[index] = True
        distance, area = _FAR * self._scene_radius, np.pi * self._scene_radius**2
        mean = d.mean(axis=1)
        self.center[index] = self._scene_center + distance * mean
        square = ((d - mean[:, None]) ** 2).sum(axis=2).mean(axis=1)
        self.spread[index] = distance * np.sqrt(square) + self._scene_radius
        if len(index):
            self.reach[index] = distance * cells.bins.diameter + self._scene_radius
        # The cosine at a light without an axis is estimated as 1/4
        self.strength[index] *= 4 * _SEEN * distance**2 / area

    def lights(self, rounding: float) -> Lights:
        """The lights. ``rounding``: the error of coordinates."""
        finite = ~self.is_infinite
        self.reach[finite] += rounding
        self.spread[finite] += rounding
        strength = self.strength / max(self.strength.max(initial=0), 1e-300)
        return Lights(
            self.center, self.spread, self.reach, self.axis, self.angle,
            np.maximum(strength, 1e-30),
        )  # fmt: skip


def _normals(mesh: mi.Mesh) -> np.ndarray:
    """The unit normals at the three corners of each face; shape [3, faces, 3]."""
    face = np.array(mesh.faces_buffer()).reshape(-1, 3)
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        normals = np.array(mesh.vertex_normals_buffer(), dtype=np.float64).reshape(-1, 3)
        normals = np.stack([normals[face[:, k]] for k in range(3)])
    else:
        a, b, c = triangles(mesh)
        normals = np.stack([np.cross(b - a, c - a)] * 3)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return normals / np.maximum(length, 1e-300)
