"""The shape ``heightfield``: the same surface as a mesh of Mitsuba with the same triangles."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lightweight.height_tree import cell
from mitsuba_ext.scene.lightweight.traversal import NONE
from mitsuba_ext.util.arrays import from_numpy
from tests.support.heightfields import (
    heightfield,
    interaction,
    make_rays,
    mesh_of,
    rays_at,
    terrain,
)

pytestmark = pytest.mark.usefixtures("variant")

SIZES = ((2, 2), (3, 5), (17, 33), (100, 70), (2, 40))  # rows and columns


def poses() -> dict[str, mi.ScalarTransform4f]:
    t = mi.ScalarTransform4f
    turned = t().translate([0.5, -2, 1]).rotate([1, 2, -0.5], 130).scale([2, 0.6, 1.5])
    return {"identity": t(), "turned": turned}


def scene_of(mesh: mi.Mesh) -> mi.Scene:
    return mi.load_dict({"type": "scene", "mesh": mesh}, optimize=False)


def number_in_mesh(triangle: mi.UInt32, columns: int) -> np.ndarray:
    x, y, is_right = (np.array(part).astype(np.int64) for part in cell(triangle))
    return 2 * (y * (columns - 1) + x) + is_right


def triangle_of(number: mi.UInt32, columns: int) -> mi.UInt32:
    cell_, is_right = number >> 1, number & 1
    return cell_ % (columns - 1) | cell_ // (columns - 1) << 15 | is_right << 30


@pytest.mark.parametrize("kind", ["camera", "random"])
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("pose", ["identity", "turned"])
def test_rays_hit_the_same_points_as_in_a_mesh(size, pose, kind):
    heights, to_world = terrain(*size), poses()[pose]
    _check_hits(heights, to_world, kind)


@pytest.mark.parametrize(
    "heights",
    [np.zeros((9, 14)), np.full((12, 7), -3.5), 40 * terrain(20, 30), terrain(30, 20) + 1000],
    ids=["zero", "flat", "steep", "high"],
)
def test_flat_steep_and_high_surfaces_are_hit(heights):
    _check_hits(heights.astype(np.float32), mi.ScalarTransform4f(), "random")


def _check_hits(heights: np.ndarray, to_world: mi.ScalarTransform4f, kind: str) -> None:
    shape = heightfield(heights, to_world=to_world)
    mesh = mesh_of(heights, to_world)
    rays = rays_at(mesh.bbox(), kind)
    expected = scene_of(mesh).ray_intersect_preliminary(rays, coherent=False)
    t, triangle, uv = shape.lightweight.closest(rays, mi.Bool(True))
    occluded = shape.lightweight.occluded(rays, mi.Bool(True))
    is_hit = triangle != NONE
    assert dr.all(occluded == is_hit)
    # A ray along the border may or may not hit
    assert dr.count(is_hit != expected.is_valid())[0] <= 4
    both = np.array(is_hit & expected.is_valid())
    if np.ptp(heights) > 0 or kind == "camera":
        assert both.sum() > 1000
    scale = np.abs([mesh.bbox().min, mesh.bbox().max]).max()
    off = np.abs(np.array(t - expected.t))[both] > 2e-5 * scale
    assert off.sum() <= 4
    is_same = both & (number_in_mesh(triangle, heights.shape[1]) == np.array(expected.prim_index))
    assert is_same.sum() > 0.998 * both.sum()
    difference = np.abs(np.array(uv) - np.array(expected.prim_uv)).max(axis=0)[is_same]
    assert np.median(difference) < 2e-5 and np.quantile(difference, 0.999) < 0.02
    b, c = np.array(uv)[:, both]
    assert b.min() >= 0 and c.min() >= 0 and (b + c).max() <= 1


def test_rays_begin_and_end_where_they_should():
    shape = heightfield(np.zeros((5, 5), np.float32))
    down = mi.Ray3f(mi.Point3f([0.1, 0.1, 0.1, 0.1, 1.1], 0.3, [1, 1, -0.1, 1, 1]), [0, 0, -1])
    down.maxt = mi.Float(np.inf, 0.999, np.inf, 1.001, np.inf)
    t, triangle, _ = shape.lightweight.closest(down, mi.Bool(True))
    assert (triangle != NONE).numpy().tolist() == [True, False, False, True, False]
    assert dr.allclose(t, [1, 0.999, np.inf, 1, np.inf])
    _, triangle, _ = shape.lightweight.closest(down, mi.Bool([False, True, True, True, True]))
    assert triangle.numpy()[0] == NONE


@pytest.mark.parametrize("face_normals", [False, True])
@pytest.mark.parametrize("flip_normals", [False, True])
@pytest.mark.parametrize("scale", [1.0, -2.5])
def test_surface_interactions_agree_with_a_mesh(face_normals, flip_normals, scale):
    heights, to_world = terrain(17, 33, 0.05), poses()["turned"]
    normals = {"face_normals": face_normals, "flip_normals": flip_normals}
    shape = heightfield(heights, to_world=to_world, scale=scale, **normals)
    mesh = mesh_of(heights * np.float32(scale), to_world, **normals)
    rays = rays_at(mesh.bbox(), "random", 5000)
    pi = scene_of(mesh).ray_intersect_preliminary(rays, coherent=False)
    pi.valid = pi.is_valid()
    expected = pi.compute_surface_interaction(rays, mi.RayFlags.All | mi.RayFlags.dNSdUV)
    pi.prim_index = triangle_of(pi.prim_index, heights.shape[1])
    pi.shape = mi.ShapePtr(shape)
    si = shape.lightweight.interaction(pi, rays)
    hit = np.array(pi.valid)
    assert hit.sum() > 1000
    vectors = ("p", "n", "uv", "dp_du", "dp_dv", "wi", "dn_du", "dn_dv")
    pairs = [(getattr(si, name), getattr(expected, name), name) for name in vectors]
    pairs += [(getattr(si.sh_frame, k), getattr(expected.sh_frame, k), k) for k in "nst"]
    for found, value, name in pairs:
        found, value = np.array(found)[:, hit], np.array(value)[:, hit]
        error = np.abs(found - value).max() / max(1, np.abs(value).max())
        assert error < (1e-4 if name in "st" else 3e-5), name
    assert dr.all(si.shape == mi.ShapePtr(shape))
    assert dr.all(si.is_valid() == pi.valid)


def test_normals_of_a_mirrored_heightfield_are_on_the_same_side():
    mirrored = mi.ScalarTransform4f().scale([-1, 1, 1])
    for flip_normals in (False, True):
        shape = heightfield(terrain(9, 9), to_world=mirrored, flip_normals=flip_normals)
        rays = make_rays(np.array([[0.1, 0.2, 3]]), np.array([[0.15, 0.25, 0]]))
        si = interaction(shape, rays)
        for n in (si.n, si.sh_frame.n):
            assert (float(n.z[0]) < 0) == flip_normals


@pytest.mark.parametrize("pose", ["identity", "turned"])
@pytest.mark.parametrize("aim", ["vertices", "edges", "straight down"])
def test_no_ray_passes_at_vertices_and_edges(pose, aim):
    rows, columns, count = 65, 48, 100_000
    heights = terrain(rows, columns, 0.01)
    rng = np.random.default_rng(1)
    x, y = rng.integers(2, columns - 2, count), rng.integers(2, rows - 2, count)
    along = rng.random(count) * (aim == "edges")
    # Along the row, along the column or along the diagonal
    dx, dy = np.array([(1, 0), (0, 1), (1, 1)])[rng.integers(0, 3, count)].T
    a, b = heights[y, x].astype(float), heights[y + dy, x + dx].astype(float)
    targets = np.stack([
        2 * (x + along * dx) / (columns - 1) - 1, 2 * (y + along * dy) / (rows - 1) - 1,
        a + along * (b - a),
    ], axis=1)  # fmt: skip
    origins = rng.uniform([-0.8, -0.8, 2], [0.8, 0.8, 3], (count, 3))
    if aim == "straight down":
        origins[:, :2] = targets[:, :2]
    matrix = np.array(poses()[pose].matrix, dtype=np.float64)
    origins, targets = (p @ matrix[:3, :3].T + matrix[:3, 3] for p in (origins, targets))
    shape = heightfield(heights, to_world=poses()[pose])
    t, triangle, _ = shape.lightweight.closest(make_rays(origins, targets), mi.Bool(True))
    assert dr.all(triangle != NONE)
    distances = np.linalg.norm(targets - origins, axis=1)
    assert np.abs(np.array(t) - distances).max() < 0.2


@pytest.mark.parametrize("size", [*SIZES, (64, 129)], ids=str)
@pytest.mark.parametrize("offset", [0.0, 3000.0])
def test_ranges_of_nodes_contain_all_heights(size, offset):
    heights = terrain(*size) + np.float32(offset)
    tree = heightfield(heights).lightweight.tree
    words = np.array(tree.nodes).reshape(-1, 4)
    levels = np.array(tree.levels).reshape(-1, 2)
    low, unit = float(tree.bottom[0]), float(tree.unit[0])
    seen = np.zeros([-(-(n - 1) // 2) for n in size], dtype=int)
    todo = [(0, 0, 0)]
    while todo:
        depth, x, y = todo.pop()
        width, start = levels[depth]
        blocks = 1 << len(levels) - depth - 1  # along a side of a child
        for number, word in enumerate(words[start + y * width + x]):
            i, j = 2 * x + (number & 1), 2 * y + (number >> 1)
            part = heights[2 * j * blocks :, 2 * i * blocks :]
            part = part[: 2 * blocks + 1, : 2 * blocks + 1]
            if min(part.shape) < 2:
                assert word & 0xFFFF > word >> 16  # empty
                continue
            # As the device computes them, within the margin of the traversal
            bottom, top = low + np.array([word & 0xFFFF, word >> 16]) * unit
            margin = 2**-24 * np.abs(heights).max()
            assert bottom <= part.min() + margin and part.max() <= top + margin
            assert top - bottom <= np.ptp(part) + 2.1 * unit + 2 * margin
            if depth + 1 < len(levels):
                todo.append((depth + 1, i, j))
            else:
                seen[j, i] += 1
    assert np.all(seen == 1)


def test_memory_is_less_than_six_bytes_for_a_cell():
    heights = terrain(101, 100)
    cells = 100 * 99
    assert heightfield(heights).lightweight.tree.nbytes < 5.6 * cells
    for dtype in (np.float16, np.uint16, np.uint8):
        shape = heightfield((abs(heights) * 100).astype(dtype))
        assert shape.lightweight.tree.nbytes < 3.6 * cells


def test_render_agrees_with_a_mesh():
    bsdf = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    heights = terrain(40, 30, 0.02)
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], -30)
    shapes = [
        heightfield(heights, to_world=to_world, bsdf=bsdf), mesh_of(heights, to_world, bsdf=bsdf)
    ]  # fmt: skip
    images = []
    for shape in shapes:
        scene = mi.load_dict({
            "type": "scene", "shape": shape,
            "integrator": {"type": "composed_path", "max_depth": 3},
            "light": {"type": "constant", "radiance": 0.3},
            "lamp": {
                "type": "sphere", "center": [0, 2, 3], "radius": 0.5,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}},
            },
            "sensor": {
                "type": "perspective", "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([0, -2, 3], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 48, "height": 48},
            },
        }, optimize=False)  # fmt: skip
        images.append(np.array(mi.render(scene, spp=8, seed=1)))
    # The same paths, except for a few that rounding sends elsewhere
    difference = np.abs(images[0] - images[1])
    assert images[1].std() > 0.05
    assert np.quantile(difference, 0.99) < 1e-3 and difference.mean() < 1e-3


@pytest.mark.parametrize("direction", [(1, 0), (0, -1), (1, 1), (-1, -1), (1, -1), (2, 1)], ids=str)
def test_no_ray_passes_along_grid_lines_and_diagonals(direction):
    """Rays whose projections are lines of the grid, or meet many vertices."""
    heights = terrain(65, 65, 0.002)  # lines are at multiples of 1/32: nothing is rounded
    y, x = (n.ravel() for n in np.mgrid[8:57, 8:57])
    for slope in (-4.0, -8.0):  # steeper than the surface
        down = np.array([*direction, slope])
        targets = np.stack([x / 32 - 1, y / 32 - 1, heights[y, x]], axis=1)
        origins = targets - down * 0.5 / abs(slope)
        origins[:, 2] = targets[:, 2] + 0.5
        o, d = from_numpy(mi.Float, origins), np.tile(down, (len(origins), 1))
        rays = mi.Ray3f(
            dr.unravel(mi.Point3f, o), dr.unravel(mi.Vector3f, from_numpy(mi.Float, d))
        )
        t, triangle, _ = heightfield(heights).lightweight.closest(rays, mi.Bool(True))
        assert dr.all(triangle != NONE)
        assert dr.allclose(t, 0.5 / abs(slope), atol=1e-5)
