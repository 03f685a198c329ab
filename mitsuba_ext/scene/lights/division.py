"""Divides emitters into cells: parts of the surface that are rectangles of the unit square.

``emitter.sample_direction`` maps a point of [0, 1)² to a point on the light. For rectangles, disks,
cylinders and meshes, the map does not depend on the point that is lit. A part of the square is then
a part of the surface, and Mitsuba's own sampling, given points of that part, samples it. All other
emitters stay whole: spheres, which are sampled by the solid angle of their cone; textured lights
whose radiance varies strongly within the cells; and emitters that rays cannot hit.

Mitsuba samples a cylinder uniformly only if its cross-section is a circle, and warns otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.spectra import brightness, comparison_wavelengths
from ..lightweight_shapes import surface
from ..regions.surface_voxels import SIDES, sides, voxel_number

#: The maximum number of cells of one emitter.
_MAX_CELLS = 64

#: The approximate number of cells in a scene with fewer emitters than this.
_CELL_BUDGET = 1024

#: The fraction of a voxel by which an edge must exceed a whole number to be cut once more.
_TOLERANCE = 0.25

#: The maximum second moment of sampling the cells of a textured light by area, relative to sampling
#: its texture, for which the light is divided; and the number of points along each edge of a cell
#: at which it is measured.
_MAX_UNEVENNESS, _TEXTURE_SAMPLES = 1.5, 16

#: The maximum number of cuts along each side of a triangle.
_MAX_CUTS = 8

#: Meshes of fewer faces are not divided into faces.
_LEAST_FACES = 8

#: The number of boxes, along the longest edge, in which the faces of a mesh become one cell if it
#: has too many.
_FACE_BOXES = 1024


@dataclass
class Division:
    """The cells of one emitter.

    Attributes:
        pieces: x, y, width and height of rectangles of the unit square; shape [pieces, 4]. Pieces
            of one cell are adjacent.
        cell_sizes: The number of pieces of each cell; shape [cells].
        shape: ``""`` (whole), ``"rectangle"``, ``"disk"``, ``"cylinder"`` or ``"mesh"``.
        grid: The numbers of columns and rows of cells of a shape that is not a mesh.
        normals: Geometric normal of each piece of a mesh; shape [pieces, 3].
        face_first: First piece of each face in the order (face, row, column); shape [faces + 1].
        face_pieces: The indices of these pieces in ``pieces``.
        is_smooth: Whether the interpolated normals of the mesh differ from its face normals.
        is_textured: Whether the radiance varies. Points are then sampled on the shape, because the
            emitter would sample its texture.
    """

    pieces: np.ndarray
    cell_sizes: np.ndarray
    shape: str = ""
    grid: tuple[int, int] = (1, 1)
    normals: np.ndarray | None = None
    face_first: np.ndarray | None = None
    face_pieces: np.ndarray | None = None
    is_smooth: bool = False
    is_textured: bool = False

    @property
    def cell_of_piece(self) -> np.ndarray:
        """The cell of each piece in the order of ``face_first``; shape [pieces]."""
        return np.repeat(np.arange(len(self.cell_sizes)), self.cell_sizes)[self.face_pieces]


#: Shapes whose cells are a grid in the unit square.
_GRIDS = {"Rectangle": "rectangle", "Disk": "disk", "Cylinder": "cylinder"}

_WHOLE = np.array([[0.0, 0.0, 1.0, 1.0]])


def emitter_shapes(scene: mi.Scene) -> list[mi.Shape | None]:
    """The shape of each emitter (``emitter.get_shape()`` hides that it is a mesh)."""
    shapes = {shape.emitter().ptr: surface(shape) for shape in scene.shapes() if shape.is_emitter()}
    return [shapes.get(emitter.ptr) for emitter in scene.emitters()]


def divide(
    scene: mi.Scene, voxel: np.ndarray | None, face_cells: int = 0
) -> list[Division]:
    """Divides the emitters into cells no larger than ``voxel``, given by its three edges (``None``
    leaves emitters whole). The cells of a mesh also separate faces of different orientation.

    Parameters:
        face_cells: With this, emitters are whole except meshes without a texture: each of their
            faces is a cell. Meshes that have more faces than this have about as many cells.
    """
    emitters = scene.emitters()
    if face_cells:
        return [_divide_faces(*pair, face_cells) for pair in zip(emitters, emitter_shapes(scene))]
    limit = max(1, min(_MAX_CELLS, _CELL_BUDGET // max(1, len(emitters))))
    return [
        _divide(emitter, shape, voxel, limit)
        for emitter, shape in zip(emitters, emitter_shapes(scene))
    ]


def _divide_faces(emitter: mi.Emitter, shape: mi.Shape | None, limit: int) -> Division:
    is_textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    is_mesh = shape is not None and shape.is_mesh() and shape.face_count() >= _LEAST_FACES
    if is_textured or not is_mesh or emitter.class_name() != "AreaLight":
        return _divide(emitter, shape, None, 1)
    return _divide_mesh(shape, None, limit, are_interpolated(shading_cosines(shape)), True)


def _divide(
    emitter: mi.Emitter, shape: mi.Shape | None, voxel: np.ndarray | None, limit: int
) -> Division:
    whole = Division(_WHOLE, np.ones(1, int))
    is_area = emitter.class_name() == "AreaLight"
    if shape is None or not is_area:
        return whole
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
        division = _divide_shape(shape, voxel, limit)
        division.is_textured = True
        return division if _is_even(emitter, shape, division) else whole
    return _divide_shape(shape, voxel, limit)


def _divide_shape(shape: mi.Shape, voxel: np.ndarray | None, limit: int) -> Division:
    whole = Division(_WHOLE, np.ones(1, int))
    kind = _GRIDS.get(shape.class_name())
    if kind is None and shape.is_mesh() and shape.face_count() > 0:
        is_smooth = are_interpolated(shading_cosines(shape))
        is_cut = voxel is not None and limit > 1
        if not is_cut and not is_smooth:
            return whole
        return _divide_mesh(shape, voxel if is_cut else None, limit, is_smooth)
    if kind is None or voxel is None or limit == 1:
        return whole
    columns, rows = _cuts(_edges(shape, kind) / voxel, limit)
    y, x = np.divmod(np.arange(columns * rows), columns)
    pieces = np.stack(
        [x / columns, y / rows, np.full(x.shape, 1 / columns), np.full(x.shape, 1 / rows)], axis=1
    )
    return Division(pieces, np.ones(len(pieces), int), kind, (columns, rows))


def _is_even(emitter: mi.Emitter, shape: mi.Shape, division: Division) -> bool:
    """Whether a textured emitter is uniform enough within its cells: choosing a cell and sampling
    it by area has at most ``_MAX_UNEVENNESS`` times the second moment of sampling the texture."""
    if len(division.cell_sizes) == 1:
        return False
    n = _TEXTURE_SAMPLES
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    pieces = division.pieces[:, None]
    points = (pieces[..., :2] + grid * pieces[..., 2:]).reshape(-1, 2).T
    ps = shape.sample_position(0.0, mi.Point2f(points.astype(np.float32)))
    si = mi.SurfaceInteraction3f(ps, comparison_wavelengths(points.shape[1]))
    si.wi = mi.Vector3f(0, 0, 1)
    value = brightness(emitter.eval(si)).numpy().astype(np.float64).reshape(-1, n * n)
    area = division.pieces[:, 2] * division.pieces[:, 3]
    cell = np.repeat(np.arange(len(division.cell_sizes)), division.cell_sizes)
    share, square = (np.bincount(cell, w) for w in (area, area * np.square(value).mean(axis=1)))
    # At best, cells are chosen by the root of their mean square, and texels by their radiance
    by_texture = (area * value.mean(axis=1)).sum()
    # A light that is black, or has no area, is left whole
    return by_texture > 0 and np.sqrt(share * square).sum() ** 2 <= _MAX_UNEVENNESS * by_texture**2


def _edges(shape: mi.Shape, kind: str) -> np.ndarray:
    """Lengths of the surface along the two sides of the unit square, as vectors; shape [2, 3]."""
    if kind == "rectangle":
        corner, x, y, _ = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(4, 3)
        return np.stack([x - corner, y - corner])
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64)
    x, y, z = to_world[:3, :3].reshape(3, 3).T
    if kind == "cylinder":
        # Columns run along the axis; half of the circumference lies at right angles to it
        return np.stack([z, np.pi * np.hypot(x, y)])
    return np.stack([2 * x, 2 * y])


def _cuts(edges: np.ndarray, limit: int) -> tuple[int, int]:
    """The numbers of cells, no longer than a voxel, along two edges given in voxels [2, 3]."""
    lengths = np.maximum(1, np.linalg.norm(edges, axis=1))
    lengths *= min(1.0, np.sqrt(limit / np.prod(lengths)))
    cuts = np.maximum(1, np.ceil(lengths - _TOLERANCE)).astype(int)
    while cuts.prod() > limit:
        cuts[cuts.argmax()] -= 1
    return int(cuts[0]), int(cuts[1])


# ---- Meshes ----


def are_interpolated(cosines: np.ndarray) -> bool:
    """Whether vertex normals with these :func:`shading_cosines` differ from the face normals.
    Normals that are exactly opposite do not count as different."""
    return bool(np.any(np.abs(cosines) < 1 - 1e-4))


def shading_cosines(mesh: mi.Mesh) -> np.ndarray:
    """The cosines between the three vertex normals and the face normal, for each face with an area;
    [3, faces], empty for meshes without vertex normals. Light leaves on the side of the vertex
    normals. A cosine is negative where that is the back of the face: a mirroring ``to_world`` turns
    the faces of a mesh, but not its vertex normals."""
    if not mesh.has_vertex_normals() or mesh.has_face_normals():
        return np.zeros((3, 0))
    a, b, c = triangles(mesh)
    normal = _normalized(np.cross(b - a, c - a))
    face = np.array(mesh.faces_buffer()).reshape(-1, 3)
    vertex_normals = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)
    shading = np.stack([vertex_normals[face[:, i]] for i in range(3)])
    has_area = np.any(normal != 0, axis=1)
    return (shading * normal).sum(-1)[:, has_area]


def triangles(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The three corners of each face; shape [faces, 3] each."""
    vertices = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    face = np.array(mesh.faces_buffer()).reshape(-1, 3)
    return vertices[face[:, 0]], vertices[face[:, 1]], vertices[face[:, 2]]


