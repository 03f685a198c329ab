"""Irradiance caching: gradients against analytic ones, interpolation, placement, its images against
``path``, its file, and what it refuses. (``tests/claims`` has the tests that all techniques
share.)"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.caches.choice import chosen
from mitsuba_ext.estimators.caches.hemisphere import Strata, irradiance, without_outliers
from mitsuba_ext.estimators.caches.record_grid import RecordGrid
from mitsuba_ext.estimators.caches.records import Places, Records
from tests.support.stage import film, lookat, sensor, stage
from tests.support.statistical import assert_same_mean, batches, load

pytestmark = pytest.mark.usefixtures("variant")


def make(max_depth: int = 6, **parameters: Any) -> mi.Integrator:
    """An integrator that makes all records that the view needs, even with few samples."""
    parameters = {"max_depth": max_depth, "effort": 1e5, **parameters}
    return mi.load_dict({"type": "irradiance_cache", **parameters})


def things() -> dict[str, Any]:
    """A ball of glass, a mirror, a rough one, and a ball with a diffuse and a delta lobe."""
    T = mi.ScalarTransform4f
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    plastic = {"type": "sphere", "center": [-0.8, 0.2, 0.3], "radius": 0.3,
               "bsdf": {"type": "roughplastic"}}  # fmt: skip
    rough = {"type": "sphere", "center": [0.9, 0.2, 0.3], "radius": 0.3,
             "bsdf": {"type": "roughconductor", "alpha": 0.2}}  # fmt: skip
    mirror = {"type": "rectangle", "bsdf": {"type": "conductor"},
              "to_world": T().translate([0, 1.4, 0.5]).rotate([1, 0, 0], 90)}  # fmt: skip
    return {"ball": ball, "plastic": plastic, "rough": rough, "mirror": mirror}


# ---- Irradiance and its gradients ----


def directions(strata: Strata) -> np.ndarray:
    """The middle of each stratum: [sector, ring, 3]."""
    φ = 2 * np.pi * (np.arange(strata.sectors)[:, None] + 0.5) / strata.sectors
    sine = np.sqrt((np.arange(strata.rings)[None] + 0.5) / strata.rings)
    z = np.sqrt(1 - sine**2) + 0 * φ
    return np.stack([sine * np.cos(φ), sine * np.sin(φ), z], axis=-1)


def test_irradiance_in_a_furnace_is_exact_and_has_no_gradients() -> None:
    strata = Strata.about(200)
    distance = np.random.default_rng(1).uniform(1, 5, (1, strata.sectors, strata.rings))
    found = irradiance(strata, np.ones((*distance.shape, 3)), distance, np.ones(1))
    assert found.value == pytest.approx(np.full((1, 3), np.pi))
    assert np.abs(found.rotation).max() < 1e-12 and np.abs(found.translation).max() < 1e-12
    assert found.distance == pytest.approx([1 / (1 / distance).mean()])


def of_rectangle(p: np.ndarray, n: np.ndarray, corners: np.ndarray) -> float:
    """The irradiance from a polygon of radiance 1 above the horizon (Lambert)."""
    rays = corners - p
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(rays, np.roll(rays, -1, axis=0)):
        normal = np.cross(a, b)
        angle = np.arctan2(np.linalg.norm(normal), a @ b)
        total += angle * (normal / np.linalg.norm(normal)) @ n
    return abs(total) / 2


def test_gradients_under_a_bright_rectangle_are_the_analytic_ones() -> None:
    corners = np.array([[0.2, -0.4, 1], [1.4, -0.4, 1], [1.4, 0.7, 1], [0.2, 0.7, 1]])
    strata = Strata(150, 471)
    d = directions(strata)
    hit = d[..., :2] / d[..., 2:]
    inside = ((hit > corners[0, :2]) & (hit < corners[2, :2])).all(axis=-1)
    distance = np.where(inside, 1 / d[..., 2], np.inf)
    found = irradiance(strata, inside[None, ..., None] * 1.0, distance[None], np.full(1, 1e-3))
    origin, n, h = np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-4
    E = of_rectangle(origin, n, corners)
    assert found.value[0, 0] == pytest.approx(E, rel=0.01)
    gradient = [
        (of_rectangle(h * axis, n, corners) - of_rectangle(-h * axis, n, corners)) / (2 * h)
        for axis in np.eye(3)[:2]
    ]
    assert found.translation[0, 0, :2] == pytest.approx(gradient, rel=0.03, abs=0.01 * E)
    # The normal turns about an axis: n' = n + h axis × n, and n × n' = h axis
    turned = [
        (of_rectangle(origin, n + h * np.cross(axis, n), corners) - E) / h for axis in np.eye(3)[:2]
    ]
    assert found.rotation[0, 0, :2] == pytest.approx(turned, rel=0.03, abs=0.01 * E)


def test_no_path_holds_more_than_its_share_of_a_record() -> None:
    radiance = np.ones((2, 20, 10, 1))
    radiance[1, 3, 4] = 1e6
    cut = without_outliers(radiance, 0.05)
    assert (cut[0] == 1).all()
    assert cut[1].max() < 0.06 * cut[1].sum() and (cut[1] >= 1).all()
    assert without_outliers(radiance, 1.0) is radiance


# ---- Interpolation and placement ----


def records(p: np.ndarray, reach: np.ndarray, slope: np.ndarray) -> Records:
    """Records on the plane z = 0 of the field 1 + slope · x."""
    channels, count = len(mi.Spectrum()), len(p)
    made = Records.none(channels)
    made.p, made.n = p.astype(np.float32), np.tile([0, 0, 1], (count, 1)).astype(np.float32)
    made.irradiance = np.repeat(1 + p @ slope, channels).reshape(count, channels)
    made.translation = np.tile(slope, (count, channels, 1))
    made.rotation = np.zeros((count, channels, 3))
    made.reach, made.least, made.deviation = reach, 0 * reach, 0 * reach
    return made


def on_plane(count: int, seed: int) -> np.ndarray:
    xy = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    return np.column_stack([xy, np.zeros(count)])


def test_a_linear_field_is_interpolated_exactly() -> None:
    slope = np.array([0.3, -0.2, 0.0])
    reach = np.random.default_rng(3).uniform(0.3, 9.0, 200)
    kept, x = records(on_plane(200, 1), reach, slope), on_plane(5000, 2)
    E, found = RecordGrid(kept, 0.2).interpolated(
        mi.Point3f(x.T), mi.Normal3f(0, 0, 1), mi.Bool(True)
    )
    found = found.numpy()
    # All records, without a grid
    distance = np.linalg.norm(x[:, None] - kept.p, axis=2) / (0.2 * reach)
    sure = np.abs(distance - 1).min(axis=1) > 1e-3
    assert (found == (distance < 1).any(axis=1))[sure].all() and 0.5 < found.mean() <= 1
    assert np.array(E)[0][found] == pytest.approx((1 + x @ slope)[found], rel=1e-5)


def test_the_weights_agree_with_a_search_through_all_records() -> None:
    reach = np.random.default_rng(4).uniform(0.2, 20.0, 300) ** 0.7
    kept, x = records(on_plane(300, 5), reach, np.zeros(3)), on_plane(2000, 6)
    kept.irradiance = np.random.default_rng(7).uniform(0, 1, kept.irradiance.shape)
    E, _ = RecordGrid(kept, 0.2).interpolated(
        mi.Point3f(x.T), mi.Normal3f(0, 0, 1), mi.Bool(True)
    )
    weight = np.maximum(1 - np.linalg.norm(x[:, None] - kept.p, axis=2) / (0.2 * reach), 0)
    sure = weight.sum(axis=1) > 1e-3
    expected = (weight @ kept.irradiance)[:, 0] / np.maximum(weight.sum(axis=1), 1e-9)
    assert np.array(E)[0][sure] == pytest.approx(expected[sure], rel=1e-3)


def test_the_other_side_of_a_wall_has_records_of_its_own() -> None:
    kept = records(np.zeros((1, 3)), np.ones(1), np.zeros(3))
    for z, found in ((1, True), (-1, False)):
        n, grid = mi.Normal3f(0, 0, z), RecordGrid(kept, 0.2)
        assert grid.interpolated(mi.Point3f(0), n, mi.Bool(True))[1][0] == found


def test_chosen_places_are_apart_and_leave_no_gap() -> None:
    p, n = on_plane(3000, 8), np.tile([0.0, 0, 1], (3000, 1))
    places = Places(p, n, n, np.full(3000, 0.01))
    index = chosen(places, Records.none(3), 0.2, (5, 50), 1)
    apart = np.linalg.norm(p[index][:, None] - p[index], axis=2) + 9 * np.eye(len(index))
    assert apart.min() >= 0.07  # 0.7 of the radius 0.2 · 50 · 0.01
    near = np.linalg.norm(p[:, None] - p[index], axis=2).min(axis=1)
    assert near.max() < 0.15
    assert (chosen(places, Records.none(3), 0.2, (5, 50), 1) == index).all()


def test_a_record_reaches_no_farther_than_its_neighbours() -> None:
    reach = np.full(200, 5.0)
    reach[0] = 0.1
    kept = records(on_plane(200, 9), reach, np.zeros(3)).adapted(0.2)
    distance = np.linalg.norm(kept.p - kept.p[0], axis=1)
    near = distance < 0.3
    assert (kept.reach[near] <= 0.1 + 3 * distance[near]).all()


def test_a_record_is_not_valid_where_it_mispredicts_another() -> None:
    kept = records(np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.ones(2), np.zeros(3))
    kept.irradiance[1] = 5
    assert (0.2 * kept.adapted(0.2).reach < 0.1).all()


# ---- Images ----


def test_the_mean_agrees_with_path() -> None:
    """Direct light, glossy and specular parts, and cached light add up, with nothing twice."""
    scene = mi.load_dict(stage(**things()), optimize=False)
    # On a film of 16x16, a pixel is as wide as details are
    cache = make(max_share=1.0, min_spacing=0.25, max_spacing=3.0, gather_samples=256)
    found = batches(scene, cache, 64, range(1, 9))
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 6}), 512, range(101, 109))
    assert_same_mean(found, expected, 0.05, tolerance=0.0)


@pytest.mark.parametrize("max_depth", [1, 2])
def test_direct_light_agrees_with_path(max_depth: int) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    images = [
        np.array(mi.render(scene, integrator=integrator, spp=8, seed=3))
        for integrator in (make(max_depth), mi.load_dict({"type": "path", "max_depth": max_depth}))
    ]
    assert images[0] == pytest.approx(images[1], rel=1e-4, abs=1e-6)


def test_irradiance_in_a_furnace_is_known() -> None:
    """In a closed box of one emission and one albedo, all records are equal."""
    scene = load("furnace_box", width=16, height=16)
    cache, path = make(4, max_share=1.0), mi.load_dict({"type": "path", "max_depth": 4})
    found = batches(scene, cache, 16, range(1, 5)).mean()
    assert found == pytest.approx(batches(scene, path, 256, [9]).mean(), rel=0.01)


def test_every_pixel_is_covered_after_the_rounds() -> None:
    scene = mi.load_dict(stage(camera=sensor(film=film(64, 64))), optimize=False)
    cache = make(3, gather_samples=64)
    mi.render(scene, integrator=cache, spp=1)
    last = cache.rounds[-1]
    assert last.asked > 2000 and last.uncovered < 0.01 * last.asked
    assert "records of irradiance" in cache.statistics.learned
    assert "biased" in cache.statistics.learned


def test_a_render_of_few_samples_makes_few_records() -> None:
    scene = mi.load_dict(stage(camera=sensor(film=film(32, 32))), optimize=False)
    cache = make(3, gather_samples=64, effort=2.0)
    mi.render(scene, integrator=cache, spp=1)
    assert 0 < len(cache.records) <= 2 * 32 * 32 / 60


@pytest.mark.slow
def test_the_error_falls_with_the_accuracy() -> None:
    scene = mi.load_dict(stage(camera=sensor(film=film(32, 32))), optimize=False)
    path = mi.load_dict({"type": "path", "max_depth": 4})
    expected = batches(scene, path, 2048, range(101, 105)).mean(axis=0)
    errors = []
    for accuracy in (1.0, 0.4, 0.1):
        cache = make(4, accuracy=accuracy, min_spacing=0.3, gather_samples=2048, max_share=1.0)
        image = batches(scene, cache, 512, range(1, 4)).mean(axis=0)
        errors.append(np.abs(image - expected).mean() / expected.mean())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.02


def test_a_second_frame_needs_few_new_records(tmp_path: Path) -> None:
    cache = make(4, gather_samples=64, cache_file=str(tmp_path / "cache.npz"))
    made = []
    for x in (0.0, 0.1):
        view = lookat([x, -4, 1.2], [x, 0, 0.6], [0, 0, 1])
        camera = sensor(to_world=view, film=film(48, 48))
        mi.render(mi.load_dict(stage(camera=camera), optimize=False), integrator=cache, spp=1)
        made.append(sum(r.made for r in cache.rounds))
    assert made[1] < 0.3 * made[0] and len(cache.records) == sum(made)


# ---- Errors ----


def test_a_file_of_another_scene_is_refused(tmp_path: Path) -> None:
    cache = make(4, gather_samples=16, cache_file=str(tmp_path / "cache.npz"))
    mi.render(mi.load_dict(stage(), optimize=False), integrator=cache, spp=1)
    with pytest.raises((ValueError, RuntimeError), match="belongs to another scene"):
        cache.render(mi.load_dict(stage(**things()), optimize=False), spp=1)
    other = make(5, gather_samples=16, cache_file=str(tmp_path / "cache.npz"))
    with pytest.raises((ValueError, RuntimeError), match="other parameters"):
        other.render(mi.load_dict(stage(), optimize=False), spp=1)


def test_spacings_are_in_order() -> None:
    with pytest.raises((ValueError, RuntimeError), match='"min_spacing" is 9'):
        make(min_spacing=9.0, max_spacing=4.0)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_variants_are_refused(variant: str) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match="the variant is spectral"):
        make().render(scene, spp=1)


def test_moving_shapes_are_refused() -> None:
    ball = {"type": "moving", "translate": [0, 0, 1], "in": {"type": "sphere", "radius": 0.1}}
    scene = mi.load_dict(stage(ball=ball), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match="shapes or lights move"):
        make().render(scene, spp=1)


def test_single_samples_are_refused() -> None:
    scene = mi.load_dict(stage(), optimize=False)
    with pytest.raises(NotImplementedError, match="cannot be nested"):
        make().sample(scene, mi.load_dict({"type": "independent"}), mi.RayDifferential3f())
