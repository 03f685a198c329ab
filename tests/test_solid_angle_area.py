"""``solid_angle_area``: densities are exact near and far, weights are bounded, and images have the
mean of ``area``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from stage import bitmap, diffuse, film, mesh, rgb, sensor, stage
from statistical import assert_same_quarters, batches, one_thread
from subtended import (
    CELLS,
    cell_of,
    cone_cells,
    disk_cells,
    parallelogram_cells,
    triangle_solid_angle,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("variant")

NAME = "solid_angle_area"

#: In units of the size of the light.
DISTANCES = [1e-3, 1e-2, 0.1, 0.5, 1, 10, 1e2, 1e4]

#: Where points lie: along the normal; obliquely; almost in the plane of the light.
WAYS = [(0.1, 0.05, 1.0), (0.6, -0.5, 0.6), (0.9, 0.4, 2e-3)]

SAMPLES = 1 << 14

#: Less probable than this is an error.
UNLIKELY = 1e-6


def light(shape: dict[str, Any], radiance: Any = None, **parameters: Any) -> mi.Scene:
    """A scene of one light, which must be kept: an emitter does not keep its shape."""
    emitter = {"type": NAME, "radiance": radiance or rgb(1.0), **parameters}
    return mi.load_dict({"type": "scene", "light": {**shape, "emitter": emitter}})


def turned() -> mi.ScalarTransform4f:
    T = mi.ScalarTransform4f
    return T().rotate([0.6, 0.8, 0], 130).rotate([0, 0, 1], 20)


def lanes(points: np.ndarray, seed: int = 1) -> tuple[mi.Interaction3f, mi.Point2f]:
    """``SAMPLES`` lanes for each point, with random numbers."""
    it = dr.zeros(mi.Interaction3f, SAMPLES * len(points))
    it.p = mi.Point3f(np.repeat(points, SAMPLES, axis=0).T.astype(np.float32))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, SAMPLES * len(points))
    return it, sampler.next_2d()


def seen_from(centre: np.ndarray, axes: np.ndarray, gap: float = 0.0) -> np.ndarray:
    """Points around a light of size 1, rounded to floats."""
    points = [
        centre + axes @ (np.array(way) * distance + gap * np.array(way) / np.linalg.norm(way))
        for distance in DISTANCES for way in WAYS
    ]  # fmt: skip
    return np.array(points).astype(np.float32).astype(np.float64)


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
    place = DISTANCES[least // len(WAYS)], WAYS[least % len(WAYS)]
    assert probabilities[least] > UNLIKELY, f"p = {probabilities[least]} at {place}"


# ---- Densities ----


@pytest.mark.parametrize("shear", [0.0, 0.7], ids=["rectangle", "parallelogram"])
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


@pytest.mark.parametrize("tilt", [0, 50, 100, 180])
def test_a_rectangle_is_sampled_by_projected_solid_angle(tilt: int) -> None:
    """Receivers that look at the light, past it so that the horizon cuts it, and away from it."""
    to_world = turned().scale([0.5, 0.3, 1])
    x, y, n, centre = np.array(to_world.matrix, dtype=np.float64)[:3].T
    axes = np.stack([v / np.linalg.norm(v) for v in (x, y, n)], axis=1)
    points = seen_from(centre, axes)
    to_light = (centre - points) / np.linalg.norm(centre - points, axis=1, keepdims=True)
    across = np.cross(to_light, [0.48, 0.6, 0.64])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.cos(np.radians(tilt)) * to_light + np.sin(np.radians(tilt)) * across
    assert_exact(
        light({"type": "rectangle", "to_world": to_world}, sampling="projected"), points,
        lambda p: parallelogram_cells(centre - x - y - p, 2 * x, 2 * y),
        lambda p, on_light, uv: cell_of(uv), 10.01, normals,
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


SHAPES: dict[str, dict[str, Any]] = {
    "rectangle": {"type": "rectangle"},
    "disk": {"type": "disk"},
    "ellipse": {"type": "disk", "to_world": "squeezed"},
    "sphere": {"type": "sphere"},
    "cube": {"type": "cube"},
}


def shape(name: str, transform: mi.ScalarTransform4f | None = None, **changes: Any) -> dict:
    base = dict(SHAPES[name])
    transform = transform or mi.ScalarTransform4f()
    if base.pop("to_world", None):
        transform = transform @ mi.ScalarTransform4f().scale([1, 0.4, 1])
    return {**base, "to_world": transform, **changes}


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


# ---- Images ----


def lit(emitter: str, name: str, transform: mi.ScalarTransform4f, radiance: Any, **changes: Any):
    """A stage under a light that nearly touches the block."""
    kind, _, sampling = emitter.partition(":")
    lamp = {**shape(name, transform, **changes), "bsdf": diffuse(0.0),
            "emitter": {"type": kind, "radiance": radiance}}  # fmt: skip
    if sampling:
        lamp["emitter"]["sampling"] = sampling
    return mi.load_dict(stage(light=lamp, camera=sensor(film=film(8, 8))), optimize=False)


def down(*scale: float) -> mi.ScalarTransform4f:
    T = mi.ScalarTransform4f
    return T().translate([0.2, 0.1, 1.2]).rotate([1, 0, 0], 165).rotate([0, 0, 1], 30).scale(scale)


def assert_like_area(
    integrator: dict[str, Any], name: str, transform: mi.ScalarTransform4f, radiance: Any = None,
    spp: int = 256, seeds: int = 8, error: float = 0.02, kind: str = NAME, **changes: Any,
) -> None:  # fmt: skip
    images = [
        batches(
            lit(emitter, name, transform, radiance or rgb(2, 1, 0.5), **changes),
            mi.load_dict(integrator), spp, range(first, first + seeds),
        )
        for emitter, first in ((kind, 1), ("area", 1001))
    ]  # fmt: skip
    assert_same_quarters(*images, precision=error)


PATH = {"type": "path", "max_depth": 3, "hide_emitters": True}


@pytest.mark.parametrize("name", [
    "rectangle", *(pytest.param(n, marks=pytest.mark.slow) for n in SHAPES if n != "rectangle")
])  # fmt: skip
def test_images_have_the_mean_of_area(name: str) -> None:
    assert_like_area(PATH, name, down(0.5, 0.2, 0.3) if name != "sphere" else down(0.3, 0.3, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("integrator, name", [
    ("neepp", "disk"), ("bdpt", "cube"), ("light_tracer", "rectangle"), ("ptracer", "cube"),
])  # fmt: skip
def test_integrators_have_the_mean_of_area(integrator: str, name: str) -> None:
    assert_like_area({"type": integrator, "max_depth": 3}, name, down(0.3, 0.3, 0.1), error=0.05)


@pytest.mark.parametrize("integrator", [
    "path", *(pytest.param(n, marks=pytest.mark.slow) for n in ("neepp", "bdpt"))
])  # fmt: skip
def test_projected_samples_have_the_mean_of_area(integrator: str) -> None:
    """The light stands upright: the floor's horizon and the wall's cut it."""
    T = mi.ScalarTransform4f
    upright = T().translate([-0.3, 0.6, 0.1]).rotate([1, 0, 0], 90).scale([0.5, 0.3, 1])
    method = {"type": integrator, "max_depth": 3, "hide_emitters": True}
    assert_like_area(method, "rectangle", upright, error=0.05, kind=f"{NAME}:projected")


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_other_variants_have_the_mean_of_area(variant: str) -> None:
    assert_like_area(PATH, "rectangle", down(0.5, 0.2, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rectangle", "disk", "cube"])
@pytest.mark.parametrize("flip", [False, True], ids=["", "flipped"])
def test_mirrored_and_sheared_lights_have_the_mean_of_area(name: str, flip: bool) -> None:
    matrix = np.array(down(0.4, 0.3, 0.2).matrix, dtype=np.float64)
    shear = np.array([[-1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    transform = mi.ScalarTransform4f(matrix @ shear)
    if flip and name != "cube":
        transform = transform @ mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    # ``area`` errs on flipped cubes: seen from inside they shine on themselves only
    assert_like_area(PATH, name, transform, flip_normals=flip and name != "cube")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rectangle", "disk", "sphere"])
def test_textures_of_radiance_are_seen(name: str) -> None:
    texels = np.random.default_rng(3).uniform(0.2, 2, size=(4, 4, 3))
    radiance = {"type": "bitmap", "bitmap": bitmap(texels), "raw": True, "filter_type": "nearest"}
    # ``area`` errs on textured spheres that are turned
    upright = mi.ScalarTransform4f().translate([0.2, 0.1, 1.2]).scale(0.3)
    assert_like_area(PATH, name, upright if name == "sphere" else down(0.4, 0.4, 0.4), radiance)


@pytest.mark.parametrize("name", ["cube", "sphere"])
def test_a_furnace_lit_from_inside_is_exact(name: str) -> None:
    wall = {**SHAPES[name], "flip_normals": True, "bsdf": diffuse(0.5),
            "emitter": {"type": NAME, "radiance": rgb(1.0)}}  # fmt: skip
    camera = sensor(to_world=mi.ScalarTransform4f().look_at([0.2, 0, 0], [1, 0.4, 0.3], [0, 0, 1]))
    scene = mi.load_dict({"type": "scene", "wall": wall, "sensor": camera})
    images = batches(scene, mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 99}), 256,
                     range(4))  # fmt: skip
    exact = 1 + 0.5 + 0.25 + 0.125
    np.testing.assert_allclose(images.mean(), exact, rtol=1e-3)


def test_the_same_seed_gives_the_same_image() -> None:
    scene = lit(NAME, "rectangle", down(0.5, 0.2, 1), rgb(1.0))
    with one_thread():
        first, second = (
            np.array(mi.render(scene, integrator=mi.load_dict(PATH), spp=8, seed=5))
            for _ in range(2)
        )
    assert (first == second).all()


def test_radiance_and_shape_can_be_changed() -> None:
    scene = lit(NAME, "rectangle", down(0.5, 0.2, 1), rgb(1.0))
    integrator = mi.load_dict(PATH)
    before = np.array(mi.render(scene, integrator=integrator, spp=16, seed=1))
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] = 2.0 * mi.Color3f(1.0)
    parameters.update()
    after = np.array(mi.render(scene, integrator=integrator, spp=16, seed=1))
    np.testing.assert_allclose(after, 2 * before, rtol=1e-3, atol=1e-5)
    parameters["light.to_world"] = mi.Transform4f(down(0.1, 0.1, 1))
    parameters.update()
    images = batches(scene, integrator, 256, range(1, 7))
    small = lit(NAME, "rectangle", down(0.1, 0.1, 1), rgb(2.0))
    assert_same_quarters(images, batches(small, integrator, 256, range(1001, 1007)), 0.05)


# ---- Errors ----


def test_shapes_whose_solid_angle_is_unknown_are_refused() -> None:
    scene = light({"type": "cylinder"})
    with pytest.raises(RuntimeError, match='solid angle of a shape "Cylinder"'):
        scene.emitters()[0].sample_direction(*lanes(np.ones((1, 3))))


def test_only_rectangles_are_sampled_by_projected_solid_angle() -> None:
    scene = light({"type": "disk"}, sampling="projected")
    with pytest.raises(RuntimeError, match='"projected" needs a rectangle, found "Disk"'):
        scene.emitters()[0].sample_direction(*lanes(np.ones((1, 3))))
    with pytest.raises(RuntimeError, match='sampling must be "solid_angle" or "projected"'):
        light({"type": "rectangle"}, sampling="cosine")


def test_a_light_without_a_shape_is_refused() -> None:
    with pytest.raises(RuntimeError, match="needs a shape"):
        mi.load_dict({"type": NAME}).sample_direction(*lanes(np.ones((1, 3))))


@pytest.mark.parametrize("name", ["to_world", "raidance"])
def test_wrong_parameters_are_refused(name: str) -> None:
    value = mi.ScalarTransform4f() if name == "to_world" else 1.0
    with pytest.raises(RuntimeError, match=name):
        mi.load_dict({"type": "rectangle", "emitter": {"type": NAME, name: value}})