def _normalized(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)


def _divide_mesh(
    mesh: mi.Mesh, voxel: np.ndarray | None, limit: int, is_smooth: bool, by_face: bool = False
) -> Division:
    """Cuts large faces, and groups pieces that are close together and face the same way.
    ``by_face``: does not cut, and does not group up to ``limit`` faces.

    A mesh samples its faces by area, in order, with the second coordinate of the unit square. The
    first coordinate and the rescaled second one then sample a point of the triangle.
    """
    a, b, c = triangles(mesh)
    normal = _normalized(np.cross(b - a, c - a))
    bottom, top = _faces_in_square(mesh)

    cuts = np.ones(len(normal), int)
    if voxel is not None:
        sides = np.stack([b - a, c - a, c - b]) / voxel
        longest = np.linalg.norm(sides, axis=-1).max(axis=0)
        cuts = np.clip(np.ceil(longest - _TOLERANCE), 1, _MAX_CUTS).astype(int)
        cuts = np.minimum(cuts, max(1, int(np.sqrt(4 * limit / max(1, (cuts > 1).sum())))))
    face_first = np.concatenate([[0], np.cumsum(cuts**2)])
    piece_face = np.repeat(np.arange(len(cuts)), cuts**2)
    row, column = np.divmod(np.arange(face_first[-1]) - face_first[piece_face], cuts[piece_face])
    n = cuts[piece_face]
    height = (top - bottom)[piece_face] / n
    pieces = np.stack([column / n, bottom[piece_face] + row * height, 1 / n, height], axis=1)

    # The centre of each piece, by the map of square_to_uniform_triangle
    t = np.sqrt(np.maximum(0, 1 - (column + 0.5) / n))
    u, v = 1 - t, t * (row + 0.5) / n
    first = a[piece_face]
    middle = first + u[:, None] * (b[piece_face] - first) + v[:, None] * (c[piece_face] - first)

    # Faces without area are never sampled and get no cells
    has_area = height > 0
    if len(pieces) == 1 and not is_smooth:
        return Division(_WHOLE, np.ones(1, int))
    group = np.zeros(len(pieces), int)
    if by_face and has_area.sum() <= limit:
        group[has_area] = np.arange(has_area.sum())
    else:
        if by_face:
            voxel = np.full(3, max(np.ptp(middle, axis=0).max() / _FACE_BOXES, 1e-30))
        group[has_area] = _groups(middle[has_area], normal[piece_face][has_area], voxel, limit)
    order = np.argsort(group, kind="stable")
    face_pieces = np.empty(len(order), int)
    face_pieces[order] = np.arange(len(order))
    return Division(
        pieces[order], np.bincount(group), "mesh", (1, 1), normal[piece_face][order],
        face_first, face_pieces, is_smooth,
    )


