"""The tree of lightweight meshes: its shape, its boxes, and the hits that rays find in it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lightweight.building import INNER_BITS, TOP
from mitsuba_ext.scene.lightweight.heap import ARITY, CAPACITY, HEAP_BITS, LEAF_SIZE, Heap
from mitsuba_ext.scene.lightweight.mesh_geometry import MeshGeometry
from mitsuba_ext.scene.lightweight.mesh_tree import MeshTree, _boxes
from mitsuba_ext.scene.lightweight.nodes import MIN_EXPONENT
from mitsuba_ext.scene.lightweight.packed_mesh import PackedMesh
from mitsuba_ext.scene.lightweight.traversal import NONE
from tests.support.stage import mesh

pytestmark = pytest.mark.usefixtures("variant")

COUNTS = [1, 2, 4, 5, 16, 17, 20, 21, 64, 65, 130, 333, 1100, 5000]


def _soup(count: int, spread: float = 1.0, size: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    centres = rng.uniform(-spread, spread, (count, 1, 3))
    corners = centres + rng.normal(0, size, (count, 3, 3))
    faces = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    return corners.reshape(-1, 3).astype(np.float32), faces


def _ball(cells: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed, bumpy ball without seams: the sides of a cube, blown up."""
    line = np.linspace(-1, 1, cells + 1)
    points, faces = [], []
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = i * (cells + 1) + j
    for axis in range(3):
        for side in (-1.0, 1.0):
            p = np.full((cells + 1, cells + 1, 3), side)
            p[..., axis - 2], p[..., axis - 1] = np.meshgrid(line, line, indexing="ij")
            first = len(points) * (cells + 1) ** 2
            quads = [corner, corner + cells + 1, corner + cells + 2, corner + 1]
            for a, b, c in ((0, 1, 2), (0, 2, 3)):
                triple = [quads[k] + first for k in ((a, b, c) if side > 0 else (c, b, a))]
                faces.append(np.stack(triple, axis=-1).reshape(-1, 3))
            points.append(p.reshape(-1, 3))
    p = np.concatenate(points)
    _, first, number = np.unique(np.rint(p * 1e6), axis=0, return_index=True, return_inverse=True)
    p = p[first] / np.linalg.norm(p[first], axis=1, keepdims=True)
    bumps = np.sin(9 * p[:, 0]) * np.sin(11 * p[:, 1]) + 0.5 * np.sin(37 * p[:, 2])
    p = p * (1 + 0.05 * bumps[:, None]) + offset
    return p.astype(np.float32), number.ravel()[np.concatenate(faces)].astype(np.uint32)


def _rays(o: np.ndarray, d: np.ndarray, maxt: float = np.inf) -> mi.Ray3f:
    o, d = (np.ascontiguousarray(v.T.astype(np.float32)) for v in (o, d))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
    ray.maxt = min(maxt, dr.largest(mi.Float))
    return ray


