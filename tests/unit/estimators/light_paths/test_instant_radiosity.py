"""Instant radiosity: its images against ``path``, its choices, its bound, and what it refuses.
(``tests/claims`` has the tests that all techniques share.)"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.light_program import LightProgram
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.photons.photon_history import RegionProgram
from mitsuba_ext.estimators.light_paths.subpath_choice.region_table import RegionTable
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_bound import Link
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_choice import (
    LearnedChoice,
    PowerChoice,
    UniformChoice,
)
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_light_tree import ClusteredChoice
from mitsuba_ext.estimators.light_paths.virtual_lights.virtual_lights import Sets, VirtualLights
from mitsuba_ext.scene.regions.nested_regions import NestedRegions
from mitsuba_ext.scene.regions.surface_voxels import lit_normal
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.vertex import Arrival, PathState, Vertex
from tests.support.emitters_and_materials import (
    EMITTERS,
    MATERIALS,
    T,
    below_the_lamp,
    shiny_things,
    stage_with_ball,
)
from tests.support.furnaces import FURNACES
from tests.support.stage import diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_exact,
    assert_same_quarters,
    batches,
    load,
    some,
    z_exact,
)

pytestmark = pytest.mark.usefixtures("variant")


def make(max_depth: int = 4, **parameters: Any) -> mi.Integrator:
    parameters = {"light_paths": 200, **parameters}
    return mi.load_dict({"type": "instant_radiosity", "max_depth": max_depth, **parameters})


def assert_image_of_path(
    scene: mi.Scene | dict[str, Any],
    max_depth: int = 4,
    spp: int = 128,
    precision: float = 0.01,
    both: dict[str, Any] | None = None,
    **parameters: Any,
) -> None:
    """The means of the image and of its quarters agree with ``path``."""
    if isinstance(scene, dict):
        scene = mi.load_dict(scene, optimize=False)
    path = mi.load_dict({"type": "path", "max_depth": max_depth, **(both or {})})
    images = batches(scene, make(max_depth, **(both or {}), **parameters), spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, path, 4 * spp, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision)


# ---- The mean ----


@pytest.mark.parametrize("max_depth", some(5, of=[2, 3, 5, -1]))
def test_the_mean_agrees_with_path_at_each_depth(max_depth: int) -> None:
    """Light is scattered by diffuse and rough objects, a mirror, glass, and a ball with a delta
    lobe."""
    scene = stage(camera=below_the_lamp(), **shiny_things())
    assert_image_of_path(scene, max_depth, 256, 0.02)


WAYS = {
    "power": {"choice": "power"},
    "clustered": {"choice": "clustered", "connections": 3},
    "learned": {"choice": "learned", "pilot_spp": 32},
    "interleaved": {"interleaving": 3, "connections": 2},
    "path": {"bound": 0.0},
    "few": {"light_paths": 3},
    "tight": {"bound": 0.5, "choice": "power"},
    "loose": {"bound": 100.0, "connections": 4},
    "late roulette": {"both": {"rr_depth": 1}},
    "hidden": {"both": {"hide_emitters": True}},
    "lights by power": {"next_event": "power"},
}


@pytest.mark.parametrize("name", some("clustered", "power", of=WAYS))
def test_each_way_to_connect_has_the_same_mean(name: str) -> None:
    assert_image_of_path(stage(camera=below_the_lamp()), **WAYS[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", EMITTERS)
def test_each_emitter_lights_the_scene_as_in_path(name: str) -> None:
    assert_image_of_path(stage(light=EMITTERS[name](), camera=below_the_lamp()), spp=256)


@pytest.mark.parametrize("name", some(of=MATERIALS))
def test_a_material_reflects_light_as_in_path(name: str) -> None:
    assert_image_of_path(stage_with_ball(MATERIALS[name]()), spp=256, bound=1.0)


@pytest.mark.parametrize("choice", ["uniform", "clustered"])
def test_furnace_has_the_exact_radiance(choice: str) -> None:
    """A closed box in which radiance is 1 + ρ + … everywhere, also in its corners."""
    scene = load("furnace_box", width=16, height=16)
    integrator = make(4, choice=choice)
    images = batches(scene, integrator, 64, SEEDS[:MANY_SEEDS])
    (region,) = FURNACES["furnace_box"].regions
    assert_exact(
        images, region.exact(4), region.pixels(16, 16), False, region.allowance, 0.005,
        independent=False,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thinlens", "cropped"])
def test_films_and_sensors_show_what_path_shows(name: str) -> None:
    changes = {"thinlens": {"plugin": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.0},
               "cropped": {"film": film(31, 29, crop_offset_x=5, crop_offset_y=9, crop_width=13,
                                        crop_height=11, rfilter={"type": "gaussian"})}}[name]
    assert_image_of_path(stage(camera=below_the_lamp(**changes)), interleaving=2)


def test_the_same_seed_gives_the_same_image() -> None:
    scene = mi.load_dict(stage(), optimize=False)
    first, second = (batches(scene, make(choice="clustered"), 4, [3]) for _ in range(2))
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)


# ---- The choices ----


def _lights(
    scene: mi.Scene, paths: int = 16, table: RegionTable | None = None
) -> VirtualLights:
    """Two sets of virtual lights, which know their regions if there is a table of these."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 4 * paths)
    rays = CameraRays(dr.zeros(mi.RayDifferential3f, 4 * paths))
    program = RegionProgram(table) if table is not None else LightProgram()
    walk = LightWalk(LightEmission(scene), 5, 5, program)
    lights, _ = VirtualLights.trace(scene, walk, sampler, rays, 2, paths)
    return lights


