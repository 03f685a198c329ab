"""The random walk in participating media: scenes with a known answer, and Mitsuba's ``volpath``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.media import has_media, may_have_media
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.free_flight import Distances
from mitsuba_ext.transport.path_decisions import DirectionSamples
from mitsuba_ext.transport.walk import Walk
from tests.support.fogs import (
    LIGHTS,
    camera,
    cube,
    empty_cloud,
    fog,
    fog_around_the_camera,
    grid,
    homogeneous,
    leaves_and_windows,
)
from tests.support.stage import area, diffuse, film, lookat, sensor
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_images_are_sound,
    assert_same_pixels_on_average,
    batches,
    some,
    z_exact,
)

pytestmark = pytest.mark.usefixtures("variant")

#: Media by name, in scenes with light from outside.
MEDIA = {
    "homogeneous": homogeneous,
    "chromatic": lambda: homogeneous([0.2, 0.5, 0.9], [0.9, 0.6, 0.3]),
    "grid": grid,
    "thick": lambda: homogeneous(20.0, 0.95),
    "without_emitter_sampling": lambda: homogeneous(sample_emitters=False),
    "mie": lambda: {**homogeneous(), "phase": {"type": "rayleigh"}},
}


def _make(max_depth: int = 6, **parameters) -> mi.Integrator:
    return mi.load_dict({"type": "composed_path", "max_depth": max_depth, **parameters})


def _volpath(max_depth: int = 6, **parameters) -> mi.Integrator:
    return mi.load_dict({"type": "volpath", "max_depth": max_depth, **parameters})


# ---- Known answers ----


def _looking_along_z(**other) -> dict:
    """Parallel rays through the cube around the origin: each is in it for a length of 2."""
    view = lookat([0, 0, 5], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale([0.5, 0.5, 1])
    return {"type": "orthographic", "to_world": view, "film": film(8, 8),
            "sampler": {"type": "independent"}, **other}  # fmt: skip


@pytest.mark.parametrize("sigma_t", [[0.0, 0.4, 1.5], 1.0], ids=["chromatic", "grey"])
def test_absorbing_medium_attenuates_as_beer_and_lambert_say(sigma_t) -> None:
    """From a sky of radiance 1, exp(−σ_t d) arrives."""
    medium = homogeneous(sigma_t, albedo=0.0)
    scene = mi.load_dict({"type": "scene", "sensor": _looking_along_z(), "fog": cube(medium),
                          "sky": {"type": "constant"}})  # fmt: skip
    images = batches(scene, _make(), 4096, SEEDS[:8])
    exact = np.exp(-2 * np.broadcast_to(sigma_t, 3))
    for channel in range(3):
        z, error = z_exact(images[..., channel].mean(axis=(1, 2)), exact[channel])
        assert abs(z) < 4 and error < 0.005


@pytest.mark.parametrize("name", ["homogeneous", "grid"])
def test_shadow_rays_are_attenuated_by_absorbing_media(name: str) -> None:
    """A directional light through the cube on a diffuse rectangle behind it: π L = ρ E exp(−τ)."""
    T = mi.ScalarTransform4f
    if name == "grid":
        density = np.full((2, 2, 2, 1), 0.7, dtype=np.float32)
        density[:, :, 1] = 0.3  # on the side of positive x
        volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density), "filter_type": "nearest",
                  "to_world": T().translate([-1, -1, -1]).scale(2)}  # fmt: skip
        medium = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": volume}
    else:
        medium = homogeneous(0.7, albedo=0.0)
    # Seen from the other side of the light's way: nothing is between the wall and the camera
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, -1.5]), "bsdf": diffuse(1.0)}
    view = lookat([0, 0, -1.2], [0, 0, -2], [0, 1, 0]) @ T().scale([0.5, 0.5, 1])
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": np.pi}
    scene = mi.load_dict({"type": "scene", "sensor": _looking_along_z(to_world=view), "wall": wall,
                          "fog": cube(medium), "light": light})  # fmt: skip
    images = batches(scene, _make(2), 4096, SEEDS[:8])
    left, right = images[:, :, :4].mean(axis=(1, 2, 3)), images[:, :, 4:].mean(axis=(1, 2, 3))
    expected = np.exp([-1.4, -1.4] if name == "homogeneous" else [-1.4, -0.6])
    for values, exact in zip((left, right), expected):
        # Homogeneous media leave no noise, except for the starts of rays
        z, error = z_exact(values, exact, allowance=1e-4)
        assert abs(z) < 4 and error < 0.005


WHITE = {
    "homogeneous": lambda: homogeneous(2.0, 1.0),
    "chromatic": lambda: homogeneous([0.5, 1.0, 2.0], 1.0),
    "grid": lambda: grid(2.0, 1.0, -0.4),
}


@pytest.mark.parametrize(("name", "light"), some(
    ("chromatic", "walls"), ("grid", "sky"), of=[(m, x) for m in WHITE for x in ("sky", "walls")]
))  # fmt: skip
def test_white_medium_in_a_white_world_is_invisible(name: str, light: str) -> None:
    """What scatters without loss, in an environment of radiance 1, has the radiance 1: also under
    roulette, and where the light is a surface."""
    lights = {
        "sky": {"type": "constant"},
        "walls": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(8), "flip_normals": True,
                  "bsdf": diffuse(0.0), "emitter": area(1.0)},
    }  # fmt: skip
    scene = mi.load_dict({"type": "scene", "sensor": camera(), "fog": cube(WHITE[name]()),
                          "light": lights[light]})  # fmt: skip
    images = batches(scene, _make(-1), 512, SEEDS[:8])
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0)
    assert abs(z) < 4 and error < 0.004


# ---- The random numbers of volpath ----


class _OrderOfVolpath(DirectionSamples):
    """The compiler of Mitsuba's wheels evaluates arguments from the right to the left: ``volpath``
    draws the numbers of a direction before the number of a lobe."""

    def draw(self, state, sampler, vertex, active):
        sample_2 = sampler.next_2d()
        return sampler.next_1d(), sample_2, 1.0, state


SAME_PATHS = {
    "homogeneous": fog,
    "chromatic": lambda: fog(medium=homogeneous([0.2, 0.5, 0.9])),
    "grid": lambda: fog(medium=grid()),
    "sky": lambda: fog("environment"),
    "lamp_inside": lambda: fog("point_inside"),
    "around_the_camera": lambda: fog_around_the_camera(medium=homogeneous(0.1)),
    "nested": lambda: fog(inner=cube(homogeneous(3.0), 0.4, exterior=homogeneous())),
}


class _DistancesOfVolpath(Distances):
    exact_transmittance = False


@pytest.mark.parametrize("name", some("grid", "chromatic", of=SAME_PATHS))
def test_walk_draws_the_numbers_of_volpath(name: str) -> None:
    """Every path is the same, where no connection is left out because its BSDF is black, and where
    roulette, which has another rule, has not begun."""
    scene = mi.load_dict(SAME_PATHS[name]())
    sensor = scene.sensors()[0]
    values = []
    walk = Walk(8, 100, directions=_OrderOfVolpath(), distance=_DistancesOfVolpath())
    volpath = _volpath(8, rr_depth=100)
    for integrator in (walk, volpath):
        sampler = sensor.sampler().clone()
        sampler.seed(7, 4096)
        film_sample = sampler.next_2d()
        ray, _ = sensor.sample_ray_differential(0, 0, film_sample, mi.Point2f(0.5))
        medium = sensor.get_medium()
        if integrator is walk:
            L = walk(scene, sampler, CameraRays(ray, medium=medium), mi.Bool(True)).L
        else:
            L = volpath.sample(scene, sampler, ray, medium, mi.Bool(True))[0]
        values.append(np.array(L).T)
    assert values[1].any()
    same = np.isclose(*values, rtol=1e-3, atol=1e-5).all(axis=1)
    # A rounding error sends a path elsewhere, now and then
    assert same.mean() > 0.995, f"{1 - same.mean():.1%} of the paths differ"


# ---- The mean of volpath ----


def _compare(scene: mi.Scene, integrator, reference, spp: int = 256, precision=0.02) -> None:
    images = batches(scene, integrator, spp, SEEDS[:2])
    assert_images_are_sound(images)
    expected = batches(scene, reference, 2 * spp, REFERENCE_SEEDS[:2])
    assert expected.any(), "a black image proves nothing"
    assert_same_pixels_on_average(images, expected, precision)


@pytest.mark.parametrize(("medium", "light"), some(
    ("grid", "area"),
    of=[(m, x) for m in MEDIA for x in LIGHTS if m != "thick" or "inside" not in x],
))  # fmt: skip
def test_fog_has_the_mean_of_volpath(medium: str, light: str) -> None:
    # A point of light in a medium: the variance of both has no bound
    spp, precision = (2048, 0.1) if "inside" in light else (512, 0.05)
    _compare(mi.load_dict(fog(light, MEDIA[medium]())), _make(), _volpath(), spp, precision)


def _glass_of_milk() -> dict:
    """Refraction at the boundary, and a ball of another medium inside."""
    glass = {"type": "sphere", "radius": 1.0, "bsdf": {"type": "dielectric"},
             "interior": {"type": "ref", "id": "outer"}}  # fmt: skip
    inner = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "null"},
             "interior": homogeneous([3.0, 1.0, 0.5], 0.9),
             "exterior": {"type": "ref", "id": "outer"}}  # fmt: skip
    outer = {**homogeneous(0.5, 0.9), "id": "outer"}
    return {"type": "scene", "outer": outer, **{
        key: value for key, value in fog("environment", fog=glass, inner=inner).items()
        if key != "type"
    }}  # fmt: skip


SPECIAL = {
    "glass_of_milk": _glass_of_milk,
    "leaves_and_windows": leaves_and_windows,
    "empty_cloud": empty_cloud,
    "around_the_camera": lambda: fog_around_the_camera("area"),
    "grid_around_the_camera": lambda: fog_around_the_camera("point", grid(0.4)),
}


@pytest.mark.parametrize("name", some("glass_of_milk", of=SPECIAL))
def test_special_media_have_the_mean_of_volpath(name: str) -> None:
    _compare(mi.load_dict(SPECIAL[name]()), _make(), _volpath(), 1024, 0.03)


@pytest.mark.parametrize("max_depth", [1, 2])
def test_paths_through_leaves_end_at_their_longest_length(max_depth: int) -> None:
    """What passes the last vertex adds none; what it scatters would."""
    scene = mi.load_dict({**leaves_and_windows(), "light": LIGHTS["environment"]})
    _compare(scene, _make(max_depth), _volpath(max_depth), 512)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["area", "environment", "area_inside"])
def test_hidden_emitters_in_fog_have_the_mean_of_volpath(light: str) -> None:
    lamp = {"type": "sphere", "radius": 0.4, "center": [0, 0, 2.5], "emitter": area(2.0)}
    scene = mi.load_dict(fog(light, lamp=lamp))
    hidden = {"hide_emitters": True}
    _compare(scene, _make(**hidden), _volpath(**hidden), 1024, 0.03)


def test_hidden_emitter_does_not_end_the_fog_around_the_camera() -> None:
    """Rays scatter as often as without the lamp. (``volpath`` stops at the lamp here.)"""
    place = mi.ScalarTransform4f().translate([0, 0, 2]).scale(20)
    lamp = {"type": "rectangle", "to_world": place, "bsdf": diffuse(0.0), "emitter": area(1.0)}
    around = fog_around_the_camera("environment", homogeneous(0.05, 0.0))
    del around["floor"]
    share = []
    for scene in (around, {**around, "lamp": lamp}):
        scene = mi.load_dict(scene)
        eye = scene.sensors()[0]
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, 1 << 16)
        ray, _ = eye.sample_ray_differential(0, 0, sampler.next_2d(), mi.Point2f(0.5))
        integrator = _make(3, hide_emitters=True)
        _, valid, _ = integrator.sample(scene, sampler, ray, eye.get_medium())
        share.append(np.array(valid).mean())
    assert share[1] == pytest.approx(share[0], abs=1e-4)
    assert 0.7 < share[0] < 0.75  # the fog ends at about 26


@pytest.mark.parametrize("variant", some(
    "llvm_ad_spectral", of=["llvm_ad_spectral", "llvm_ad_mono"]), indirect=True)  # fmt: skip
def test_other_variants_have_the_mean_of_volpath(variant: str) -> None:
    medium = homogeneous([0.3, 0.6, 0.9] if "mono" not in variant else 0.5)
    _compare(mi.load_dict(fog("area", medium)), _make(), _volpath(), 1024, 0.03)


def test_a_ray_through_the_diagonal_of_a_face_enters_the_medium_as_in_volpath() -> None:
    """Embree misses the edge between two triangles: packets of rays do at this one, single rays at
    others."""
    angle = np.radians(25)
    view = lookat([4 * np.sin(angle), 0, 1 + 4 * np.cos(angle)], [0, 0, 1], [0, 1, 0])
    meter = {"type": "radiancemeter", "to_world": view, "film": film(1, 1)}
    slab = mi.ScalarTransform4f().translate([0, 0, -9]).scale([300, 300, 10])
    scene = mi.load_dict({
        "type": "scene", "sensor": meter, "slab": {**cube(homogeneous()), "to_world": slab},
        "sun": {"type": "directional", "direction": [0.3, 0.1, -1]},
    })
    means = [batches(scene, make(3), 4096, [1]).mean() for make in (_make, _volpath)]
    assert means[0] == pytest.approx(means[1], rel=0.1)


# ---- Techniques ----

SEEING = {
    "neepp": {"type": "neepp"},
    "rejecting": {"type": "neepp", "rejection": True, "light_sampling": "uniform",
                  "slope": 2.0, "floor": 0.3},
    "guided": {"type": "pss_guided", "always_guide": True},
    "guided_and_maps": {"type": "composed_path", "distance": "swarm", "directions": {
        "type": "guided_directions", "always_guide": True}},
    "tiles": {"type": "pss_guided", "always_guide": True, "regions": "tiles", "tile": 4},
    "auto_path": {"type": "auto_path", "pilot_spp": 32},
    "many": {"type": "reweighted_direct", "light_samples": 3},
    "everywhere": {"type": "composed_path",
                   "connections": {"type": "weighted_connections", "vertices": "all", "count": 3}},
    "balance": {"type": "composed_path", "mis": "balance"},
    "power": {"type": "composed_path", "next_event": "power"},
    "spatial": {"type": "composed_path", "next_event": "spatial"},
    "portals": {"type": "composed_path", "next_event": "portals"},
    "distances": {"type": "swarm_path", "always_use": True},
}  # fmt: skip


@pytest.mark.parametrize("name", some("guided", of=SEEING))
def test_technique_has_the_mean_of_volpath_in_fog(name: str) -> None:
    lamps = {"lamp": LIGHTS["area_inside"], "spot": LIGHTS["point"]}
    scene = mi.load_dict(fog("environment", **lamps))
    integrator = mi.load_dict({**SEEING[name], "max_depth": 5})
    _compare(scene, integrator, _volpath(5), 512, 0.03)


@pytest.mark.slow
def test_maps_of_distances_leave_the_radiance_of_a_white_world() -> None:
    """Camera rays fly where the map says, which weighs each of them."""
    lamp = {**LIGHTS["point_inside"], "intensity": 1e-3}  # something to learn
    scene = mi.load_dict({"type": "scene", "sensor": camera(), "sky": {"type": "constant"},
                          "fog": cube(homogeneous(2.0, 1.0)), "lamp": lamp})  # fmt: skip
    swarm = mi.load_dict({"type": "swarm_path", "always_use": True})
    images = batches(scene, swarm, 128, SEEDS[:4])
    assert "distances" in swarm.statistics.learned
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0, allowance=2e-3)
    assert abs(z) < 4 and error < 0.01


@pytest.mark.parametrize("parameters", [
    {"type": "bdpt", "subpath_selection": "visibility"}, {"type": "pssmlt"}, {"type": "mlt"},
    {"type": "erpt"}, {"type": "erpt", "mutations": "path"}, {"type": "two_stage"},
    {"type": "composed_path", "next_event": "linear"},
    {"type": "composed_path", "next_event": "resampled"},
    {"type": "composed_path", "next_event": "triple_product"},
    {"type": "adaptive", "nested": {"type": "two_stage"}},
    {"type": "moment", "nested": {"type": "two_stage"}},
], ids=lambda x: "-".join(v for v in x.values() if isinstance(v, str)))  # fmt: skip
def test_techniques_that_need_surfaces_refuse_media(parameters: dict) -> None:
    scene = mi.load_dict(fog("environment"))
    name = parameters.get("nested", parameters)["type"]
    with pytest.raises((NotImplementedError, RuntimeError), match=f'"{name}".*participating media'):
        dr.eval(mi.load_dict(parameters).render(scene, spp=4))


def test_moving_grid_is_refused() -> None:
    moving = {"type": "moving", "shape": cube(grid()), "translate": [1, 0, 0]}
    with pytest.raises(NotImplementedError, match="grid medium"):
        _make().render(mi.load_dict(fog(fog=moving)), spp=1)


def test_media_are_found_in_sensors_and_instances() -> None:
    assert has_media(mi.load_dict(fog()))
    assert not has_media(mi.load_dict({"type": "scene", "sensor": sensor(), "s": {"type": "cube"}}))
    eye = sensor(medium=homogeneous())
    assert has_media(mi.load_dict({"type": "scene", "sensor": eye}))
    group = {"type": "shapegroup", "id": "group", "cloud": cube(homogeneous())}
    scene = {"type": "scene", "sensor": sensor(), "group": group,
             "instance": {"type": "instance", "g": {"type": "ref", "id": "group"}}}  # fmt: skip
    assert may_have_media(mi.load_dict(scene))
