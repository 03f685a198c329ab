"""Densities of ``solid_angle_area`` are exact, near and far, and its weights are bounded."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.near_lights import (
    NAME,
    SAMPLES,
    SHAPES,
    UNLIKELY,
    lanes,
    light,
    seen_from,
    shape,
    turned,
)
from tests.support.stage import mesh, rgb
from tests.support.subtended import (
    CELLS,
    cell_of,
    cone_cells,
    disk_cells,
    parallelogram_cells,
    triangle_solid_angle,
)

pytestmark = pytest.mark.usefixtures("variant")


def assert_exact(
    scene: mi.Scene, points: np.ndarray, cells, cell, bound: float,
    normals: np.ndarray | None = None,
) -> None:  # fmt: skip
    """At each point, the weights of the samples in each cell of the light sum to its solid angle,
    densities are those with which samples were found, and weights are bounded.

    Parameters:
        cells: For a point, the solid angles of the cells.
        cell: For samples of a point (and their points on the light), their cells.
        bound: The largest weight, in units of the mean.
        normals: Of the surfaces that are lit.
    """
    it, sample = lanes(points)
    if normals is not None:
        it.n = mi.Normal3f(np.repeat(normals, SAMPLES, axis=0).T.astype(np.float32))
    emitter = scene.emitters()[0]
    ds, weight = emitter.sample_direction(it, sample)
    again = emitter.pdf_direction(it, ds)
    pdf, again = (np.array(x, dtype=np.float64).reshape(len(points), -1) for x in (ds.pdf, again))
    p = np.array(ds.p, dtype=np.float64).T.reshape(len(points), -1, 3)
    uv = np.array(ds.uv, dtype=np.float64).T.reshape(len(points), -1, 2)
    seen = pdf > 0
    assert np.isfinite(np.array(weight)).all() and np.isfinite(pdf).all()
    np.testing.assert_allclose(again[seen], pdf[seen], rtol=2e-3)
    weight = np.where(seen, 1 / np.where(seen, pdf, 1), 0)
    np.testing.assert_allclose(
        np.array(ds.emitter.eval_direction(it, ds)[0]).reshape(seen.shape)[seen], 1, rtol=1e-5
    )
    probabilities = []
    for k, point in enumerate(points):
        expected = cells(point)
        where = cell(point, p[k], uv[k])
        total, square = (
            np.bincount(where, w, minlength=len(expected)) for w in (weight[k], weight[k] ** 2)
        )
        mean = total / SAMPLES
        # Cells with few samples are one cell
        many = expected / expected.sum() > 20 / SAMPLES
        assert weight[k].max() <= bound * expected.sum(), f"{weight[k].max() / expected.sum()}"
        parts = [(mean[many], expected[many], square[many])]
        if not many.all():
            parts.append(tuple(x[~many].sum(keepdims=True) for x in (mean, expected, square)))
        difference, variance = (
            np.concatenate(x) for x in zip(*((m - e, s / SAMPLES**2 - m**2 / SAMPLES)
                                             for m, e, s in parts))
        )  # fmt: skip
        # Rounding: 1e-3 of a cell at most, where points are close to the light
        difference = np.maximum(np.abs(difference) - 1e-3 * expected.max(), 0)
        rare = variance <= 1e-12 * expected.sum() ** 2 / SAMPLES
        z_2 = np.where(rare, 0, difference**2 / np.where(rare, 1, variance))
        probabilities.append(stats.chi2.sf(z_2.sum(), len(z_2)))
    least = int(np.argmin(probabilities))
    assert probabilities[least] > UNLIKELY, f"p = {probabilities[least]} at point {least}"


# ---- Densities ----


@pytest.mark.parametrize("shear", [pytest.param(0.0, marks=pytest.mark.slow), 0.7])
def test_a_rectangle_is_sampled_by_solid_angle(shear: float) -> None:
    matrix = np.array((turned().scale([0.5, 0.3, 1])).matrix, dtype=np.float64)
    matrix = matrix @ np.array([[1, shear, 0, 0.2], [0, 1, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1]])
    to_world = mi.ScalarTransform4f(matrix)
    x, y, n, centre = (np.array(v) for v in matrix[:3].T)
    axes = np.stack([v / np.linalg.norm(v) for v in (x, np.cross(n, x), np.cross(x, y))], axis=1)
    assert_exact(
        light({"type": "rectangle", "to_world": to_world}), seen_from(centre, axes),
        lambda p: parallelogram_cells(centre - x - y - p, 2 * x, 2 * y),
        lambda p, on_light, uv: cell_of(uv), 1.001,
    )  # fmt: skip


def test_a_rectangle_is_sampled_by_projected_solid_angle() -> None:
    """Receivers that look at the light, and past it, so that the horizon cuts it."""
    to_world = turned().scale([0.5, 0.3, 1])
    x, y, n, centre = np.array(to_world.matrix, dtype=np.float64)[:3].T
    axes = np.stack([v / np.linalg.norm(v) for v in (x, y, n)], axis=1)
    tilts = np.radians([20, 95])
    points = np.repeat(seen_from(centre, axes), len(tilts), axis=0)
    tilt = np.tile(tilts, len(points) // len(tilts))[:, None]
    to_light = (centre - points) / np.linalg.norm(centre - points, axis=1, keepdims=True)
    across = np.cross(to_light, [0.48, 0.6, 0.64])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert_exact(
        light({"type": "rectangle", "to_world": to_world}, sampling="projected"), points,
        lambda p: parallelogram_cells(centre - x - y - p, 2 * x, 2 * y),
        lambda p, on_light, uv: cell_of(uv), 10.01,
        np.cos(tilt) * to_light + np.sin(tilt) * across,
    )  # fmt: skip


def test_projected_samples_of_an_even_receiver_have_almost_equal_weights() -> None:
    scene = light({"type": "rectangle"}, sampling="projected")
    it, sample = lanes(np.array([[0.5, 0.2, 0.4]]))
    it.n = mi.Normal3f(0.6, 0, -0.8)
    ds, weight = scene.emitters()[0].sample_direction(it, sample)
    received = np.array(weight)[0] * np.maximum(0, np.array(dr.dot(ds.d, it.n)))
    assert received.max() / received.mean() < 1.2


def test_a_triangle_is_sampled_by_solid_angle() -> None:
    corners = np.array([[0, 0, 0], [1, 0.2, 0], [0.3, 0.9, 0.0]]) @ np.array(
        turned().matrix, dtype=np.float64
    ).reshape(4, 4)[:3, :3].T
    corners = corners.astype(np.float32).astype(np.float64)
    a, x, y = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    n = np.cross(x, y)
    axes = np.stack([v / np.linalg.norm(v) for v in (x, np.cross(n, x), n)], axis=1)
    shape = mesh(corners.tolist(), [[0, 1, 2]], emitter={"type": NAME, "radiance": rgb(1.0)})
    scene = mi.load_dict({"type": "scene", "light": shape})

    def thirds(p: np.ndarray) -> np.ndarray:
        centre = corners.mean(axis=0)
        ends = [(corners[i], corners[(i + 1) % 3]) for i in range(3)]
        return np.array([triangle_solid_angle(b - p, c - p, centre - p) for b, c in ends])

    def third(p: np.ndarray, on_light: np.ndarray, uv: np.ndarray) -> np.ndarray:
        local = np.linalg.lstsq(np.stack([x, y], axis=1), (on_light - a).T, rcond=None)[0]
        weights = np.stack([1 - local.sum(axis=0), *local])
        # Next to the edge that is opposite the corner of the least weight
        return (np.argmin(weights, axis=0) + 1) % 3

    assert_exact(
        scene, seen_from(corners.mean(axis=0), axes), thirds, third, 1.001
    )


def test_a_disk_is_sampled_almost_by_solid_angle() -> None:
    matrix = np.array(turned().translate([1, 2, 3]).matrix, dtype=np.float64)
    centre, axes = matrix[:3, 3], matrix[:3, :3]

    def local(p: np.ndarray) -> np.ndarray:
        return (p - centre) @ axes

    def cell(p: np.ndarray, on_light: np.ndarray, uv: np.ndarray) -> np.ndarray:
        below, point = local(p), local(on_light)
        angle = np.arctan2(point[:, 1], point[:, 0]) - np.arctan2(below[1], below[0])
        return cell_of(np.stack([angle / (2 * np.pi) % 1, np.hypot(*point.T[:2])], axis=1))

    assert_exact(
        light({"type": "disk", "to_world": turned().translate([1, 2, 3])}),
        seen_from(centre, axes),
        lambda p: disk_cells(np.hypot(*local(p)[:2]), abs(local(p)[2])), cell, 1.21,
    )  # fmt: skip


def test_a_sphere_is_sampled_by_solid_angle() -> None:
    centre, axes = np.array([0.3, -0.2, 0.5]), np.eye(3)

    def cell(p: np.ndarray, on_light: np.ndarray, uv: np.ndarray) -> np.ndarray:
        d = on_light - p
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        axis = centre - p
        distance = np.linalg.norm(axis)
        axis /= distance
        across = d - (d @ axis)[:, None] * axis
        versine = (across**2).sum(-1) / (1 + d @ axis)
        depth = CELLS**2 * cone_cells(distance)[0] / (2 * np.pi)
        s = np.cross(axis, [0.6, 0, 0.8])
        angle = np.arctan2(across @ np.cross(axis, s), across @ s) / (2 * np.pi)
        return cell_of(np.stack([angle % 1, versine / depth], axis=1))

    assert_exact(
        light({"type": "sphere", "to_world": mi.ScalarTransform4f().translate(centre) @ turned()}),
        seen_from(centre, axes, gap=1),
        lambda p: cone_cells(np.linalg.norm(p - centre)), cell, 1.001,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["rectangle", "disk", "ellipse"])
def test_points_in_the_plane_of_a_light_and_behind_it_get_nothing(name: str) -> None:
    points = np.array([[0.3, 0.2, 0], [3, 0, 0], [0, 0, -1], [0.5, 5, -1e-3]])
    it, sample = lanes(points)
    scene = light(shape(name))
    emitter = scene.emitters()[0]
    ds, weight = emitter.sample_direction(it, sample)
    assert np.array(weight).max() == 0 and not np.isnan(np.array(ds.pdf)).any()
    behind = np.array(it.p)[2] < 0
    assert np.array(emitter.pdf_direction(it, ds))[behind].max() == 0


@pytest.mark.parametrize("name", SHAPES)
def test_the_map_of_the_square_is_continuous(name: str) -> None:
    if name == "cube":
        pytest.skip("its triangles are separate")
    n = 256
    y, x = np.divmod(np.arange(n * n), n)
    it = dr.zeros(mi.Interaction3f, n * n)
    it.p = mi.Point3f(1.4, 0.5, 1.5)
    sample = mi.Point2f(((x + 0.5) / n).astype(np.float32), ((y + 0.5) / n).astype(np.float32))
    scene = light(shape(name))
    p = np.array(scene.emitters()[0].sample_direction(it, sample)[0].p).reshape(3, n, n)
    steps = [np.linalg.norm(np.diff(p, axis=axis), axis=0).max() for axis in (1, 2)]
    # Concentric squares are not smooth at their diagonals and in the centre
    assert max(steps) < 0.25


def test_rays_leave_a_turned_sphere_outwards_and_carry_its_power() -> None:
    transform = mi.ScalarTransform4f().translate([1, 0, 0]) @ turned().scale(2)
    scene = light(shape("sphere", transform), rgb(3.0))
    emitter = scene.emitters()[0]
    _, sample = lanes(np.zeros((1, 3)))
    ray, weight = emitter.sample_ray(0, 0.5, sample, mi.Point2f(sample.y, sample.x))
    outwards = np.array(ray.o).T - [1, 0, 0]
    assert (outwards * np.array(ray.d).T).sum(axis=1).min() > 0
    np.testing.assert_allclose(np.array(weight), np.pi * 4 * np.pi * 4 * 3, rtol=1e-5)


@pytest.mark.parametrize("name", SHAPES)
def test_positions_are_uniform_on_the_surface(name: str) -> None:
    scene = light(shape(name, turned()))
    emitter = scene.emitters()[0]
    _, sample = lanes(np.zeros((1, 3)))
    ps, weight = emitter.sample_position(0, sample)
    np.testing.assert_allclose(np.array(weight), np.array(emitter.get_shape().surface_area())[0],
                               rtol=1e-5)  # fmt: skip
    np.testing.assert_allclose(np.array(emitter.pdf_position(ps)), 1 / np.array(weight), rtol=1e-5)
    assert np.abs(np.array(ps.p).mean(axis=1)).max() < 0.05
