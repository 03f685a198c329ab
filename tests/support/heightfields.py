"""Height fields, the meshes of the same triangles, and rays that hit both."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.lightweight.traversal import NONE
from mitsuba_ext.util.arrays import from_numpy


def terrain(rows: int, columns: int, roughness: float = 0.1) -> np.ndarray:
    """Smooth hills, and noise on them."""
    y, x = np.mgrid[0:rows, 0:columns]
    hills = 0.3 * np.sin(5 * x / columns) * np.cos(4 * y / rows)
    noise = np.random.default_rng(rows).uniform(-1, 1, (rows, columns))
    return (hills + roughness * noise).astype(np.float32)


def heightfield(values: np.ndarray, **parameters):
    return mi.load_dict({
        "type": "heightfield", "bitmap": mi.Bitmap(values[..., None]), **parameters,
    })  # fmt: skip


def mesh_of(
    heights: np.ndarray, to_world: mi.ScalarTransform4f, face_normals: bool = False,
    flip_normals: bool = False, bsdf: dict | None = None,
) -> mi.Mesh:  # fmt: skip
    """The same triangles as a mesh, with vertex normals from differences of heights."""
    rows, columns = heights.shape
    y, x = np.mgrid[0:rows, 0:columns]
    matrix = np.array(to_world.matrix, dtype=np.float64)
    x, y = 2 * x / (columns - 1) - 1, 2 * y / (rows - 1) - 1
    vertices = np.stack([x, y, heights.astype(np.float64)], axis=-1).reshape(-1, 3)
    along_y, along_x = np.gradient(heights.astype(np.float64))
    normals = np.stack(
        [-along_x * (columns - 1) / 2, -along_y * (rows - 1) / 2, np.ones_like(x)], axis=-1
    ).reshape(-1, 3) @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    left, right = (a, a + columns + 1, a + columns), (a, a + 1, a + columns + 1)
    faces = np.stack([np.stack(t, axis=1) for t in (left, right)], axis=1)
    props = mi.Properties()
    props["flip_normals"] = flip_normals
    if bsdf is not None:
        props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("grid", rows * columns, faces.size // 3, props, not face_normals, True)
    parameters = mi.traverse(mesh)
    vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    parameters["vertex_positions"] = from_numpy(mi.Float, vertices)
    parameters["faces"] = from_numpy(mi.UInt32, faces)
    if not face_normals:
        parameters["vertex_normals"] = from_numpy(mi.Float, normals)
    uv = np.stack([(x + 1) / 2, (y + 1) / 2], axis=-1)
    parameters["vertex_texcoords"] = from_numpy(mi.Float, uv)
    parameters.update()
    return mesh


def make_rays(origins: np.ndarray, targets: np.ndarray) -> mi.Ray3f:
    d = targets - origins
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (from_numpy(mi.Float, p) for p in (origins.ravel(), d.ravel()))
    return mi.Ray3f(dr.unravel(mi.Point3f, o), dr.unravel(mi.Vector3f, d))


def rays_at(bounds: mi.ScalarBoundingBox3f, kind: str, count: int = 20_000) -> mi.Ray3f:
    """Rays to points of a box, from a camera or from all around."""
    rng = np.random.default_rng(3)
    low, high = np.array(bounds.min), np.array(bounds.max)
    high[2] += high[2] == low[2]  # flat
    targets = rng.uniform(low, high, (count, 3))
    if kind == "camera":
        origins = np.tile(high + [0.5, 1.5, 1], (count, 1))
    else:
        origins = rng.uniform(2 * low - high, 2 * high - low, (count, 3))
    return make_rays(origins, targets)


def interaction(shape: mi.Shape, rays: mi.Ray3f) -> mi.SurfaceInteraction3f:
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(rays))
    pi.t, pi.prim_index, pi.prim_uv = shape.lightweight.closest(rays, mi.Bool(True))
    pi.shape, pi.valid = mi.ShapePtr(shape), pi.prim_index != NONE
    pi.t = dr.select(pi.valid, pi.t, dr.inf)
    return shape.lightweight.interaction(pi, rays)
