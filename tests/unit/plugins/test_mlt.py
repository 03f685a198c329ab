"""``mlt``: chains of light paths render what ``path`` renders."""

from __future__ import annotations

import re
import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.bases import path_mutations
from mitsuba_ext.estimators.chains.numbers import ProposedNumbers, StateNumbers, generator
from mitsuba_ext.estimators.chains.path_space.evaluation import _lobe_ratio
from mitsuba_ext.estimators.chains.path_space.mutations import Mutations, Switches
from mitsuba_ext.estimators.chains.path_space.space import PathSpace, turned
from mitsuba_ext.estimators.chains.path_space.techniques import Techniques
from mitsuba_ext.estimators.chains.path_target import PathTarget
from mitsuba_ext.estimators.chains.small_steps import SmallSteps
from mitsuba_ext.estimators.light_paths.light_side import LightSide
from mitsuba_ext.transport.path_decisions import SceneQuery
from tests.support.emitters_and_materials import EMITTERS, MATERIALS, SPECULAR, T, stage_with_ball
from tests.support.stage import area, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    THRESHOLD,
    assert_same_quarters,
    batches,
    some,
    z_exact,
)

pytestmark = pytest.mark.usefixtures("variant")

#: All light is left to the chains.
ALONE = {"direct_samples": -1}

SWITCHES = (
    "bidirectional_mutation", "lens_perturbation", "multi_chain_perturbation",
    "caustic_perturbation",
)  # fmt: skip


def mlt(max_depth: int = 4, **parameters: Any) -> Any:
    return mi.load_dict({"type": "mlt", "max_depth": max_depth, "chains": 1024, **parameters})


def path(max_depth: int) -> Any:
    return mi.load_dict({"type": "path", "max_depth": max_depth})


def target(scene: mi.Scene, least: int, most: int) -> PathTarget:
    camera = scene.sensors()[0]
    camera.film().prepare([])
    side = LightSide.of("mlt", scene, camera)
    space = PathSpace(scene, camera, side.emission, side.sensor, SceneQuery(), 16, least, most)
    return PathTarget(Mutations(space, Switches()))


def found(of: PathTarget, seed: int, count: int) -> np.ndarray:
    """The colours that new paths estimate: [path, channel]."""
    none = dr.zeros(mi.UInt32, count)
    rng = generator(seed, dr.arange(mi.UInt32, count))
    numbers = ProposedNumbers(rng, mi.UInt32(none), none, StateNumbers(SmallSteps()))
    return of.evaluate(numbers).parts[0].value.numpy().T.astype(np.float64)


# ---- New paths ----


def assert_new_paths_estimate(scene: mi.Scene, reference: str, most: int = 4) -> None:
    """Their mean is the light of three segments and more, as another integrator finds it."""
    values = found(target(scene, 3, most), 1, 1 << 18).mean(axis=1)
    depths = [mi.load_dict({"type": reference, "max_depth": depth}) for depth in (most, 2)]
    # With the same seeds, direct light of both is nearly the same
    images = [batches(scene, d, 256, REFERENCE_SEEDS[:MANY_SEEDS]) for d in depths]
    means = [image.mean(axis=(1, 2, 3)) for image in images]
    expected = means[0] - means[1]
    error = np.hypot(
        values.std() / len(values) ** 0.5, expected.std(ddof=1) / len(expected) ** 0.5
    )
    assert abs(values.mean() - expected.mean()) < THRESHOLD * error
    assert error < 0.06 * values.mean()


@pytest.mark.parametrize("name", some("spot", of=EMITTERS))
def test_new_paths_find_the_light_of_an_emitter(name: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[name]()), optimize=False)
    assert_new_paths_estimate(scene, "bdpt")


@pytest.mark.parametrize("name", some("glass", of=[*MATERIALS, *SPECULAR]))
def test_new_paths_find_light_by_way_of_a_material(name: str) -> None:
    """A sky: paths that meet a mirror or glass run into it."""
    scene = {**stage_with_ball({**MATERIALS, **SPECULAR}[name]()), "light": EMITTERS["constant"]()}
    assert_new_paths_estimate(mi.load_dict(scene, optimize=False), "path", most=5)


