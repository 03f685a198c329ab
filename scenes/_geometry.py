"""Procedural meshes, from which `make_assets.py` builds the furniture of the scenes.

A mesh is a list of positions and triangles; its normals are computed when it is written
(`smooth` or one per face). Lengths are metres, z points up.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass
class Mesh:
    """Triangles; `uv` is present if a scene maps a texture onto the mesh."""

    positions: Floats
    faces: Ints
    uv: Floats | None = None

    def scaled(self, factors: ArrayLike) -> Mesh:
        """Stretched along the axes."""
        return Mesh(self.positions * np.asarray(factors, float), self.faces, self.uv)

    def moved(self, offset: ArrayLike) -> Mesh:
        """Shifted by `offset`."""
        return Mesh(self.positions + np.asarray(offset, float), self.faces, self.uv)

    def turned(self, degrees: float, axis: int = 2) -> Mesh:
        """Rotated about a coordinate axis, counter-clockwise seen from its tip."""
        angle = np.radians(degrees)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turned = self.positions.copy()
        turned[:, i] = np.cos(angle) * self.positions[:, i] - np.sin(angle) * self.positions[:, j]
        turned[:, j] = np.sin(angle) * self.positions[:, i] + np.cos(angle) * self.positions[:, j]
        return Mesh(turned, self.faces, self.uv)


def join(*meshes: Mesh) -> Mesh:
    """Joins meshes into one; it has texture coordinates if all of them have some."""
    firsts = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
    faces = [mesh.faces + first for mesh, first in zip(meshes, firsts)]
    uvs = [mesh.uv for mesh in meshes if mesh.uv is not None]
    return Mesh(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate(uvs) if len(uvs) == len(meshes) else None,
    )


def quad(corner: ArrayLike, u: ArrayLike, v: ArrayLike, uv_scale: float = 1.0) -> Mesh:
    """The parallelogram corner, corner+u, corner+u+v, corner+v; it faces u × v.

    Texture coordinates are lengths along u and v, times `uv_scale`.
    """
    corner, u, v = (np.asarray(a, float) for a in (corner, u, v))
    positions = np.stack([corner, corner + u, corner + u + v, corner + v])
    s, t = np.linalg.norm(u) * uv_scale, np.linalg.norm(v) * uv_scale
    uv = np.array([[0, 0], [s, 0], [s, t], [0, t]])
    return Mesh(positions, np.array([[0, 1, 2], [0, 2, 3]]), uv)


def convex(points: Floats, loops: list[list[int]]) -> Mesh:
    """A convex body around the origin from its facets, each turned to face outwards."""
    faces = []
    for loop in loops:
        a, b, c = points[loop[0]], points[loop[1]], points[loop[2]]
        if np.dot(np.cross(b - a, c - a), a + b + c) < 0:
            loop = loop[::-1]
        faces += [[loop[0], loop[i], loop[i + 1]] for i in range(1, len(loop) - 1)]
    return Mesh(points, np.array(faces))


def box(low: ArrayLike, high: ArrayLike, bevel: float = 0.004) -> Mesh:
    """An axis-aligned box whose edges are bevelled, so that they catch the light."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    half = (high - low) / 2
    # Vertex 3 * corner + axis lies on the facet across `axis`, at that corner
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = np.array([c * (half - bevel * (np.arange(3) != a)) for c in corners for a in range(3)])
    at = {tuple(c): 3 * i for i, c in enumerate(corners.tolist())}
    loops = [[at[tuple(c)] + a for a in range(3)] for c in corners.tolist()]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3

        def vertex(axis: int, sa: int, sb: int, sc: int, order: tuple = (a, b, c)) -> int:
            sign = dict(zip(order, (sa, sb, sc)))
            return at[(sign[0], sign[1], sign[2])] + axis

        around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        for s in (-1, 1):
            loops.append([vertex(a, s, sb, sc) for sb, sc in around])
        for sb, sc in around:  # the bevel of the edge that runs along `a`
            loops.append(
                [vertex(b, -1, sb, sc), vertex(b, 1, sb, sc)]
                + [vertex(c, 1, sb, sc), vertex(c, -1, sb, sc)]
            )
    return convex(points, loops).moved((low + high) / 2)