@pytest.mark.parametrize("count", COUNTS)
def test_heap_holds_each_triangle_once(count: int) -> None:
    heap = Heap(count)
    assert heap.counts[0] == count
    leaves = heap.counts[heap.inner :]
    assert leaves.sum() == count and leaves.max() <= LEAF_SIZE
    assert len(heap.counts) == ARITY * heap.inner + 1
    # No leaf before the last triangles is partly filled: leaf k begins with triangle 4k
    assert (leaves[: count // LEAF_SIZE] == LEAF_SIZE).all()
    assert sorted(heap.leaves_from_left()) == list(range(heap.inner, len(heap.counts)))


def _decoded(tree: MeshTree) -> np.ndarray:
    """The boxes of the children of each node in world space. Shape (nodes, 4, 2, 3)."""
    words = np.array(tree.nodes).reshape(-1, 8)
    bytes_ = words[:, :6, None] >> (8 * np.arange(4, dtype=np.uint32)) & 0xFF
    x, y = words[:, 6] & 0xFFFF, words[:, 6] >> 16
    corner = np.stack([x, y, words[:, 7] & 0xFFFF], axis=1).astype(float)
    exponents = words[:, 7, None] >> np.array([16, 20, 24], dtype=np.uint32) & 15
    unit = 2.0 ** (exponents.astype(float) + MIN_EXPONENT)
    boxes = bytes_.reshape(-1, 2, 3, 4).astype(float) * unit[:, None, :, None]
    boxes += corner[:, None, :, None]
    return (boxes / tree.grid.scale[:, None] + tree.grid.low[:, None]).transpose(0, 3, 1, 2)


def _walk(tree: MeshTree, boxes: np.ndarray, triangles: np.ndarray, slack: float) -> np.ndarray:
    """Visits all nodes, and checks that they contain the triangles below. Returns how often each
    triangle was found."""
    found = np.zeros(len(triangles), dtype=int)
    headers = np.array(tree.headers).reshape(-1, 2).astype(np.int64)
    # Node, the box in which its triangles must be, and how many others wait
    todo = [(0, 0, (np.full(3, -np.inf), np.full(3, np.inf)), 0)]
    while todo:
        number, index, (low, high), waiting = todo.pop()
        assert waiting <= tree.stack_size and index < 1 << HEAP_BITS
        address, first = headers[number]
        address, inner = address >> INNER_BITS, address & TOP
        if index >= inner:
            start = LEAF_SIZE * (first + index - inner)
            mine = slice(start, start + LEAF_SIZE)
            found[mine] += 1
            assert (low <= triangles[mine, 0] + slack).all()
            assert (high >= triangles[mine, 1] - slack).all()
            continue
        for c, box in enumerate(boxes[address + index]):
            if (box[0] <= box[1]).all():
                child = (first + c, 0) if inner == TOP else (number, ARITY * index + 1 + c)
                inside = np.maximum(low, box[0]), np.minimum(high, box[1])
                todo.append((*child, inside, waiting + ARITY - 1))
    return found


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("kind", ["soup", "flat", "far", "uneven"])
def test_boxes_of_nodes_contain_their_triangles(count: int, kind: str) -> None:
    vertices, faces = _soup(count)
    if kind == "flat":
        vertices[:, 1] = 0.3
    if kind == "far":
        vertices += np.float32(1000)
    if kind == "uneven":
        vertices[: 3 * (count // 2)] *= np.float32(1e-4)
    tree = MeshTree(vertices, faces)
    triangles = _boxes(vertices, faces)[:, tree.order].T.reshape(-1, 2, 3)
    # The decoding itself is rounded
    slack = 1e-9 * (1 + np.abs(vertices).max())
    assert (_walk(tree, _decoded(tree), triangles, slack) == 1).all()
    assert sorted(tree.order) == list(range(count))


def test_triangles_in_one_place_are_split_in_the_middle() -> None:
    # Each triangle is larger than the one before: the cheapest splits take one leaf off
    size = np.float32(2.0) ** np.linspace(-60, 60, 40_000, dtype=np.float32)
    vertices = (size[:, None, None] * np.eye(3, dtype=np.float32)).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    tree = MeshTree(vertices, faces)
    assert tree.stack_size < 200
    triangles = _boxes(vertices, faces)[:, tree.order].T.reshape(-1, 2, 3)
    assert (_walk(tree, _decoded(tree), triangles, 1e-6 * float(size.max())) == 1).all()


def test_equal_triangles_make_a_balanced_tree() -> None:
    vertices, _ = _soup(1)
    tree = MeshTree(vertices, np.tile(np.uint32([[0, 1, 2]]), (40 * CAPACITY, 1)))
    assert tree.stack_size <= 48


def test_splits_follow_walls_among_small_things() -> None:
    small, faces = _soup(20 * CAPACITY, size=0.001)
    wall = np.float32([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
    walls = np.concatenate([wall + np.float32([0, 0, z]) for z in np.linspace(-1, 1, 30)])
    quads = np.concatenate([4 * k + np.array([[0, 1, 2], [0, 2, 3]]) for k in range(30)])
    vertices = np.concatenate([small, walls])
    tree = MeshTree(vertices, np.concatenate([faces, quads + len(small)]).astype(np.uint32))
    low, high = _decoded(tree).transpose(2, 3, 0, 1)
    x, y, z = np.where((low <= high).all(axis=0), high - low, 0)
    # How many boxes a ray meets that meets the mesh's, 4 x 4 x 2; 26 where all splits are in the
    # middle
    assert (x * y + y * z + z * x).sum() / (4 * 4 + 4 * 2 + 4 * 2) < 21


@pytest.mark.parametrize("count", COUNTS)
def test_rays_hit_the_same_points_as_in_mitsuba(count: int) -> None:
    vertices, faces = _soup(count)
    geometry = MeshGeometry(mesh(vertices, faces))
    scene = mi.load_dict({"type": "scene", "mesh": mesh(vertices, faces)}, optimize=False)
    rng = np.random.default_rng(7)
    o, d = rng.uniform(-2, 2, (2, 20_000, 3))
    d[:3000] = np.eye(3)[rng.integers(0, 3, 3000)] * rng.choice([-1, 1], (3000, 1))
    for maxt in (np.inf, 0.7):
        ray = _rays(o, d, maxt)
        t, triangle, uv = geometry.closest(ray, mi.Bool(True))
        expected = scene.ray_intersect_preliminary(ray, coherent=False)
        found, hits = triangle.numpy() != NONE, expected.is_valid().numpy()
        # A ray within rounding errors of an edge may hit in one and miss in the other
        assert (found != hits).mean() < 1e-3
        both = found & hits
        close = np.isclose(t.numpy()[both], expected.t.numpy()[both], rtol=1e-4, atol=1e-5)
        assert close.mean() > 0.999
        assert (geometry.occluded(ray, mi.Bool(True)).numpy() == found).all()
        assert not geometry.occluded(ray, mi.Bool(False)).numpy().any()
        p = np.array(ray(t)).T[found]
        corners = vertices[np.array(mi.traverse(geometry.surface)["faces"]).reshape(-1, 3)]
        a, b, c = corners[triangle.numpy()[found]].transpose(1, 0, 2)
        u, v = uv.numpy()[:, found, None]
        assert np.allclose(a * (1 - u - v) + b * u + c * v, p, atol=2e-4)


@pytest.mark.parametrize(
    "rays", [30_000, pytest.param(2_000_000, marks=pytest.mark.slow)], ids=["few", "many"]
)
@pytest.mark.parametrize("is_packed", [False, True], ids=["mesh", "packed"])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_no_ray_leaves_closed_mesh_through_edge_or_corner(
    rays: int, is_packed: bool, offset: float
) -> None:
    vertices, faces = _ball(60, offset)
    geometry = (PackedMesh if is_packed else MeshGeometry)(mesh(vertices, faces))
    if is_packed:
        vertices = geometry._decoded(geometry._position.encode(vertices))
    rng = np.random.default_rng(3)
    o = np.float32(rng.normal(0, 0.2, (rays, 3)).clip(-0.5, 0.5) + offset)
    a, b, _ = faces[rng.integers(0, len(faces), rays)].T
    weight = rng.random((rays, 1))
    weight[: rays // 3] = 0  # a corner
    weight[rays // 3 : rays // 2] = 0.5
    target = vertices[a] * (1 - weight) + vertices[b] * weight
    assert geometry.occluded(_rays(o, target - o), mi.Bool(True)).numpy().all()


def test_memory_agrees_with_the_manual() -> None:
    vertices, faces = _ball(60)
    assert MeshGeometry(mesh(vertices, faces)).nbytes / len(faces) < 3.4
    assert PackedMesh(mesh(vertices, faces)).nbytes / len(faces) < 12.5


def test_equal_and_degenerate_triangles_are_accepted() -> None:
    vertices, faces = _soup(3)
    vertices[3:6] = vertices[3]  # a point
    vertices[6:9] = vertices[6] + np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]])  # a line
    faces = faces[np.tile([0, 1, 2], 50)]
    geometry = MeshGeometry(mesh(vertices, faces))
    o = np.tile([0.0, 0.0, 5.0], (2, 1))
    targets = np.stack([vertices[:3].mean(axis=0), [0, 0, 9]])
    t, triangle, _ = geometry.closest(_rays(o, targets - o), mi.Bool(True))
    assert np.allclose(t.numpy()[0], 1, atol=1e-4) and triangle.numpy()[1] == NONE
