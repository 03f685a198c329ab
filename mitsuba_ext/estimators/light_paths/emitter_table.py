"""The tables from which light paths choose where they start: triangles and whole shapes of area
lights, point-like lights, and lights at infinity.

Each piece is an affine image of a set that is simple to sample: a triangle, a disk, a sphere, a
cylinder. Points are sampled here and not by ``emitter.sample_position``, which returns
wrong normals for turned spheres and for meshes with interpolated normals, and does not say which
triangle it chose.
"""


from __future__ import annotations

import math
import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.lights.division import are_interpolated, emitter_shapes, shading_cosines, triangles
from ...scene.movers import refuse_moving_lights
from ...util.arrays import from_numpy
from ...util.discrete_sampling import alias_tables
from .emitter_choice import emitter_probabilities

# Kinds of pieces
TRIANGLE, DISK, SPHERE, CYLINDER, POINT, SPOT, PROJECTOR, INFINITE = range(8)

#: The directions in which light leaves a surface: cosine-distributed to the front, where the
#: shading normal points; to both sides (with interpolated normals, a mesh also emits to the back of
#: its triangles); or along the normal.
TO_FRONT, TO_BOTH_SIDES, AS_BEAM = range(3)

#: Words of a piece in its table.
WORDS = 16

#: Words of an emitter in the table.
_WORDS = 8

#: No paths start from lights with less area than this: the density of their points would overflow
#: a single-precision number.
_LEAST_AREA = 1e-37

#: Transforms of emitters may differ from rotations by this: of the squared lengths and dot products
#: of their axes.
_DISTORTION = 1e-3

#: Factor by which the image plane of a projector is made larger: the field of view is read from its
#: ``str()``, which has six digits.
_MARGIN = 1 + 1e-5


