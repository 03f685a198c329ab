"""Distances in media: the warp of their numbers, what it knows of light, and when it is used."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.guided_directions.guided_distances import SHARE, GuidedDistances
from mitsuba_ext.techniques.guided_directions.scattered_light import (
    RESOLUTION,
    Box,
    DirectLight,
    ScatteredLight,
)
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.fogs import LIGHTS, cube, fog, homogeneous
from tests.support.statistical import sidak, some

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 17

#: A lamp lights the fog between these distances along the ray.
_NEAR, _FAR = 0.5, 0.5625


def _distances(surface: float, dark: bool = False) -> GuidedDistances:
    """In a box of edge 2 with a thin bright slab; a ``surface`` of this radiance ends flights."""
    box = Box(np.zeros(3), np.full(3, 2.0))
    z = (np.arange(RESOLUTION**3) // RESOLUTION**2 + 0.5) * 2 / RESOLUTION
    values = np.where((z > _NEAR) & (z < _FAR), 40, 0.5).astype(np.float32)
    light = ScatteredLight(box, mi.Float(0 * values if dark else values), mi.Float(0.0))
    regions = SimpleNamespace(label=lambda si, pixel, active: mi.UInt32(0))
    return GuidedDistances(light, regions, mi.Float([surface]), 3)


def _flights(distances: GuidedDistances, σ: float, end: float, albedo: float = 0.8):
    """The distances, whether paths scatter there, and the weights of flights along the z axis."""
    u = np.random.default_rng(5).random(LANES, dtype=np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.t = mi.Float(end)
    ray = mi.Ray3f(mi.Point3f(1, 1, 1e-3), mi.Vector3f(0, 0, 1))
    arguments = (mi.Float(σ), mi.Float(σ * albedo), mi.Bool(True))
    t, scatters, weight = distances.warp(mi.Float(u), ray, si, *arguments)
    return t.numpy(), scatters.numpy(), weight.numpy() * np.ones(LANES)


CASES = {
    "thin": (0.1, 1.5, 2.0), "thick": (5.0, 1.5, 2.0), "dense": (1e4, 1.5, 2.0),
    "bright_surface": (0.5, 1.0, 100.0), "black_surface": (0.5, 1.0, 0.0),
    "unknown_surface": (0.5, 1.0, -1.0), "no_surface": (0.5, np.inf, -1.0),
    "black_medium": (0.5, 1.0, -1.0), "black_medium_and_surface": (0.5, 1.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", some("bright_surface", "no_surface", "black_medium", of=list(CASES))
)
def test_weighted_distances_have_the_density_of_transmittance(name: str) -> None:
    """In each of 64 intervals, and on the surface."""
    σ, end, surface = CASES[name]
    albedo = 0.0 if name.startswith("black_medium") else 0.8
    t, scatters, weight = _flights(_distances(surface), σ, end, albedo)
    assert np.isfinite(t[scatters]).all() and (t[scatters] >= 0).all() and (t <= end).all()
    assert weight.max() <= 1 / (1 - SHARE) + 1e-4 and weight.min() > 0
    through = np.exp(-σ * end)
    # By the uniform number that leads to a distance
    number = -np.expm1(-σ * t[scatters].astype(np.float64))
    collides = 1 - through
    bins = 64, (0, collides * (1 + 1e-5))
    found, square = (
        np.histogram(number, *bins, weights=weight[scatters] ** power)[0] for power in (1, 2)
    )
    z = (found - LANES * collides / 64) / np.sqrt(square)
    assert np.abs(z).max() < sidak(64)
    missed = weight[~scatters]
    assert abs(missed.sum() - LANES * through) < 4 * max(1, np.linalg.norm(missed))


def test_paths_scatter_where_light_arrives() -> None:
    """The slab, two voxels thick, has 0.006 of the numbers; half of all numbers are warped."""
    t, scatters, _ = _flights(_distances(0.1), 0.1, 1.5)
    slab = (scatters & (t > _NEAR) & (t < _FAR)).mean()
    assert 0.2 < slab < 0.5
    # Most of the light comes from the surface
    _, scatters, _ = _flights(_distances(1e3), 0.1, 1.5)
    assert scatters.mean() < 0.6 * (1 - np.exp(-0.15))
    # A black medium is passed
    _, scatters, _ = _flights(_distances(0.1), 0.5, 1.5, albedo=0.0)
    assert scatters.mean() == pytest.approx((1 - SHARE) * (1 - np.exp(-0.75)), abs=5e-3)


def test_a_cube_has_the_root_mean_square_of_its_voxels() -> None:
    values = np.random.default_rng(3).random(RESOLUTION**3, dtype=np.float32)
    box = Box(np.zeros(3), np.full(3, 2.0))
    light = ScatteredLight(box, mi.Float(values), mi.Float(7.0))
    p, _ = box.in_voxels(mi.Point3f(1.01, 0.3, 1.7), mi.Vector3f(0))
    x, y, z = 32, 9, 54
    grid = values.reshape([RESOLUTION] * 3)
    for size in (0.0, 0.7, 1.5):
        assert light.around(p, mi.Float(size))[0] == grid[z, y, x]
    for size, edge in ((2.0, 2), (11.0, 8)):
        weights = np.repeat([1, 3, 3, 1], edge // 2) / (4 * edge)
        i, j, k = (slice(c // edge * edge - edge // 2, c // edge * edge + 3 * edge // 2)
                   for c in (x, y, z))  # fmt: skip
        squares = np.square(grid[k, j, i], dtype=np.float64)
        expected = np.einsum("kji,k,j,i", squares, weights, weights, weights) ** 0.5
        assert light.around(p, mi.Float(size))[0] == pytest.approx(expected, rel=1e-5), size
    outside = mi.Point3f([-1e-3, 70, 3], [3, 3, -1e9], 3)
    np.testing.assert_array_equal(light.around(outside, mi.Float(1)).numpy(), 7)


def test_paths_do_not_scatter_behind_the_far_clip_plane() -> None:
    """No surface is met before it."""
    u = np.random.default_rng(5).random(LANES, dtype=np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.t = mi.Float(np.inf)
    ray = mi.Ray3f(mi.Point3f(1, 1, 1e-3), mi.Vector3f(0, 0, 1))
    ray.maxt = mi.Float(1.0)
    arguments = (mi.Float(0.5), mi.Float(0.4), mi.Bool(True))
    found = _distances(100.0).warp(mi.Float(u), ray, si, *arguments)
    t, scatters, weight = (x.numpy() for x in found)
    assert (t[scatters] <= 1).all()
    missed = weight[~scatters]
    assert abs(missed.sum() - LANES * np.exp(-0.5)) < 4 * np.linalg.norm(missed)


@pytest.mark.parametrize("σ, dark, surface", [(0.5, True, -1.0), (0.5, True, 0.0), (0.0, False, 1)])
def test_where_nothing_is_known_all_weights_are_one(σ: float, dark: bool, surface: float) -> None:
    _, scatters, weight = _flights(_distances(surface, dark), σ, 1.0)
    assert (weight == 1).all()
    assert scatters.mean() == pytest.approx(-np.expm1(-σ), abs=5e-3)


def test_light_from_a_lamp_reaches_voxels_through_fog() -> None:
    lamp = {"type": "point", "position": [0.0, 3.0, 0.0], "intensity": 4 * np.pi}
    scene = mi.load_dict({"type": "scene", "fog": cube(homogeneous(0.7)), "lamp": lamp})
    (shape,) = scene.shapes()
    box = Box(np.full(3, -0.9), np.full(3, 1.8))
    direct = DirectLight(box)
    voxel = dr.arange(mi.UInt32, RESOLUTION**3)
    p = box.point(voxel, mi.Point3f(0.5)).numpy()
    medium = dr.select(voxel > 0, mi.MediumPtr(shape.interior_medium()), mi.MediumPtr(None))
    direct.add(scene, scene_query(scene), medium, False, 0.0)
    way = np.array([0.0, 3.0, 0.0])[:, None] - p
    r = np.linalg.norm(way, axis=0)
    expected = np.exp(-0.7 * r * (1 - p[1]) / (3 - p[1])) / r**2
    found = direct.mean.numpy()
    inside = abs(p[0] + way[0] * (1 - p[1]) / way[1]) < 1  # Enters through the upper face
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0.08)
    assert inside.all() and found[0] == 0, "in a voxel of unknown medium there is no light"


@pytest.mark.parametrize("kind", some("heterogeneous", of=["none", "heterogeneous"]))
def test_without_homogeneous_media_no_distances_are_learned(kind: str) -> None:
    other = {"fog": LIGHTS["area"]} if kind == "none" else {}
    medium = {"type": "heterogeneous", "sigma_t": {"type": "constvolume", "value": 1.0}}
    scene = mi.load_dict(fog("point", medium, **other))
    integrator = mi.load_dict({"type": "pss_guided", "always_guide": True, "pilot_spp": 4})
    mi.render(scene, integrator=integrator, spp=16)
    grids = {"flights"} if kind == "heterogeneous" else set()
    assert set(integrator.learners) == {"directions", "roulette"} | grids
    said = "distances in grids are not guided" in integrator.statistics.learned
    assert said == bool(grids)


def test_learned_distances_are_kept_in_files(tmp_path) -> None:
    scene, file = mi.load_dict(fog("area_inside")), str(tmp_path / "learned.npz")
    found = []
    for key in ("save_learned", "load_learned"):
        how = {"always_guide": True, "pilot_spp": 4, key: file}
        integrator = mi.load_dict({"type": "pss_guided", **how})
        mi.render(scene, integrator=integrator, spp=16)
        found.append(integrator.learners["flights"].decision)
    saved, loaded = found
    assert saved.light.values.numpy().max() > 0.1 and saved.surfaces.numpy().max() > 0
    for name in ("values", "outside"):
        expected = getattr(saved.light, name).numpy()
        np.testing.assert_array_equal(getattr(loaded.light, name).numpy(), expected)
    np.testing.assert_array_equal(loaded.surfaces.numpy(), saved.surfaces.numpy())
    p, size = mi.Point3f(9, 12, 30), mi.Float([1, 8])
    assert (loaded.light.around(p, size).numpy() == saved.light.around(p, size).numpy()).all()