def _camera_vertices(scene: mi.Scene, sums: Any = None) -> Vertex:
    """The same vertex in many lanes."""
    ray = mi.Ray3f(mi.Point3f(0.3, -1, 1), mi.Vector3f(0, 0.4, -1))
    si = scene.ray_intersect(ray)
    arrival = Arrival(mi.Interaction3f(si), mi.Float(1), mi.Bool(True))
    path = PathState(mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0), arrival, None, sums)
    return Vertex(si, si.bsdf(), path)


def _assert_chosen_by_weight(
    choice: Any, vertex: Vertex, paths: int, begin: int, number: int
) -> None:
    """χ² of the choices at one vertex against the probabilities that their weights tell, which add
    up to one over the virtual lights from ``begin`` on."""
    count = 1 << 18
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    active = dr.full(mi.Bool, True, count)
    chosen = choice.choose(choice.numbers(sampler), vertex, active)
    index = chosen.index.numpy() - begin
    assert chosen.active.numpy().all() and 0 <= index.min() and index.max() < number
    probability = 1 / paths / (chosen.factor.numpy() + np.zeros(count))
    expected = np.zeros(number)
    expected[index] = probability
    found = np.bincount(index, minlength=number)
    often = expected * count > 5
    # All that is never, or hardly ever, chosen has the rest of the probability
    assert expected.sum() == pytest.approx(1, abs=2e-3)
    observed = np.append(found[often], found[~often].sum())
    wanted = np.append(expected[often], max(1 - expected[often].sum(), 1e-12)) * count
    if wanted[-1] < 5:
        observed, wanted = observed[:-1], wanted[:-1] * observed[:-1].sum() / wanted[:-1].sum()
    assert stats.chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue > 1e-4


@pytest.mark.parametrize("kind", [UniformChoice, PowerChoice, ClusteredChoice])
def test_virtual_lights_are_chosen_as_often_as_their_weights_say(kind: type) -> None:
    """From one set; its other set is never chosen from."""
    scene = mi.load_dict(stage(), optimize=False)
    lights = _lights(scene)
    choice = kind(lights, dr.full(mi.UInt32, 1, 1 << 18), mi.Float(2.0))
    begin, number = int(lights.begin[1]), int(lights.number[1])
    _assert_chosen_by_weight(choice, _camera_vertices(scene), 16, begin, number)


def test_learned_virtual_lights_are_chosen_as_often_as_their_weights_say() -> None:
    """From all sets, with any probabilities of regions, also of some where no light is."""
    scene = mi.load_dict(stage(), optimize=False)
    vertices = _lights(scene, 64).vertices
    every = dr.full(mi.Bool, True, vertices.count)
    si = vertices.at(dr.arange(mi.UInt32, vertices.count), every).si
    regions = NestedRegions(si.p, lit_normal(si), most=12)
    rng = np.random.default_rng(2)
    probability = rng.uniform(0.1, 1, (regions.count, regions.count)) ** 3
    table = RegionTable(regions, probability, rng.uniform(0.1, 1, regions.count))
    lights = _lights(scene, 16, table)
    link = Link(mi.Float(1), mi.Float(0), mi.Float(0), mi.Bool(True), mi.UInt32(2))
    vertex = _camera_vertices(scene, link)
    choice = LearnedChoice(lights, table)
    _assert_chosen_by_weight(choice, vertex, 32, 0, lights.vertices.count)