def test_a_surface_close_before_another_one_is_not_taken_for_it() -> None:
    """A lamp with a shade of two layers, nearer to each other than the lengths of rays from far
    away can tell."""
    thin = {"type": "principledthin", "diff_trans": 1.0, "eta": 1.01, "roughness": 1.0}
    at = [-0.5, -0.5, 1.2]
    ball = {"type": "sphere", "center": at}
    layers = {str(n): {**ball, "radius": r, "bsdf": thin} for n, r in enumerate((0.4, 0.3985))}
    lamp = {**ball, "radius": 0.1, "emitter": area(20.0)}
    scene = mi.load_dict(stage(light=lamp, **layers), optimize=False)
    assert_new_paths_estimate(scene, "path", most=4)


def test_learned_techniques_find_the_same_light_with_less_variance() -> None:
    scene = mi.load_dict(stage_with_ball(SPECULAR["glass"]()), optimize=False)
    of = target(scene, 3, 6)
    before = found(of, 1, 1 << 17).mean(axis=1)
    of.learn(5)
    after = found(of, 2, 1 << 17).mean(axis=1)
    errors = [values.std() / len(values) ** 0.5 for values in (before, after)]
    assert abs(before.mean() - after.mean()) < THRESHOLD * np.hypot(*errors)
    assert after.var() < 0.8 * before.var()


def test_techniques_are_chosen_as_often_as_they_say() -> None:
    techniques = Techniques(1, 4)
    rng = np.random.default_rng(1)
    index = rng.integers(0, len(techniques._first), 1000)
    techniques.learn(index, rng.uniform(0, 1, 1000) ** 4)
    x = mi.Float((np.arange(1 << 18, dtype=np.float32) + 0.5) / (1 << 18))
    chosen, length, grown = techniques.choose(x)
    share = np.bincount(chosen.numpy(), minlength=len(techniques._first)) / (1 << 18)
    log = techniques.log_chance(length, grown, mi.Bool(True)).numpy()
    np.testing.assert_allclose(np.exp(log), share[chosen.numpy()], atol=1e-5)
    # Nothing made from the light alone is one segment long
    assert share[0] == 0 and (share[1:] > 0).all()


# ---- Mutations ----


@pytest.mark.parametrize("name", some("caustic_perturbation", of=SWITCHES))
def test_a_single_mutation_keeps_the_mean(name: str) -> None:
    """Chains begin where they belong: what moves them must not bring them elsewhere."""
    scene = mi.load_dict({**stage_with_ball(SPECULAR["glass"]()), "light": EMITTERS["constant"]()},
                         optimize=False)
    only = {key: key == name for key in SWITCHES}
    images = batches(scene, mlt(5, p_large=0.02, **ALONE, **only), 64, range(1, 17))
    expected = batches(scene, path(5), 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spp"), [("lens_perturbation", 64), ("caustic_perturbation", 512)]
)
def test_perturbations_of_a_floor_at_a_small_angle_keep_the_mean(
    name: str, spp: int
) -> None:
    """From the nearest to the farthest part of the floor, the geometric factor of a direction of
    the camera, and of the lamp, changes by orders of magnitude: chains drift where it is missing.
    """
    lamp = {"type": "sphere", "center": [0, 0, 0.3], "radius": 0.05, "emitter": area(5.0)}
    view = lookat([0, -2, 0.25], [0, 0, 0], [0, 0, 1])
    scene = mi.load_dict(stage(block=None, wall=None, light=lamp, camera=sensor(to_world=view)),
                         optimize=False)
    only = {key: key == name for key in SWITCHES}
    chains = mlt(2, p_large=0.0, chains=256, luminance_samples=1 << 14, hide_emitters=True,
                 **ALONE, **only)
    images = batches(scene, chains, spp, range(1, 9))
    hidden = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    expected = batches(scene, hidden, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    # Rows of pixels count the same: light that goes from one to another must be seen
    rows = expected.mean(axis=(0, 2, 3), keepdims=True)
    weights = np.where(rows > 0.01 * rows.max(), 1 / np.maximum(rows, 1e-9), 0)
    assert_same_quarters(images * weights, expected * weights, precision=0.03)


def test_solid_angles_change_at_refraction_as_the_lobe_ratio_says() -> None:
    """The solid angle of a cone of directions, by finite differences."""
    bsdf = mi.load_dict({"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0})
    for cosine in (0.8, -0.8):
        wi = dr.normalize(mi.Vector3f(0.6 + mi.Float(0, 2e-3, 0), mi.Float(0, 0, 2e-3), cosine))
        si = dr.zeros(mi.SurfaceInteraction3f, 3)
        si.wi = wi
        bs, _weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.999), mi.Point2f(0.5), True)
        before, behind = (
            np.linalg.norm(np.cross(d[1] - d[0], d[2] - d[0]))
            for d in (x.numpy().T.astype(np.float64) for x in (wi, bs.wo))
        )
        ratio = np.exp(_lobe_ratio(si, bs).numpy()[0])
        assert (bs.wo.z * cosine < 0).numpy().all()
        assert ratio == pytest.approx(behind / before, rel=0.02)
        assert abs(ratio - 1) > 0.2


_LAMPS = {
    "small lamp": lambda: rectangle(
        T().translate([-0.3, 0, 1.9]).rotate([1, 0, 0], 180).scale([0.3, 0.3, 1]),
        emitter=area(5.0),
    ),
    **{name: EMITTERS[name] for name in ("sphere", "point", "directional", "envmap")},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", _LAMPS)
def test_mutations_keep_caustics(name: str) -> None:
    glass = stage_with_ball(SPECULAR["glass"]())
    scene = mi.load_dict({**glass, "light": _LAMPS[name]()}, optimize=False)
    images = batches(scene, mlt(5, p_large=0.05), 128, range(1, 17))
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 5})
    expected = batches(scene, bdpt, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.02)


