"""The visibility map: occupied voxels, counts, and the probabilities from them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.regions.voxel_grid import VoxelGrid
from mitsuba_ext.techniques.shadow_rejection.visibility_map import (
    MAX_VOXELS,
    VisibilityMap,
    _row_and_column,
)
from mitsuba_ext.techniques.shadow_rejection.visibility_roulette import VisibilityRoulette
from mitsuba_ext.techniques.shadow_rejection.visibility_roulette_learner import (
    VisibilityRouletteLearner,
)
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.rejection_law import RejectionLaw

pytestmark = pytest.mark.usefixtures("variant")


def _scene(scale: float = 1.0, offset: float = 0.0, **more) -> mi.Scene:
    """Two cubes side by side; their common wall separates them."""
    T = mi.ScalarTransform4f
    box = {"type": "cube", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    place = T().translate(offset).scale(scale)
    return mi.load_dict(
        {
            "type": "scene",
            "left": {**box, "to_world": place @ T().translate([-1, 0, 0])},
            "right": {**box, "to_world": place @ T().translate([1, 0, 0])},
            **more,
        }
    )


def _points(*points) -> mi.Point3f:
    return mi.Point3f(np.array(points, dtype=np.float32).T)


@pytest.mark.parametrize("scale, offset", [(1, 0), (1e-3, 0), (1e4, 0), (1, 1e3)])
@pytest.mark.parametrize("resolution", [1, 5, 16, 40])
def test_every_hit_lies_in_an_occupied_voxel(scale, offset, resolution):
    """Slanted and analytic shapes, walls on voxel faces, small, large and distant scenes."""
    T = mi.ScalarTransform4f
    place = T().translate(offset).scale(scale)
    scene = _scene(
        scale, offset,
        tilted={"type": "rectangle", "to_world": place @ T().rotate([1, 2, 3], 50).scale(0.9)},
        ball={"type": "sphere", "to_world": place @ T().translate([0.3, 0.2, 0.1]).scale(0.2)},
    )
    grid = VoxelGrid(scene, resolution)
    rng = mi.PCG32(size=20_000)
    o = mi.Point3f(*(scale * (4 * rng.next_float32() - 2) + offset for _ in range(3)))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    si = scene.ray_intersect(mi.Ray3f(o, d))
    known = grid.index(si.p, si.is_valid())[1]
    unknown = int(dr.count(si.is_valid() & ~known)[0])
    # A thousand times its size from the origin, the scene's own coordinates are rounded
    assert unknown <= (0 if offset == 0 else 1e-3 * dr.width(known))
    assert 0 < grid.occupied_count <= resolution**3


def test_only_voxels_that_a_triangle_crosses_are_occupied(tmp_path):
    """A diagonal plane crosses the voxels of the diagonal and their neighbours, not all."""
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 45)
    path = str(tmp_path / "plane.ply")
    _as_mesh(path, mi.load_dict({"type": "scene", "r": {"type": "rectangle", "to_world": turn}}))
    n = 16
    grid = VoxelGrid(mi.load_dict({"type": "scene", "m": {"type": "ply", "filename": path}}), n)
    assert n * n <= grid.occupied_count <= 3.2 * n * n


def _as_mesh(path: str, scene: mi.Scene) -> None:
    """Writes the rectangle of ``scene`` as two triangles."""
    mesh = mi.Mesh("plane", 4, 2)
    parameters = mi.traverse(mesh)
    shape = scene.shapes()[0]
    corners = shape.eval_parameterization(mi.Point2f([0, 1, 1, 0], [0, 0, 1, 1])).p
    parameters["vertex_positions"] = dr.ravel(corners)
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters.update()
    mesh.write_ply(path)


def test_a_scene_without_geometry_has_no_voxels():
    with pytest.raises(ValueError, match="without geometry"):
        VoxelGrid(mi.load_dict({"type": "scene", "e": {"type": "constant"}}), 4)


def test_a_flat_scene_has_voxels():
    grid = VoxelGrid(mi.load_dict({"type": "scene", "r": {"type": "rectangle"}}), 8)
    assert bool(dr.all(grid.index(_points([0, 0, 0], [0.99, -0.99, 0]), mi.Bool(True))[1]))


def test_entries_are_symmetric_and_their_numbers_invertible():
    entry = dr.arange(mi.UInt32, 3_000_000)
    row, column = _row_and_column(entry)
    assert bool(dr.all((column <= row) & (row * (row + 1) // 2 + column == entry)))
    # The last row that a map can have
    last = MAX_VOXELS - 1
    row, column = _row_and_column(mi.UInt32(last * (last + 1) // 2) + mi.UInt32(0, 1, last))
    assert row.numpy().tolist() == [last] * 3 and column.numpy().tolist() == [0, 1, last]
    visibility = VisibilityMap(_scene(), 8, 2**24)
    p, q = _points([-1.9, 0.1, 0.98], [0.5, 0.98, 0.2]), _points([1.9, 0.4, -0.9], [-1, -0.98, 0])
    a, b = (visibility.entry(*pq, mi.Bool(True)) for pq in ((p, q), (q, p)))
    assert bool(dr.all((a[0] == b[0]) & a[1] & b[1]))


def test_counts_become_the_table_and_the_roulette():
    """Ninety tests across the wall fail, ninety within the left cube succeed."""
    visibility = VisibilityMap(_scene(), 8, 2**24)
    p = _points([-1.9, 0.1, 0.98])
    across, within = _points([1.9, 0.1, 0.98]), _points([-1.9, 0.1, -0.98])
    lanes = dr.gather(mi.Point3f, p, dr.zeros(mi.UInt32, 90))
    for q, visible in ((across, False), (within, True)):
        visibility.shadow_ray(lanes, q, mi.Bool(visible), mi.Bool(True))

    def V(q):
        return float(visibility.posterior_mean(visibility.entry(p, q, mi.Bool(True))[0])[0])

    # The prior is worth one test and expects half of them to succeed
    assert V(across) == pytest.approx(0.5 / 91) and V(within) == pytest.approx(90.5 / 91)
    assert V(_points([-1.9, -0.9, 0.98])) == pytest.approx(0.5), "never tested"

    si, ds = dr.zeros(mi.SurfaceInteraction3f), dr.zeros(mi.DirectionSample3f)
    si.p = p
    for q, expected in ((across, 10 * 0.5 / 91 + 0.01), (within, 1.0), (_points([9, 9, 9]), 1.0)):
        ds.p = q
        roulette = VisibilityRoulette(visibility, RejectionLaw("affine", 10, 0.01))
        p_test = roulette.probability((), (), si, ds, mi.Bool(True))[0]
        assert float(p_test[0]) == pytest.approx(expected)
    ds.p = across
    paper = VisibilityRoulette(visibility, RejectionLaw("paper", 10, 0.01))
    assert float(paper.probability((), (), si, ds, mi.Bool(True))[0][0]) == pytest.approx(1e-4)


def test_refinement_tests_the_space_between_the_voxels():
    """A success seen by chance between the cubes is corrected by the wall; one within is not."""
    scene = _scene()
    visibility = VisibilityMap(scene, 8, 2**24)
    p, across, within = (
        _points(x) for x in ([-1.9, 0.1, 0.98], [1.9, 0.1, 0.98], [-1.9, 0.1, -0.98])
    )
    for q in (across, within):
        visibility.shadow_ray(p, q, mi.Bool(True), mi.Bool(True))
    visibility.refine(scene, 200)
    through, inside = (
        float(visibility.ratio(visibility.entry(p, q, mi.Bool(True))[0])[0])
        for q in (across, within)
    )
    assert through < 0.02 < 0.1 < inside


@pytest.mark.parametrize("grid", [16, 200, 1024])
def test_the_map_stays_within_its_memory(grid):
    visibility = VisibilityMap(_scene(), grid, 2**22)
    assert visibility.voxels.resolution < grid
    assert visibility._memory() <= 2**22
    assert f"grid {visibility.voxels.resolution}" in str(visibility)


def test_the_same_seed_gives_bitwise_the_same_map(scenes):
    """Integers decide: two renders with one seed learn the same, in any order of the atomics."""
    scene = mi.load_file(str(scenes / "door_ajar.xml"), width=64, height=36)
    walk_maps = []
    for _ in range(2):
        integrator = mi.load_dict({"type": "neepp", "max_depth": 4})
        learner = VisibilityRouletteLearner(12, 16, 4, RejectionLaw("affine", 10, 0.1))
        learner.start(scene, mi.Point3f(), mi.Normal3f())
        walk, visibility = integrator.walk(observer=learner), learner._map
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(3, 50_000)
        ray = scene.sensors()[0].sample_ray(0, 0, sampler.next_2d(), sampler.next_2d())[0]
        dr.eval(walk(scene, sampler, CameraRays(ray), mi.Bool(True)).L)
        visibility.refine(scene, 4)
        walk_maps.append((visibility.tests.numpy(), visibility.successes.numpy()))
    (tests, successes), (tests_again, successes_again) = walk_maps
    assert tests.sum() > 50_000 and (successes <= tests).all()
    assert (tests == tests_again).all() and (successes == successes_again).all()