def test_several_connections_are_spread_over_the_virtual_lights() -> None:
    """With a connection for each virtual light, about all of them are used. There is less noise
    than with independent choices, whose noise falls with their number."""
    scene = mi.load_dict(stage(), optimize=False)
    noise = [
        batches(scene, make(3, connections=n, bound=1.0), 16, SEEDS[:4]).var(axis=0).mean()
        for n in (1, 16)
    ]
    assert noise[1] < noise[0]


@pytest.mark.parametrize(("interleaving", "pattern"), [(1, {0, 1}), (2, set(range(8)))])
def test_samples_share_sets_as_the_pattern_says(interleaving: int, pattern: set) -> None:
    """Two samples for each of 4 × 4 pixels."""
    sets = Sets(16, 4, 1, interleaving)
    pixel = dr.arange(mi.UInt32, 32) // 2
    rays = CameraRays(dr.zeros(mi.RayDifferential3f, 32), pixel)
    index = sets.of_lanes(rays).numpy()
    assert sets.count(32) == len(pattern) and set(index) == pattern
    # The samples of a pixel have different ones, and a pixel's neighbour at the pattern's distance
    # has the same ones
    assert (index[::2] != index[1::2]).all()
    np.testing.assert_array_equal(index[:2], index[2 * interleaving : 2 * interleaving + 2])


# ---- The bound ----


def _corner() -> mi.Scene:
    """Two walls, seen from near, that light each other."""
    wall = rectangle(T().translate([0, 1, 1]).rotate([1, 0, 0], 90), bsdf=diffuse(0.8))
    floor = rectangle(T(), bsdf=diffuse(0.8))
    view = lookat([0, 0.2, 0.8], [0, 1, 0], [0, 0, 1])
    lamp = {"type": "point", "position": [0, -0.5, 1.5], "intensity": {"type": "rgb", "value": 1.0}}
    return mi.load_dict({
        "type": "scene", "sensor": sensor(to_world=view, fov=20.0), "wall": wall, "floor": floor,
        "lamp": lamp,
    })  # fmt: skip


def test_a_bounded_corner_without_compensation_is_darker() -> None:
    """A tighter bound makes it darker still. With compensation, it is not darker."""
    scene = _corner()
    means = [
        batches(scene, make(3, bound=bound, compensation=compensation), 128, SEEDS[:4]).mean()
        for bound, compensation in ((0.5, False), (10.0, False), (0.5, True))
    ]
    direct = batches(scene, make(2), 16, [1]).mean()
    path = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 512, [1]).mean()
    assert direct < means[0] < means[1] < 0.99 * path
    assert means[2] == pytest.approx(path, rel=0.01)


def test_the_bound_tames_the_weak_singularity_in_a_corner() -> None:
    """With compensation too, no sample is far brighter than the image."""
    scene = _corner()
    bounded, unbounded = (
        batches(scene, make(3, bound=bound), 1, range(1, 33)) for bound in (3.0, 1e9)
    )
    assert bounded.max() < 5 * bounded.mean()
    assert unbounded.max() > 10 * unbounded.mean()
    assert bounded.var(axis=0).mean() < 0.3 * unbounded.var(axis=0).mean()


def test_without_compensation_gloss_is_still_seen() -> None:
    """What is cut off because a surface is glossy is found by camera paths."""
    mirror = rectangle(T(), bsdf={"type": "roughconductor", "alpha": 0.05})
    scene = mi.load_dict(stage(floor={**mirror, "to_world": T().scale(2)}), optimize=False)
    found = batches(scene, make(3, compensation=False, bound=10.0), 256, SEEDS[:4]).mean()
    expected = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 1024, [1]).mean()
    assert 0.9 * expected < found < 1.02 * expected


# ---- What it says, and what it refuses ----


def test_statistics_tell_the_virtual_lights_and_the_bound() -> None:
    integrator = make(4, light_paths=50)
    mi.render(mi.load_dict(stage(), optimize=False), integrator=integrator, spp=2)
    learned = integrator.statistics.learned
    assert "virtual lights in a set, 2 sets" in learned and "bounded by" in learned


