"""Portals: directions through them have exact densities everywhere, and the mean agrees with
path."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.scene.portals import Portal, portals
from mitsuba_ext.techniques.portal_lights.portal_maps import PortalMaps
from mitsuba_ext.techniques.portal_lights.portal_sampling import PortalSampling
from mitsuba_ext.transport.path_decisions import LightNumbers
from tests.support.environments import MORE_ENVIRONMENTS, random_point
from tests.support.stage import area, diffuse, film, lookat, rectangle, rgb, sensor
from tests.support.statistical import assert_images_are_sound, assert_same_mean, batches

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 17

def T(*matrix: Any) -> Any:
    return mi.ScalarTransform4f(*matrix)


#: Two windows of one wall, and a skylight; the room is x, y, z < 1.
OPENINGS = {
    "window": lambda: T().translate([0.3, 1, 0.1]).rotate([1, 0, 0], 90).scale([0.4, 0.3, 1]),
    "beside": lambda: T().translate([-0.6, 1, 0.2]).rotate([1, 0, 0], 90).scale([0.2, 0.5, 1]),
    "skylight": lambda: T().translate([-0.2, 0.1, 1]).rotate([1, 0, 0], 180).scale([0.5, 0.2, 1]),
}


def _portals() -> dict[str, Any]:
    return {name: {"type": "portal", "to_world": make()} for name, make in OPENINGS.items()}


def _scene(environment: str, **others: Any) -> mi.Scene:
    shapes = {**_portals(), "floor": {"type": "sphere", "center": [0, 0, -3]}, **others}
    return mi.load_dict({"type": "scene", "sky": MORE_ENVIRONMENTS[environment](), **shapes})


def _point(*p: float) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.p = mi.Point3f(*p)
    si.wavelengths = 550.0 if mi.is_spectral else []
    return si


# ---- What a scene marks ----


def test_a_portal_is_the_square_that_its_transform_makes():
    portal = next(p for p in portals(_scene("sun")) if p.half_height == pytest.approx(0.3))
    assert np.allclose(portal.outwards, [0, 1, 0], atol=1e-6), "its normal points into the room"
    low, high = portal.corners.min(axis=0), portal.corners.max(axis=0)
    assert np.allclose([low, high], [[-0.1, 1, -0.2], [0.7, 1, 0.4]], atol=1e-6)


def test_a_mirrored_square_keeps_its_normal():
    mirrored = np.array(T().scale([-1, 2, 1]).matrix, dtype=np.float64)
    assert np.allclose(Portal.of_matrix(mirrored).outwards, [0, 0, -1], atol=1e-6)


def test_no_ray_meets_a_portal_and_it_spoils_no_bounds():
    scene = _scene("sun")
    ray = mi.Ray3f(mi.Point3f(0.3, 0, 0.1), mi.Vector3f(0, 1, 0))
    assert not scene.ray_intersect(ray).is_valid()[0] and not scene.ray_test(ray)[0]
    assert scene.bbox().max.z == pytest.approx(1)


@pytest.mark.parametrize("transform, message", [
    (np.diag([0, 1, 1, 1]), "keep an area"),
    ([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "become a rectangle"),
])  # fmt: skip
def test_portals_that_are_no_rectangles_are_refused(transform, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "portal", "to_world": T(np.array(transform, dtype=np.float64))})


# ---- Directions ----

_POINTS = {"inside": (0.1, -0.4, -0.2), "close": (0.25, 0.9, 0.2), "corner": (-0.9, -0.9, -0.9)}


def _histogram(d: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    edges = [np.linspace(-np.pi, np.pi, 25), np.linspace(-1, 1, 17)]
    return np.histogram2d(np.arctan2(d[1], d[0]), d[2], edges, weights=weights)[0]


_PAIRS = [("turned", point) for point in _POINTS] + [
    (environment, "inside") for environment in MORE_ENVIRONMENTS if environment != "turned"
]


@pytest.mark.parametrize("environment, point", [
    pytest.param(*pair, marks=() if pair == ("turned", "inside") else pytest.mark.slow)
    for pair in _PAIRS
])  # fmt: skip
def test_directions_are_distributed_by_the_density(environment: str, point: str) -> None:
    """With one portal, the density of a sample is found again, and chi² is met."""
    found_portals = portals(scene := _scene(environment))
    maps = PortalMaps(scene, found_portals)
    p = mi.Point3f(*_POINTS[point])
    active, numbers = mi.Bool(True), mi.PCG32(size=LANES)
    for portal, shape in enumerate(found_portals):
        window = maps.window(mi.UInt32(portal), p, active)
        index = mi.UInt32(portal)
        d, emitted = maps.sample(window, random_point(numbers), active & (window.total > 0))
        density, found = (
            mi.Float(x / window.total) for x in (emitted, maps.emitted(index, p, d, active))
        )
        # Uniform in the rectangle of the portal, as seen from the point
        uv = 2 * random_point(numbers) - 1
        to = mi.Vector3f(*map(float, shape.center)) - mi.Vector3f(p)
        to += mi.Vector3f(*map(float, shape.half_width * shape.x)) * uv.x
        to += mi.Vector3f(*map(float, shape.half_height * shape.y)) * uv.y
        square = dr.squared_norm(to)
        other = to * dr.rsqrt(square)
        cosine = dr.dot(other, mi.Vector3f(*map(float, shape.outwards)))
        by_area = square / (cosine * 4 * shape.half_width * shape.half_height)
        pdf = mi.Float(maps.emitted(index, p, other, active) / window.total)
        d, density, found, other, by_area, pdf = (
            x.numpy() for x in (d, density, found, other, by_area, pdf)
        )
        ratio = found / density
        assert (density > 0).all() and np.mean(np.abs(ratio - 1) > 1e-3) < 2e-3
        value = pdf / by_area
        error = value.std() / np.sqrt(LANES)
        assert abs(value.mean() - 1) < 4.5 * error + 2e-3
        if error > 0.02:
            continue  # a tiny sun: few directions of the rectangle find it
        observed, expected = _histogram(d), _histogram(other, value)
        spread = expected + _histogram(other, value**2) - expected**2 / LANES
        used = (expected > 50) & (_histogram(other) > 50)
        chi2 = np.sum((observed - expected)[used] ** 2 / spread[used])
        assert used.any() and stats.chi2.sf(chi2, used.sum()) > 1e-4


@pytest.mark.slow
def test_maps_have_at_most_2048_texels_along_an_axis() -> None:
    """12 bytes each, for every orientation."""
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2048, 4096, 3), np.float32))}
    scene = mi.load_dict({"type": "scene", "sky": sky, **_portals()})
    maps = PortalMaps(scene, portals(scene))
    assert maps.resolution == 2048
    size = 2 * 48 * 2**20  # of the wall, and of the ceiling
    assert len(maps._sums) * 8 + len(maps._values) * 4 == pytest.approx(size, rel=2e-3)


@pytest.mark.parametrize("lamp", [pytest.param(False, marks=pytest.mark.slow), True])
def test_all_connections_have_the_density_that_mis_asks_for(lamp: bool) -> None:
    """With all portals, ordinary samples and another light; and what they bring is the integral of
    the light."""
    other = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.1,
             "emitter": {"type": "area", "radiance": rgb(2.0)}}  # fmt: skip
    scene = _scene("turned", **({"lamp": other} if lamp else {}))
    decision, si, active = PortalSampling(scene, 0.9), _point(0.1, -0.4, -0.2), mi.Bool(True)
    numbers = mi.PCG32(size=LANES)
    light = LightNumbers(random_point(numbers), numbers.next_float32())
    place = decision.visit(decision.begin(None, None), scene, si, active)
    ds, weight, _ = decision.sample(place, scene, light, si, active)
    state = decision.remember(place, scene, ds.d, mi.Float(1), active)
    found = decision.density(state, scene, si, si, ds, active)
    same = np.isclose(found.numpy(), ds.pdf.numpy(), rtol=1e-3)
    assert same.mean() > 0.998 and (ds.pdf.numpy() > 0).mean() > 0.99
    point = LightNumbers(random_point(numbers), numbers.next_float32())
    _, expected = scene.sample_emitter_direction(si, point.point, False, active)
    a, b = (mi.luminance(x, si.wavelengths).numpy() for x in (weight, expected))
    error = np.hypot(a.std(), b.std()) / np.sqrt(LANES)
    assert abs(a.mean() - b.mean()) < 4 * error and error < 0.05 * b.mean()


def test_a_point_in_front_of_all_portals_is_lit_as_by_path() -> None:
    scene, si = _scene("turned"), _point(3.0, 3.0, 3.0)
    numbers = mi.PCG32(size=LANES)
    light = LightNumbers(random_point(numbers), numbers.next_float32())
    decision, active = PortalSampling(scene, 0.9), mi.Bool(True)
    place = decision.visit(decision.begin(None, None), scene, si, active)
    ds, weight, _ = decision.sample(place, scene, light, si, active)
    same, expected = scene.sample_emitter_direction(si, light.point, False, mi.Bool(True))
    assert np.allclose(ds.pdf, same.pdf, rtol=1e-4) and np.allclose(weight, expected, rtol=1e-4)


# ---- Rooms ----


def _room(sky: dict | None = None, emission: float = 0.0) -> mi.Scene:
    """A closed box with one opening, of which half is open: the portal is larger."""
    at = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
    walls = {
        "left": T().translate([-1, 0, 0]).rotate(at["y"], 90),
        "right": T().translate([1, 0, 0]).rotate(at["y"], -90),
        "floor": T().translate([0, 0, -1]),
        "ceiling": T().translate([0, 0, 1]).rotate(at["x"], 180),
        "near": T().translate([0, -1, 0]).rotate(at["x"], -90),
        "below": T().translate([0, 1, -0.6]).rotate(at["x"], 90).scale([1, 0.4, 1]),
        "above": T().translate([0, 1, 0.7]).rotate(at["x"], 90).scale([1, 0.3, 1]),
    }
    lit = {"emitter": area(emission)} if emission else {}
    shapes = {
        name: rectangle(place, bsdf=diffuse(0.5), **lit) for name, place in walls.items()
    }
    portal = {"type": "portal",
              "to_world": T().translate([0, 1, 0.1]).rotate(at["x"], 90).scale([1, 0.4, 1])}
    camera = sensor(to_world=lookat([0.6, -0.9, 0.2], [-0.3, 0.5, -0.3], at["z"]), fov=70.0,
                    film=film(16, 16))  # fmt: skip
    sky = sky or {"type": "constant", "radiance": rgb(1.0)}
    return mi.load_dict(
        {"type": "scene", "sky": sky, "sensor": camera, "portal": portal, **shapes}, optimize=False
    )


_MADE = {"type": "composed_path", "max_depth": 3, "next_event": "portals"}


@pytest.mark.parametrize("sky, share", [
    ("constant", 0.9), *(pytest.param(*pair, marks=pytest.mark.slow)
                         for pair in (("constant", 0.3), ("sky", 0.9), ("sun", 0.9)))
])  # fmt: skip
def test_a_room_has_the_mean_of_path(sky: str, share: float) -> None:
    scene = _room(sky=MORE_ENVIRONMENTS[sky]() if sky in MORE_ENVIRONMENTS else None)
    integrator = mi.load_dict({**_MADE, "next_event": {"type": "portal_lights", "share": share}})
    images = batches(scene, integrator, 256, range(4))
    assert_images_are_sound(images)
    path = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 512, range(1001, 1005))
    assert_same_mean(images, path, 0.02)


def test_a_room_in_which_all_is_equally_bright_stays_so() -> None:
    """Walls emit what they absorb of the sky's radiance: connections to them and to the sky, and
    BSDF samples, add up to one everywhere."""
    scene = _room(emission=0.5)
    made = mi.load_dict({**_MADE, "max_depth": -1, "rr_depth": 50})
    images = batches(scene, made, 64, range(4))
    error = images.mean(axis=(1, 2, 3)).std(ddof=1) / 2
    assert abs(images.mean() - 1) < 4 * error + 2e-4 and error < 5e-3


def test_portals_reduce_the_error_of_a_room() -> None:
    scene = _room()
    a = batches(scene, mi.load_dict(_MADE), 16, range(4)).std(axis=0).mean()
    path = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 16, range(4))
    assert a < 0.8 * path.std(axis=0).mean()


@pytest.mark.parametrize("missing", ["portal", "sky"])
def test_without_portals_or_environment_it_is_path(missing: str) -> None:
    shapes = {} if missing == "portal" else _portals()
    lamp = {"type": "sphere", "center": [0, 2, 0.5], "emitter": {"type": "area"}}
    light = MORE_ENVIRONMENTS["turned"]() if missing == "portal" else lamp
    scene = mi.load_dict({"type": "scene", "light": light, "floor": rectangle(bsdf=diffuse(0.5)),
                          "sensor": sensor(film=film(8, 8)), **shapes})  # fmt: skip
    a = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 4, [1])
    assert np.allclose(a, batches(scene, mi.load_dict(_MADE), 4, [1]), rtol=1e-4, atol=1e-6)


def test_integrators_with_light_paths_refuse_it() -> None:
    with pytest.raises(RuntimeError, match="without light paths"):
        mi.load_dict({"type": "bdpt", "next_event": "portals"})
