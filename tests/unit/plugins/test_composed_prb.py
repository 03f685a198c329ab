"""The gradients of ``composed_prb`` agree with ``prb`` and with finite differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.gradients import (
    KINDS,
    backward,
    difference,
    keys_of,
    loss_weights,
    make,
    room,
    small,
)
from tests.support.stage import diffuse, film, lookat, rectangle, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("more", [{}, {"hide_emitters": True, "rr_depth": 1}], ids=str)
def test_with_all_defaults_gradients_agree_with_prb(more: dict[str, Any]) -> None:
    """They use the same random numbers, unless a roughness is optimized, and roulette begins at the
    same vertex."""
    scene = room()
    parameters = small(scene)
    keys = [key for key in keys_of(parameters) if "alpha" not in key]
    ours, theirs = (
        backward(scene, parameters, keys, make(name, **more), 3, 64)
        for name in ("composed_prb", "prb")
    )
    for key, found, expected in zip(keys, ours, theirs):
        scale = np.abs(expected).max()
        assert scale > 0, key
        np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.005 * scale, err_msg=key)


def _crop() -> dict[str, Any]:
    return sensor(film=film(16, 12, crop_width=8, crop_height=6, crop_offset_x=3, crop_offset_y=4))


def _batch() -> dict[str, Any]:
    other = lookat([1, -4, 1.2], [0, 0, 0.6], [0, 0, 1])
    return {"type": "batch", "film": film(16, 8), "sampler": {"type": "independent"},
            "left": sensor(film=film(8, 8)), "right": sensor(to_world=other, film=film(8, 8))}


@pytest.mark.parametrize("camera, moment", [(_crop, False), (_batch, False), (sensor, True)])
def test_crop_windows_batches_and_moments_have_gradients(camera: Any, moment: bool) -> None:
    scene = mi.load_dict(stage(camera=camera()), optimize=False)
    parameters = mi.traverse(scene)
    key = next(key for key in parameters.keys() if key.endswith("floor.bsdf.reflectance.value"))
    found = []
    for name in ("composed_prb", "prb"):
        plugin = {"type": name, "max_depth": 3}
        integrator = mi.load_dict({"type": "moment", "nested": plugin} if moment else plugin)
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, seed=2, spp=16)
        dr.backward(dr.mean(image[..., -3:]))
        found.append(dr.grad(parameters[key]).numpy())
    assert (found[0] > 0).all()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


def _floor_of(bsdf: dict[str, Any]) -> mi.Scene:
    """Seen from above, below a bright and a dark half of the sky, and above a white wall."""
    T = mi.ScalarTransform4f
    sky = mi.Bitmap(np.linspace(0.2, 2, 24, dtype=np.float32).reshape(2, 4, 3))
    return mi.load_dict(
        stage(floor=rectangle(T().scale(2), bsdf=bsdf), sky={"type": "envmap", "bitmap": sky},
              wall=rectangle(T().translate([0, 0, -1]).scale(3), bsdf=diffuse(0.9))),
        optimize=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    "bsdf, end",
    [
        ({"type": "conductor", "material": "Cu"}, "eta.value"),
        ({"type": "plastic", "specular_reflectance": 0.8}, "specular_reflectance.value"),
        ({"type": "dielectric", "specular_transmittance": 0.7}, "specular_transmittance.value"),
        ({"type": "mask", "opacity": 0.4, "bsdf": {"type": "diffuse"}}, "opacity.value"),
        ({"type": "mask", "opacity": 0.4, "bsdf": {"type": "dielectric"}}, "opacity.value"),
        ({"type": "blendbsdf", "weight": 0.4, "a": {"type": "conductor", "material": "Au"},
          "b": {"type": "thindielectric"}}, "weight.value"),
    ],
    ids=lambda x: x["type"] if isinstance(x, dict) else "",
)  # fmt: skip
def test_mirrors_smooth_glass_and_masks_have_gradients(bsdf: dict[str, Any], end: str) -> None:
    """``prb`` has none."""
    scene = _floor_of(bsdf)
    parameters = small(scene)
    (key,) = (k for k in parameters.keys() if k.startswith("floor.bsdf") and k.endswith(end))
    found = backward(scene, parameters, [key], make(max_depth=4), 3, 256)[0].sum()
    expected = difference(scene, parameters, key, make("composed_path", max_depth=4))
    assert found == pytest.approx(expected, rel=0.12)


LEARNED = (
    {"next_event": "contribution", "pilot_spp": 32},
    {"directions": {"type": "guided_directions", "always_guide": True}, "pilot_spp": 32},
    {"next_event": "power", "mis": "balance", "connections": 2},
    {"shadow_test": "visibility_roulette", "roulette": "throughput"},
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "decisions, optimized",
    [*((decisions, KINDS) for decisions in LEARNED), (LEARNED[0], KINDS[3:4])],
    ids=lambda each: next(iter(each)),
)
def test_decisions_do_not_change_the_expected_gradient(
    decisions: dict[str, Any], optimized: tuple[str, ...]
) -> None:
    scene = room()
    parameters = small(scene)
    keys = [key for key in keys_of(parameters) if key.endswith(optimized)]
    integrator = make(**decisions)
    ours = [backward(scene, parameters, keys, integrator, seed, 256) for seed in range(12)]
    prb = make("prb")
    theirs = [backward(scene, parameters, keys, prb, seed, 512) for seed in range(100, 112)]
    for index, key in enumerate(keys):
        found, expected = (
            np.array([each[index].sum() for each in several]) for several in (ours, theirs)
        )
        error = np.sqrt(found.var(ddof=1) / len(found) + expected.var(ddof=1) / len(expected))
        assert abs(found.mean() - expected.mean()) < 4.5 * error, key
        precision = 0.3 if "alpha" in key else 0.05
        assert error < precision * abs(expected.mean()), key


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lamp.emitter.radiance.value", "metal.bsdf.alpha.value"])
def test_forward_and_backward_mode_agree_with_finite_differences(kind: str) -> None:
    scene = room()
    parameters = small(scene)
    (key,) = (key for key in parameters.keys() if key.endswith(kind))
    integrator, seeds, spp = make(next_event="contribution"), range(6), 1024
    start = type(parameters[key])(parameters[key])

    def forward(seed: int) -> float:
        step = mi.Float(0)
        dr.enable_grad(step)
        parameters[key] = start + step
        parameters.update()
        image = mi.render(
            scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=spp
        )
        dr.forward(step)
        return float(dr.mean(dr.grad(image) * loss_weights(), axis=None).array[0])

    def loss(value: float, seed: int) -> float:
        parameters[key] = start + value
        parameters.update()
        image = mi.render(scene, integrator=make("path"), seed=seed, spp=spp)
        return float(dr.mean(image * loss_weights(), axis=None).array[0])

    forwards = [forward(seed) for seed in seeds]
    parameters[key] = start
    parameters.update()
    backwards = [
        backward(scene, parameters, [key], integrator, seed, spp)[0].sum() for seed in seeds
    ]
    h = 0.02
    differences = [(loss(h, seed) - loss(-h, seed)) / (2 * h) for seed in seeds]
    expected = np.mean(differences)
    for found in (forwards, backwards):
        error = np.hypot(np.std(found, ddof=1), np.std(differences, ddof=1)) / np.sqrt(len(seeds))
        assert abs(np.mean(found) - expected) < 4.5 * error + 0.01 * abs(expected)


def test_light_in_the_mirror_of_a_plastic_has_no_gradient_of_its_diffuse_lobe() -> None:
    """``prb`` counts it as light of this lobe."""
    scene = mi.load_dict(
        stage(floor=rectangle(mi.ScalarTransform4f().scale(2), bsdf={"type": "plastic"}),
              sky={"type": "constant"}),
        optimize=False,
    )  # fmt: skip
    parameters = small(scene)
    (key,) = (k for k in parameters.keys() if k.endswith("floor.bsdf.diffuse_reflectance.value"))
    found = backward(scene, parameters, [key], make(max_depth=2), 3, 512)[0].sum()
    expected = difference(scene, parameters, key, make("path", max_depth=2))
    assert found == pytest.approx(expected, rel=0.03)


def test_black_objects_have_a_gradient() -> None:
    """A connection that carries nothing may have a derivative nonetheless."""
    scene = mi.load_dict(stage(floor=rectangle(mi.ScalarTransform4f().scale(2),
                                               bsdf=diffuse(0.0))), optimize=False)  # fmt: skip
    parameters = small(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("floor.bsdf.reflectance.value"))
    ours, theirs = (
        backward(scene, parameters, [key], make(name), 3, 64)[0]
        for name in ("composed_prb", "prb")
    )
    assert (theirs > 0).all()
    np.testing.assert_allclose(ours, theirs, rtol=0.02)