@pytest.mark.slow
def test_short_renders_are_right_on_average() -> None:
    """They have one mutation per pixel."""
    scene = mi.load_dict(stage(), optimize=False)
    images = batches(scene, mlt(**ALONE), 1, range(1, 65))
    expected = batches(scene, path(4), 1024, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.01)


def test_directions_are_turned_by_angles_of_which_the_logarithm_is_uniform() -> None:
    x = mi.Point2f(np.random.default_rng(3).random((2, 1 << 14), dtype=np.float32))
    d = dr.normalize(mi.Vector3f(0.3, -0.5, 0.8))
    cosine = dr.dot(turned(d, x, 1e-3, 0.1), d).numpy().astype(np.float64)
    angle = np.arccos(np.minimum(cosine, 1))
    above = angle[angle > 0.01]
    assert len(above) / len(angle) == pytest.approx(0.5, abs=0.02)
    assert above.max() < 0.1001


# ---- What it takes ----


@pytest.mark.slow
def test_an_orthographic_sensor_sees_what_it_sees_with_path() -> None:
    scene = mi.load_dict(stage(camera=sensor("orthographic")), optimize=False)
    images = batches(scene, mlt(**ALONE), 64, range(1, 17))
    expected = batches(scene, path(4), 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.03)


@pytest.mark.slow
def test_camera_samples_find_paths_that_are_too_long_for_chains(monkeypatch) -> None:
    """In a room that reflects half of the light, which is everywhere the same."""
    integrator = mlt(-1, direct_samples=64)
    for module in (path_mutations, sys.modules[type(integrator).__module__]):
        monkeypatch.setattr(module, "MOST", 4)
    room = {"type": "sphere", "radius": 6.0, "flip_normals": True, "emitter": area(1.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    scene = mi.load_dict({"type": "scene", "room": room, "sensor": sensor()})
    images = batches(scene, integrator, 64, range(1, 9))
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 2.0)
    assert abs(z) < THRESHOLD and error < 0.01


def test_statistics_have_rates_of_acceptance() -> None:
    integrator = mlt()
    mi.render(mi.load_dict(stage(), optimize=False), integrator=integrator, spp=64)
    assert "of large steps" in integrator.statistics.learned


# ---- Where water meets a wall ----


def _waterline() -> mi.Scene:
    """The camera sees the line where water meets a wall, from above; a small lamp shines there."""
    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
    return mi.load_dict({
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 8.0, "near_clip": 0.01,
            "to_world": T().look_at([0, -0.9, 0.7], [0, 1, -0.35], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
        "wall": {
            "type": "rectangle", "bsdf": wall,
            "to_world": T().translate([0, 1, 0]).rotate([1, 0, 0], 90),
        },
        "water": {
            "type": "rectangle", "bsdf": {"type": "dielectric", "int_ior": "water"},
            "to_world": T().translate([0, 0, -0.33]),
        },
        "lamp": {
            "type": "sphere", "center": [0.2, 0.1, 0.8], "radius": 0.05,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 100.0}},
        },
    })  # fmt: skip


def test_chains_do_not_stay_where_water_meets_a_wall() -> None:
    # Vertices lie so close to each other there that their points do not tell the ray's direction
    integrator = mi.load_dict({"type": "mlt", "max_depth": 4, "chains": 512})
    mi.render(_waterline(), integrator=integrator, spp=2048, seed=3)
    stayed = re.search(r"stayed at one path for (\d+) of 1024", integrator.statistics.learned)
    assert int(stayed[1]) < 200
