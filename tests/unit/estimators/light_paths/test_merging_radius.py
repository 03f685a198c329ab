"""The grid that finds vertices within a radius, and the radius of merging."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.merging import merging_parameters
from mitsuba_ext.estimators.light_paths.merging.merging import median_footprint
from mitsuba_ext.estimators.light_paths.merging.merging_radius import MergingRadius
from mitsuba_ext.estimators.light_paths.merging.vertex_grid import VertexCounts, VertexGrid
from mitsuba_ext.transport.scene_query import SceneQuery
from tests.support.stage import film, stage

pytestmark = pytest.mark.usefixtures("variant")


def sppm(**parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "sppm", "max_depth": 4, **parameters})


# ---- The grid ----


@dataclass
class Points:
    """Points in the place of vertices."""

    p: np.ndarray

    @property
    def count(self) -> int:
        return len(self.p)

    @property
    def room(self) -> int:
        return self.count + 5

    def every(self) -> tuple[mi.UInt32, mi.Bool]:
        index = dr.arange(mi.UInt32, self.room)
        return index, index < self.count

    def position(self, index: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        columns = (mi.Float(column.tolist()) for column in self.p.T)
        return mi.Point3f(*(dr.gather(mi.Float, column, index, active) for column in columns))


@dr.syntax
def sum_of_found(grid: VertexGrid, p: mi.Point3f) -> tuple[mi.UInt32, mi.UInt32]:
    """How many are found, and the sum of their squared indices."""
    state, active = grid.begin(), mi.Bool(True) & (dr.arange(mi.UInt32, dr.width(p)) >= 0)
    count, total = dr.zeros(mi.UInt32, dr.width(p)), dr.zeros(mi.UInt32, dr.width(p))
    while active:
        state, index, found, active = grid.next(state, p, active)
        count += dr.select(found, 1, 0)
        total += dr.select(found, index * index, 0)
    return count, total


@pytest.mark.parametrize(("scale", "radius"), [(1.0, 0.2), (1e-3, 5e-5), (1e4, 3000.0), (1.0, 5.0)])
def test_the_grid_finds_each_point_within_the_radius_once(scale: float, radius: float) -> None:
    random = np.random.default_rng(1)
    points = scale * random.uniform(-1, 1, (300, 3)).astype(np.float32)
    places = scale * random.uniform(-1.1, 1.1, (64, 3)).astype(np.float32)
    grid = VertexGrid(Points(points), dr.opaque(mi.Float, radius))
    count, total = sum_of_found(grid, mi.Point3f(*(mi.Float(c.tolist()) for c in places.T)))
    distance = np.linalg.norm(places[:, None].astype(float) - points[None], axis=2)
    near = distance < radius
    # Where rounding does not decide
    clear = (abs(distance - radius) > 1e-5 * radius).all(axis=1)
    assert (count.numpy() == near.sum(axis=1))[clear].all() and near[clear].any()
    assert (total.numpy() == (near * np.arange(300) ** 2).sum(axis=1))[clear].all()
    assert VertexCounts(Points(points), dr.opaque(mi.Float, radius), None).count == 300


# ---- The radius ----


def test_the_radius_shrinks_as_its_source_says_whatever_the_size_of_a_pass() -> None:
    radius = MergingRadius(2.0, 0.75, pixels=100, footprint=0.1)
    found = [radius.next(100) for _ in range(16)]
    assert found[0] == 2 and found[15] == pytest.approx(2 * 16 ** (-1 / 8))
    # Four times as many light paths: a disk of a quarter of the area holds as many vertices
    assert MergingRadius(2.0, 0.75, pixels=100, footprint=0.1).next(400) == pytest.approx(1)
    constant = MergingRadius(2.0, 1.0, pixels=100, footprint=0.1)
    assert [constant.next(100) for _ in range(3)] == [2, 2, 2]


def test_a_batch_goes_on_with_the_radius_of_the_one_before() -> None:
    whole = MergingRadius(2.0, 0.75, pixels=100, footprint=0.1)
    found = [whole.next(200) for _ in range(6)]
    # 4 passes of 2 samples per pixel
    batch = MergingRadius(2.0, 0.75, pixels=100, footprint=0.1, before=8)
    assert [batch.next(200), batch.next(200)] == pytest.approx(found[4:])


def test_passes_of_any_size_have_the_same_largest_radius() -> None:
    def last(samples: int, before: int = 0) -> float:
        radius = MergingRadius(100.0, 0.75, pixels=100, footprint=0.1, before=before, widest=2.0)
        return [radius.next(100 * samples) for _ in range((64 - before) // samples)][-1]

    assert last(1) == last(16) == last(16, before=32) == pytest.approx(2 * 64 ** (-1 / 8))
    # A disk that holds enough is narrower
    assert MergingRadius(4.0, 0.75, pixels=100, footprint=0.1, widest=2.0).next(1600) == 1


def test_where_samples_of_a_pixel_see_one_point_passes_of_any_size_have_the_same_disk() -> None:
    radii = [MergingRadius(2.0, 0.75, pixels=8, footprint=0.0) for _ in range(2)]
    assert [radii[0].next(8) for _ in range(64)][-1] == pytest.approx(radii[1].next(8 * 64))
    assert radii[0].samples_per_vertex(1, 64) == 64


def test_the_batches_of_a_render_shrink_the_radius(
    batches_of_sixteen_samples, monkeypatch, tmp_path
) -> None:
    scene, found = mi.load_dict(stage(), optimize=False), []
    monkeypatch.setattr(
        MergingRadius, "next", lambda self, *counts: found.append(self.before) or self.first
    )
    mi.render(scene, integrator=sppm(checkpoint=str(tmp_path / "kept")), spp=48)
    assert sorted(set(found)) == [0, 16, 32]


@pytest.mark.parametrize("scale", [0.01, 100])
def test_the_radius_scales_with_the_scene(monkeypatch, scale: float) -> None:
    found = []
    measure = merging_parameters.suitable_radius
    monkeypatch.setattr(
        merging_parameters, "suitable_radius",
        lambda *arguments: found.append(measure(*arguments)) or found[-1],
    )  # fmt: skip
    for size in (1.0, scale):
        scene = mi.load_dict(stage(mi.ScalarTransform4f().scale(size)), optimize=False)
        mi.render(scene, integrator=sppm(), spp=1)
    assert found[1] == pytest.approx(scale * found[0], rel=0.3)


def test_the_footprint_is_the_width_of_a_pixel() -> None:
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100)}
    camera = {
        "type": "perspective", "fov": 10.0, "film": film(32, 32),
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    }  # fmt: skip
    scene = mi.load_dict({"type": "scene", "wall": wall, "sensor": camera})
    width = 2 * 4 * math.tan(math.radians(5)) / 32
    footprint = median_footprint(scene, scene.sensors()[0], SceneQuery())
    assert footprint == pytest.approx(width, rel=0.01)


def test_a_pass_of_n_groups_shrinks_the_radius_as_n_passes_do() -> None:
    apart, together = (MergingRadius(2.0, 0.75, pixels=100, footprint=0.1) for _ in range(2))
    found = [apart.next(100) for _ in range(9)]
    assert [together.next(100, 4) for _ in range(3)] == pytest.approx(found[::4])


def test_the_disks_of_a_coarse_film_are_wider_in_proportion_to_its_pixels() -> None:
    """They hold the same number of vertices, although only one light path per wide pixel exists."""
    radius = MergingRadius(first=0.1, decay=0.75, pixels=6400, footprint=0.01, widest=0.2)
    coarse = radius.of_coarse_film(4.0)
    assert coarse.pixels == 400
    shared = [x.samples_per_vertex(1, 8, 3) for x in (coarse, radius)]
    assert shared[0] == pytest.approx(shared[1])
    for _ in range(3):
        assert coarse.next(400) == pytest.approx(4 * radius.next(6400))


def test_samples_share_vertices_less_in_later_passes() -> None:
    radius = MergingRadius(first=0.1, decay=0.5, pixels=100, footprint=0.05)
    one, four = (radius.samples_per_vertex(1, 8, passes) for passes in (1, 4))
    assert 1 < four < one < 8
    wide = MergingRadius(first=1.0, decay=0.5, pixels=100, footprint=1e-3)
    assert wide.samples_per_vertex(1, 8, 4) == pytest.approx(8, rel=1e-3)


def test_samples_that_pass_through_a_ball_share_a_vertex_where_they_scatter() -> None:
    found = [
        MergingRadius(0.3, 0.75, pixels=100, footprint=1e-3, dimensions=3, free_path=free_path)
        .samples_per_vertex(1, 64)
        for free_path in (0.0, 1e-3, 1.0, 1e3)
    ]  # fmt: skip
    chord = 4 / 3 * 0.3 / 64 ** (1 / 3)
    assert found == pytest.approx([64, 64, 64 * (1 - math.exp(-chord)), 1], rel=1e-3)
