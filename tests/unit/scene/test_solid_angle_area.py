"""Images with ``solid_angle_area`` have the mean of images with ``area``; its parameters, and its
errors."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.near_lights import NAME, SHAPES, lanes, light, shape
from tests.support.stage import bitmap, diffuse, film, rgb, sensor, stage
from tests.support.statistical import assert_same_quarters, batches, one_thread

pytestmark = pytest.mark.usefixtures("variant")

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


@pytest.mark.parametrize("name", [pytest.param("cube", marks=pytest.mark.slow), "sphere"])
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