def block(low: ArrayLike, high: ArrayLike) -> Mesh:
    """An axis-aligned box of six plain faces that face outwards."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    sides = []
    for a in range(3):
        u, v = ((high - low) * (np.arange(3) == (a + k) % 3) for k in (1, 2))
        sides += [quad(low, v, u), quad(np.where(np.arange(3) == a, high, low), u, v)]
    mesh = join(*sides)
    return Mesh(mesh.positions, mesh.faces)


def perforated(xs: ArrayLike, ys: ArrayLike, holes: set[tuple[int, int]]) -> Mesh:
    """A wall in the plane z = 0 that faces +z: all cells of a grid except the given holes."""
    xs, ys = np.asarray(xs, float), np.asarray(ys, float)
    cells = [
        quad((xs[i], ys[j], 0), (xs[i + 1] - xs[i], 0, 0), (0, ys[j + 1] - ys[j], 0))
        for i in range(len(xs) - 1)
        for j in range(len(ys) - 1)
        if (i, j) not in holes
    ]
    wall = join(*cells)
    return Mesh(wall.positions, wall.faces)


def icosphere(levels: int) -> Mesh:
    """A unit icosahedron, its triangles split in four `levels` times."""
    g = (1 + 5**0.5) / 2
    points = [(s, t * g, 0.0) for s in (-1, 1) for t in (-1, 1)]
    points = [np.roll(p, k) for p in points for k in range(3)]
    corners = [p / np.linalg.norm(p) for p in points]
    edge = min(np.linalg.norm(corners[0] - p) for p in corners[1:]) * 1.01
    near = [[np.linalg.norm(p - q) < edge for q in corners] for p in corners]
    loops = [
        [i, j, k]
        for i in range(12)
        for j in range(i)
        for k in range(j)
        if near[i][j] and near[j][k] and near[i][k]
    ]
    mesh = convex(np.array(corners), loops)
    for _ in range(levels):
        vertices, middles, faces = list(mesh.positions), {}, []
        for face in mesh.faces.tolist():
            between = []
            for i, j in ((0, 1), (1, 2), (2, 0)):
                key = tuple(sorted((face[i], face[j])))
                if key not in middles:
                    middle = vertices[key[0]] + vertices[key[1]]
                    middles[key] = len(vertices)
                    vertices.append(middle / np.linalg.norm(middle))
                between.append(middles[key])
            a, b, c = between
            faces += [[face[0], a, c], [face[1], b, a], [face[2], c, b], [a, b, c]]
        mesh = Mesh(np.array(vertices), np.array(faces))
    return mesh


def rounded(points: ArrayLike, times: int = 2) -> Floats:
    """Chaikin's corner cutting; the ends stay where they are."""
    points = np.asarray(points, float)
    for _ in range(times):
        a, b = points[:-1], points[1:]
        cut = np.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], axis=1).reshape(-1, 2)
        points = np.concatenate([points[:1], cut[1:-1], points[-1:]])
    return points


def _rings(rings: Floats, closed: bool = False) -> Mesh:
    """Triangles between consecutive rings of vertices, of shape (ring, around, 3)."""
    count, around, _ = rings.shape
    faces = []
    for i in range(count if closed else count - 1):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            c, d = ((i + 1) % count) * around + j, ((i + 1) % count) * around + (j + 1) % around
            faces += [[a, b, d], [a, d, c]]
    positions = rings.reshape(-1, 3)
    corners = positions[np.array(faces)]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # A ring of radius zero, a pole, makes triangles without area
    return Mesh(positions, np.array(faces)[np.linalg.norm(across, axis=1) > 1e-12])


def lathe(profile: ArrayLike, around: int = 40) -> Mesh:
    """The profile (radius, height) turned about z; it faces to the right of its direction."""
    profile = np.asarray(profile, float)
    angle = 2 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.zeros((len(profile), around, 3))
    rings[..., :2] = profile[:, None, :1] * circle
    rings[..., 2] = profile[:, None, 1]
    return _rings(rings)


def tube(
    path: ArrayLike, radii: ArrayLike, up: ArrayLike, closed: bool = False, around: int = 16
) -> Mesh:
    """A round tube along `path`; `up` (one or one per point) is nowhere parallel to it."""
    path = np.asarray(path, float)
    if closed:
        tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    else:
        tangent = np.gradient(path, axis=0)
    side = np.cross(tangent, np.broadcast_to(np.asarray(up, float), path.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    normal = np.cross(side, tangent)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(around)[None, :, None] / around
    reach = np.broadcast_to(np.asarray(radii, float), (len(path),))[:, None, None]
    offset = np.cos(angle) * side[:, None] - np.sin(angle) * normal[:, None]
    return _rings(path[:, None] + reach * offset, closed)


def torus_knot(
    p: int, q: int, ring: float, thickness: float, wire: float, steps: int = 240
) -> Mesh:
    """A tube of radius `wire` that winds q times around a torus while going p times round it."""
    t = 2 * np.pi * np.arange(steps) / steps
    outward = np.stack([np.cos(p * t), np.sin(p * t), 0 * t], axis=1)
    off_core = np.cos(q * t)[:, None] * outward
    off_core[:, 2] += np.sin(q * t)
    return tube(ring * outward + thickness * off_core, wire, off_core, closed=True)


def write_ply(path: Path, mesh: Mesh, smooth: bool = False) -> None:
    """Writes a binary PLY with normals: averaged over each vertex's triangles, or one per triangle.

    Coordinates are rounded to a micrometre, so that the file does not depend on the last bits of a
    machine's sine.
    """
    positions, faces, uv = mesh.positions, mesh.faces, mesh.uv
    if not smooth:
        positions, uv = positions[faces.ravel()], None if uv is None else uv[faces.ravel()]
        faces = np.arange(len(positions)).reshape(-1, 3)
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normals = np.zeros_like(positions)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, 1)  # a vertex that no triangle uses has none
    columns = [positions, normals] + ([] if uv is None else [uv])
    vertices = np.round(np.concatenate(columns, axis=1), 6) + 0.0  # no negative zeros
    names = ["x", "y", "z", "nx", "ny", "nz"] + ([] if uv is None else ["u", "v"])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    records = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    records["count"], records["index"] = 3, faces
    data = "\n".join(header).encode() + b"\n" + vertices.astype("<f4").tobytes() + records.tobytes()
    path.write_bytes(data)