def _faces_in_square(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The beginning and the end of each face in the second coordinate of the unit square.

    The sums equal those in Mitsuba's own table, in single precision: with many faces, other sums
    would select neighbours of the intended faces.
    """
    index = mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))
    a, b, c = (mesh.vertex_position(index[k]) for k in range(3))
    area = 0.5 * dr.norm(dr.cross(b - a, c - a))
    total = dr.cumsum(area).numpy().astype(np.float64)
    top = total / max(total[-1], 1e-300)
    return np.concatenate([[0.0], top[:-1]]), top


def _groups(
    middle: np.ndarray, normal: np.ndarray, voxel: np.ndarray | None, limit: int
) -> np.ndarray:
    """The group of each piece, numbered without gaps; at most ``limit`` groups."""
    if voxel is None:
        return np.zeros(len(middle), int)
    side = sides(normal)
    extent = np.ptp(middle, axis=0) / voxel
    # Boxes of equal size, first no longer than a voxel, grow until there are at most ``limit``
    boxes = np.clip(np.ceil(extent - _TOLERANCE), 1, limit)
    relative = (middle - middle.min(axis=0)) / np.maximum(np.ptp(middle, axis=0), 1e-300)
    while True:
        x, y, z = np.minimum(relative * boxes, boxes - 1).astype(int).T
        key = side + SIDES * voxel_number(x, y, z, limit)
        groups = np.unique(key, return_inverse=True)[1].reshape(-1)
        if groups.max() < limit:
            return groups
        if boxes.max() == 1:
            return np.zeros(len(middle), int)
        boxes[boxes.argmax()] = np.ceil(boxes.max() / 2)