class LightPieces:
    """The pieces of a scene's lights, each with its probability. The triangles of an emitter have
    probabilities in proportion to their areas.

    Parameters:
        scene: A scene with at least one emitter.

    Attributes:
        probability (numpy.ndarray): Probability of choosing each emitter; shape [emitters].
        area (numpy.ndarray): The area of each emitter's surface; 1 for emitters without surface.
        way (numpy.ndarray): ``TO_FRONT``, ``TO_BOTH_SIDES`` or ``AS_BEAM`` for each emitter.
        kind (numpy.ndarray): The kind of each emitter's pieces.
        parameter (numpy.ndarray): For spots the cosine of the cutoff angle; for projectors the area
            of the image at distance 1; 0 for other emitters.
        axis (numpy.ndarray): The direction in which each spot and projector shines; [emitters, 3].
        has_opposite_normals (bool): Whether a light shines from the back of its triangles.

    Raises:
        NotImplementedError: Light paths cannot start from one of the emitters (a shape or emitter
            of an unsupported type, or a ``to_world`` that distorts directions), or a light moves.
    """

    def __init__(self, scene: mi.Scene) -> None:
        refuse_moving_lights(scene)
        emitters, shapes = scene.emitters(), emitter_shapes(scene)
        for emitter, shape in zip(emitters, shapes):
            if shape is None:
                _check_distortion(emitter)
        count = len(emitters)
        self.area, self.way = np.ones(count), np.full(count, TO_FRONT)
        self.kind, self.parameter = np.full(count, INFINITE), np.zeros(count)
        self.axis = np.zeros((count, 3))
        self.has_opposite_normals = False
        tables, measures, owners = [], [], []
        for index, (emitter, shape) in enumerate(zip(emitters, shapes)):
            if shape is not None:
                table, measure = self._surface(index, emitter, shape)
            elif mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
                table, measure = self._point(index, emitter), np.ones(1)
            else:
                table, measure = _row(INFINITE), np.ones(1)
            tables.append(table)
            owners.append(np.full(len(table), index))
            measures.append(measure / max(measure.sum(), 1e-300))
        self.probability = emitter_probabilities(scene, self.area > _LEAST_AREA)
        table, owner = np.concatenate(tables), np.concatenate(owners)
        words = table.astype(np.float32)
        integers = words.view(np.uint32)
        integers[:, 12], integers[:, 14] = table[:, 12], table[:, 14]
        integers[:, 13] = owner
        self._words = from_numpy(mi.Float, words)
        self.count = dr.opaque(mi.UInt32, len(table))
        relative = self.probability[owner] * np.concatenate(measures)
        if not relative.any():
            relative[:] = 1
        relative *= len(relative) / relative.sum()
        entry = dr.arange(mi.UInt32, len(relative))
        first, last = mi.UInt32(0), mi.UInt32(len(relative) - 1)
        threshold, alias = alias_tables(
            from_numpy(mi.Float64, relative), dr.zeros(mi.UInt32, len(relative)) + first,
            dr.zeros(mi.UInt32, len(relative)) + last, len(relative),
        )  # fmt: skip
        self._alias = dr.zeros(mi.Float, 2 * len(relative))
        dr.scatter(self._alias, threshold, 2 * entry)
        dr.scatter(self._alias, dr.reinterpret_array(mi.Float, alias), 2 * entry + 1)
        dr.eval(self._alias)

    def choose(self, sample: mi.Point2f, active: mi.Bool) -> Piece:
        """Chooses a piece."""
        entry = dr.minimum(mi.UInt32(sample.x * mi.Float(self.count)), self.count - 1)
        threshold, alias = dr.gather(mi.Vector2f, self._alias, entry, active)
        entry = dr.select(sample.y < threshold, entry, dr.reinterpret_array(mi.UInt32, alias))
        width = dr.width(entry)
        return Piece(dr.gather(mi.ArrayXf, self._words, entry, active, shape=(WORDS, width)))

    # ---- The table ----

    def _surface(self, index, emitter, shape) -> tuple[np.ndarray, np.ndarray]:
        """The pieces of an area light, and the area of each."""
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
            self.way[index] = AS_BEAM
        name = shape.class_name()
        if name in ("Disk", "Cylinder"):
            matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64)
            matrix = matrix.reshape(4, 4)
            x, y, z, origin = matrix[:3].T
            if name == "Disk":
                row, area = _row(DISK, origin, x, y), np.pi * np.linalg.norm(np.cross(x, y))
            else:
                row, area = _row(CYLINDER, origin, x, y, z), float(dr.slice(shape.surface_area()))
            area = np.array([area])
        elif name == "Sphere":
            box = shape.bbox()
            low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
            radius = 0.5 * (high - low).max()
            row = _row(SPHERE, 0.5 * (low + high), *(radius * np.eye(3)))
            area = np.array([4 * np.pi * radius**2])
        elif shape.is_mesh():  # Rectangles are meshes too
            row, area = self._mesh(index, shape)
        else:
            raise NotImplementedError(
                f'paths cannot start from the area light of a shape "{name}"; give the light to a '
                f"rectangle, disk, sphere, cylinder or mesh"
            )
        self.kind[index], self.area[index] = row[0, 12], area.sum()
        row[:, 15] = self.way[index]
        return row, area

    def _mesh(self, index, mesh) -> tuple[np.ndarray, np.ndarray]:
        a, b, c = triangles(mesh)
        row = np.concatenate([_row(TRIANGLE)] * max(1, len(a)))
        if len(a) == 0:
            return row, np.zeros(1)
        row[:, :3], row[:, 3:6], row[:, 6:9] = a, b - a, c - a
        row[:, 14] = np.arange(len(a))
        cosines = shading_cosines(mesh)
        if self.way[index] == TO_FRONT and are_interpolated(cosines):
            self.way[index] = TO_BOTH_SIDES
        self.has_opposite_normals |= bool((cosines < 0).any())
        return row, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    def _point(self, index, emitter) -> np.ndarray:
        name = emitter.class_name()
        parameters = mi.traverse(emitter)
        if name == "PointLight":
            self.kind[index] = POINT
            return _row(POINT, np.array(parameters["position"], dtype=np.float64).ravel())
        if name not in ("SpotLight", "Projector"):
            raise NotImplementedError(f'paths cannot start from an emitter "{name}"')
        matrix = np.array(emitter.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        x, y, z, origin = matrix[:3].T
        x, y, z = (v / np.linalg.norm(v) for v in (x, y, z))
        self.axis[index] = z
        if name == "SpotLight":
            angle = math.radians(float(dr.slice(parameters["cutoff_angle"])))
            self.kind[index], self.parameter[index] = SPOT, math.cos(angle)
            row = _row(SPOT, origin, x, y, z)
            row[:, 15] = math.cos(angle)
            return row
        angle = float(re.search(r"x_fov = ([^,\s]+)", str(emitter))[1])
        height, width = 1, 1
        if "irradiance.data" in parameters:
            height, width = parameters["irradiance.data"].shape[:2]
        half = _MARGIN * math.tan(math.radians(angle / 2)) * np.array([1, height / width])
        self.kind[index], self.parameter[index] = PROJECTOR, 4 * half.prod()
        row = _row(PROJECTOR, origin, half[0] * x, half[1] * y, z)
        row[:, 15] = 4 * half.prod()
        return row


class Piece:
    """A piece in each lane: its row of the table."""

    def __init__(self, words: mi.ArrayXf) -> None:
        self._words = words
        self.kind, self.emitter, self.prim_index = (
            dr.reinterpret_array(mi.UInt32, words[i]) for i in (12, 13, 14)
        )
        #: ``way`` of a surface, or ``parameter`` of an emitter without surface.
        self.parameter = words[15]

    def vector(self, column: int) -> mi.Vector3f:
        """The origin (0) or one of the axes."""
        return mi.Vector3f(*(self._words[3 * column + i] for i in range(3)))

    def point(self, x: mi.Float, y: mi.Float, z: mi.Float) -> mi.Vector3f:
        """The image of a point of the simple set: of the unit triangle, disk, sphere or
        cylinder."""
        return self.vector(0) + self.direction(x, y, z)

    def direction(self, x: mi.Float, y: mi.Float, z: mi.Float) -> mi.Vector3f:
        """The image of a vector."""
        return x * self.vector(1) + y * self.vector(2) + z * self.vector(3)


def _check_distortion(emitter: mi.Emitter) -> None:
    """
    Raises:
        NotImplementedError: The ``to_world`` of an emitter without surface distorts directions; or
            it scales the directions of an emitter at infinity, for which Mitsuba's values are then
            wrong.
    """
    name, scale = emitter.class_name(), 1.0
    matrix = np.array(emitter.world_transform().matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if name in ("PointLight", "ConstantBackgroundEmitter"):
        return
    if name == "DirectionalEmitter":
        matrix = matrix[:, 2:]
    square = matrix.T @ matrix
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
        scale = np.trace(square) / 3
    if np.abs(square - scale * np.eye(len(square))).max() > _DISTORTION * scale:
        raise NotImplementedError(
            f'paths cannot start from an emitter "{name}" whose to_world scales its axes by '
            f"{np.linalg.norm(matrix, axis=0).round(4).tolist()} or shears them; give it a "
            f"to_world that only turns, mirrors and moves"
        )


def _row(kind: int, *columns: np.ndarray) -> np.ndarray:
    """A row of the table: origin and axes, and the kind."""
    row = np.zeros((1, WORDS))
    for i, column in enumerate(columns):
        row[0, 3 * i : 3 * i + 3] = column
    row[0, 12] = kind
    return row


@dataclass
class EmitterRow:
    """The row of an emitter.

    Attributes:
        probability: Probability with which the emitter is chosen.
        density: Density of the position; see :class:`.EmittedRay`.
        kind, way, parameter, axis: See :class:`.LightPieces`.
        is_beam: Whether the emitter has only one direction.
    """

    probability: mi.Float
    density: mi.Float
    kind: mi.UInt32
    way: mi.Float
    is_beam: mi.Bool
    parameter: mi.Float
    axis: mi.Vector3f


class EmitterTable:
    """
    Parameters:
        pieces: The pieces of the emitters.
        density: For each emitter, the density of the position.
        is_delta_direction: Which emitters have only one direction.
        emitters: The emitters.
    """

    def __init__(
        self,
        pieces: LightPieces,
        density: np.ndarray,
        is_delta_direction: np.ndarray,
        emitters: mi.EmitterPtr,
    ) -> None:
        count = len(density)
        table = np.zeros((count, _WORDS), dtype=np.float32)
        table[:, 0], table[:, 1] = pieces.probability, density
        table[:, 2] = pieces.kind + 16 * pieces.way + 64 * is_delta_direction
        table[:, 3], table[:, 4:7] = pieces.parameter, pieces.axis
        self._words = from_numpy(mi.Float, table)
        ids = dr.reinterpret_array(mi.UInt32, emitters).numpy()
        index = np.zeros(ids.max() + 1, dtype=np.uint32)
        index[ids] = np.arange(count)
        self._index = from_numpy(mi.UInt32, index)

    def row(self, index: mi.UInt32, active: mi.Bool) -> EmitterRow:
        """The row of an emitter, by its number in ``scene.emitters()``."""
        words = dr.gather(mi.ArrayXf, self._words, index, active, shape=(_WORDS, dr.width(index)))
        mark = mi.UInt32(words[2])
        return EmitterRow(
            words[0], words[1], mark & 15, mi.Float((mark >> 4) & 3), (mark & 64) != 0, words[3],
            mi.Vector3f(words[4], words[5], words[6]),
        )  # fmt: skip

    def chance(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The probability with which an emitter is chosen."""
        return dr.gather(mi.Float, self._words, index * _WORDS, active)

    def index(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.UInt32:
        """The number of an emitter in ``scene.emitters()``."""
        id = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.UInt32, self._index, id, active & (id < len(self._index)))