@pytest.mark.parametrize(("parameters", "words"), [
    ({"choice": "best"}, '"choice" is \'best\'; it must be one of uniform, power, clustered'),
    ({"light_paths": 0}, '"light_paths" is 0; it must be at least 1'),
    ({"bound": -1.0}, '"bound" is -1.0; it must be at least 0'),
    ({"connections": 0}, '"connections" is 0; it must be at least 1'),
])  # fmt: skip
def test_wrong_parameters_are_refused(parameters: dict, words: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=words):
        make(**parameters)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_variants_are_refused(variant: str) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match="the variant is spectral:"):
        make().render(scene, spp=1)


def test_moving_shapes_are_refused() -> None:
    ball = {"type": "moving", "translate": [0, 0, 1], "in": {"type": "sphere", "radius": 0.1}}
    scene = mi.load_dict(stage(ball=ball), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match="shapes or lights move:"):
        make().render(scene, spp=1)


def test_media_are_refused() -> None:
    fog = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "null"},
           "interior": {"type": "homogeneous"}}  # fmt: skip
    scene = mi.load_dict(stage(fog=fog), optimize=False)
    with pytest.raises((NotImplementedError, RuntimeError), match='"instant_radiosity", whose'):
        make().render(scene, spp=1)


# ---- Its output variables ----


def _layers(images: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The colours of images [seed, height, width, channel] of RGB films, and the layers behind."""
    names = ("direct", "virtual", "compensation", "lights")
    begins = range(images.shape[-1] - 12, images.shape[-1], 3)
    return images[..., :3], {n: images[..., b : b + 3] for n, b in zip(names, begins)}


@pytest.mark.parametrize("parameters", [
    {"hide_emitters": True, "bound": 1.0, "connections": 2},
    pytest.param({"choice": "learned", "compensation": False}, marks=pytest.mark.slow),
    pytest.param({"interleaving": 2, "samples_per_pass": 2}, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_parts_of_the_image_add_up_to_it(parameters: dict[str, Any]) -> None:
    """Light is scattered by diffuse and rough objects, a mirror, glass, and a ball with a delta
    lobe."""
    scene = mi.load_dict(stage(camera=below_the_lamp(), **shiny_things()), optimize=False)
    image, layers = _layers(batches(scene, make(5, light_aovs=True, **parameters), 8, [1]))
    total = layers["direct"] + layers["virtual"] + layers["compensation"]
    np.testing.assert_allclose(total, image, rtol=1e-4, atol=1e-5)
    assert all(layer.mean() > 0 for layer in layers.values())


def test_direct_light_agrees_with_path_and_the_rest_is_indirect() -> None:
    scene = _corner()
    _, layers = _layers(batches(scene, make(3, light_aovs=True), 64, SEEDS[:4]))
    both = [
        batches(scene, mi.load_dict({"type": "path", "max_depth": depth}), 256, SEEDS[:4])
        for depth in (2, 3)
    ]
    assert layers["direct"].mean() == pytest.approx(both[0].mean(), rel=0.01)
    indirect = layers["virtual"].mean() + layers["compensation"].mean()
    assert indirect == pytest.approx(both[1].mean() - both[0].mean(), rel=0.03)


@pytest.mark.parametrize("max_depth", [1, 2])
def test_without_virtual_lights_all_is_direct(max_depth: int) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    image, layers = _layers(batches(scene, make(max_depth, light_aovs=True), 2, [1]))
    np.testing.assert_array_equal(layers["direct"], image)
    assert not any(layers[name].any() for name in ("virtual", "compensation", "lights"))


@pytest.mark.parametrize("passes", [{}, {"samples_per_pass": 300}])
def test_many_virtual_lights_show_the_image_of_a_light_tracer(passes: dict[str, int]) -> None:
    """Those of light paths of one segment are where a lamp lights a surface directly."""
    scene = mi.load_dict(stage(camera=below_the_lamp()), optimize=False)
    integrator = make(3, light_aovs=True, light_paths=1000, **passes)
    _, layers = _layers(batches(scene, integrator, 512, SEEDS[:MANY_SEEDS]))
    path = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (2, 1))
    lit, lamp = (batches(scene, integrator, 512, [1]).mean() for integrator in path)
    z, error = z_exact(layers["lights"].mean(axis=(1, 2, 3)), lit - lamp)
    assert abs(z) < THRESHOLD and error < 0.02
