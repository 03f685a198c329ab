"""The gradients of ``composed_prb`` agree with ``prb`` and with finite differences."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.util.errors import one_line
from tests.support.stage import (
    area,
    bitmap,
    diffuse,
    film,
    lookat,
    rectangle,
    rgb,
    sensor,
    stage,
)
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

#: Which image gradients the loss has.
_SHAPE = (12, 16, 3)


def make(name: str = "composed_prb", **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 4, **parameters})


def room() -> mi.Scene:
    """Materials, a texture, a rough metal, a lamp and an environment map, all of which have
    gradients."""
    pixels = np.random.default_rng(1).uniform(0.2, 0.8, (2, 3, 3))
    sky = np.random.default_rng(2).uniform(0.5, 1.5, (4, 8, 3))
    texture = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    T = mi.ScalarTransform4f
    return mi.load_dict(
        stage(
            floor=rectangle(T().scale(2), bsdf={"type": "diffuse", "reflectance": texture}),
            metal={
                "type": "sphere", "center": [-0.5, 0.2, 0.5], "radius": 0.4,
                "bsdf": {"type": "roughconductor", "alpha": 0.3,
                         "specular_reflectance": rgb(0.6, 0.7, 0.8)},
            },
            lamp=rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(0.3),
                           emitter=area(8.0)),
            sky={"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))},
        ),
        optimize=False,
    )  # fmt: skip


#: A parameter of each kind: the end of its name.
KINDS = (
    "floor.bsdf.reflectance.data", "metal.bsdf.alpha.value",
    "metal.bsdf.specular_reflectance.value", "lamp.emitter.radiance.value", "sky.data",
)  # fmt: skip


def small(scene: mi.Scene) -> mi.SceneParameters:
    parameters = mi.traverse(scene)
    for key in parameters.keys():
        if key.endswith("film.size"):
            parameters[key] = [_SHAPE[1], _SHAPE[0]]
    parameters.update()
    return parameters


def loss_weights() -> mi.TensorXf:
    weights = np.random.default_rng(5).uniform(0.5, 1.5, _SHAPE)
    return mi.TensorXf(weights.astype(np.float32))


def backward(scene, parameters, keys, integrator, seed: int, spp: int) -> list[np.ndarray]:
    # Copies: the environment map keeps one with another column
    values = [type(parameters[key])(dr.detach(parameters[key])) for key in keys]
    for key, value in zip(keys, values):
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    image = mi.render(
        scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=spp
    )
    dr.backward(dr.mean(image * loss_weights(), axis=None))
    for key in keys:
        parameters[key] = dr.detach(parameters[key])
    parameters.update()
    return [np.array(dr.grad(value)).ravel() for value in values]


def keys_of(parameters: mi.SceneParameters) -> list[str]:
    found = [key for kind in KINDS for key in parameters.keys() if key.endswith(kind)]
    assert len(found) == len(KINDS), list(parameters.keys())
    return found


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


def difference(
    scene: mi.Scene, parameters: mi.SceneParameters, key: str, integrator: mi.Integrator
) -> float:
    """The derivative of the same loss by finite differences."""
    start, h, losses = type(parameters[key])(parameters[key]), 0.05, []
    for step in (h, -h):
        parameters[key] = start + step
        parameters.update()
        image = mi.render(scene, integrator=integrator, seed=4, spp=512)
        losses.append(float(dr.mean(image * loss_weights(), axis=None).array[0]))
    parameters[key] = start
    parameters.update()
    return (losses[0] - losses[1]) / (2 * h)


def _said_after_a_step(capfd, bsdf: dict[str, Any], end: str, assigns: bool) -> str:
    scene = mi.load_dict(stage(floor=rectangle(bsdf=bsdf)), optimize=False)
    parameters, integrator = mi.traverse(scene), make()
    key = next(key for key in parameters.keys() if key.endswith(end))
    dr.enable_grad(parameters[key])
    if assigns:
        parameters[key] = parameters[key]
        parameters.set_dirty(key)
        parameters.update()
    capfd.readouterr()
    for seed in range(2):
        image = mi.render(scene, parameters, integrator=integrator, seed=seed, spp=4)
        dr.backward(dr.mean(image))
    said = capfd.readouterr()
    return said.out + said.err


@pytest.mark.parametrize("assigns", [False, True])
def test_a_warning_names_parameters_without_gradients_once(capfd, assigns: bool) -> None:
    """Mitsuba's ``principled`` computes its refractive index when ``specular`` is updated."""
    said = _said_after_a_step(capfd, {"type": "principled"}, "specular", assigns)
    assert said.count("no sample") == said.count("floor.bsdf.specular") == (not assigns)


def test_optimizing_two_sets_of_parameters_in_turns_warns_once(capfd) -> None:
    scene = mi.load_dict(stage(floor=rectangle(bsdf={"type": "principled", "clearcoat": 0.0})))
    parameters, integrator = mi.traverse(scene), make()
    keys = [key for key in parameters.keys() if key.endswith(("clearcoat.value", "color.value"))]
    assert len(keys) == 2
    capfd.readouterr()
    for step in range(4):
        key = keys[step % 2]
        dr.enable_grad(parameters[key])
        parameters.set_dirty(key)
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator, spp=4)))
        dr.disable_grad(parameters[key])
    said = capfd.readouterr()
    assert (said.out + said.err).count("no sample") == 1


def test_a_recorded_step_has_the_same_gradient() -> None:
    scene = mi.load_dict(stage(floor=rectangle(bsdf={"type": "diffuse"})), optimize=False)
    parameters, integrator = mi.traverse(scene), make()
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))

    def gradient(value: mi.Float) -> mi.Float:
        dr.enable_grad(value)
        parameters[key] = value
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator, spp=4)))
        return dr.grad(value)

    recorded = dr.freeze(gradient)
    for value in (0.3, 0.4):
        found, expected = (f(dr.opaque(mi.Float, value)) for f in (recorded, gradient))
        assert found[0] == pytest.approx(expected[0], rel=1e-4) and found[0] > 0


def test_a_warning_names_blends_with_a_mirror(capfd) -> None:
    blend = {"type": "blendbsdf", "id": "rust", "a": {"type": "diffuse"}, "weight": 0.4,
             "b": {"type": "conductor"}}  # fmt: skip
    assert _said_after_a_step(capfd, blend, "weight.value", True).count("image: rust") == 1


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


@pytest.mark.slow
def test_the_image_agrees_with_composed_path_and_later_renders_learn_nothing() -> None:
    scene = load("rooms", width=48, height=27)
    ours, path = (
        np.array(make(name, next_event="power").render(scene, spp=8, seed=4))
        for name in ("composed_prb", "composed_path")
    )
    np.testing.assert_allclose(ours, path, rtol=1e-3)
    integrator = make(next_event="contribution", learn_every=3)
    known = []
    for _ in range(5):
        integrator.render(scene, spp=32, seed=4)
        assert integrator.statistics.learned.startswith("lights: ")
        assert integrator.statistics.passes == 1  # pilots are not part of the image
        known.append(integrator.learned)
        if len(known) == 4:
            integrator.forget()
    assert known[0] is known[1] is known[2] is not known[3] is not known[4]


def test_where_one_of_several_lights_is_optimized_it_is_chosen_more_often() -> None:
    """The passes for gradients learn for themselves, once."""
    T = mi.ScalarTransform4f
    lamps = {
        f"lamp{x}": rectangle(
            T().translate([x - 1.5, 0, 2]).rotate([1, 0, 0], 180).scale(0.2),
            emitter=area(0.2 if x == 2 else 8.0),
        )
        for x in range(4)
    }
    scene = mi.load_dict(stage(floor=rectangle(T().scale(2)), **lamps), optimize=False)
    parameters = small(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("lamp2.emitter.radiance.value"))
    integrator = make(next_event="contribution", learn_every=8)
    learned = []

    def gradient(seed: int) -> float:
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
        image = mi.render(
            scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 500, spp=64
        )
        dr.backward(dr.mean(image, axis=None))
        learned.append(integrator.gradient_statistics.passes)
        integrator.gradient_statistics.passes = 0
        return float(dr.sum(dr.grad(parameters[key]))[0])

    ours = [gradient(seed) for seed in range(16)]
    assert all(passes > 1 for passes in learned[::8]) and sum(p > 0 for p in learned) == 2
    integrator = make(next_event="contribution", learn_every=8)
    for other in parameters.keys():
        if other.endswith("radiance.value"):
            dr.enable_grad(parameters[other])
    # Where all of them are, what is best for the image is used
    theirs = [gradient(seed) for seed in range(16)]
    assert not any(learned[16:])
    assert np.var(ours, ddof=1) < 0.5 * np.var(theirs, ddof=1)
    assert abs(np.mean(ours) - np.mean(theirs)) < np.std(theirs)


def test_the_number_of_renders_after_which_it_learns_again_doubles() -> None:
    scenes = [mi.load_dict(stage(), optimize=False) for _ in range(2)]
    integrator, known = make(next_event="contribution", learn_every=1), []
    for scene in [scenes[0]] * 16 + [scenes[1]] * 2:
        integrator.render(scene, spp=1)
        known.append(integrator.learned)
    changes = [i for i, (now, then) in enumerate(zip(known, [None, *known])) if now is not then]
    assert changes == [0, 1, 3, 7, 15, 16, 17]


def test_gradients_of_another_scene_in_memory_refuse_no_render() -> None:
    optimized, other = (mi.load_dict(stage(), optimize=False) for _ in range(2))
    parameters = small(optimized)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
    dr.enable_grad(parameters[key])
    parameters.update()
    plain = mi.load_dict({"type": "composed_path", "max_depth": 3})
    with pytest.raises(NotImplementedError, match="does not compute gradients"):
        plain.render(optimized, spp=1)
    assert plain.render(other, spp=1).numpy().mean() > 0


@pytest.mark.parametrize("end", ["floor.to_world", "vertex_texcoords"])
def test_geometry_and_decisions_without_gradients_are_refused(end: str) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    parameters = small(scene)
    key = next(key for key in parameters.keys() if key.endswith(end))
    with pytest.raises(RuntimeError) as error:
        dr.enable_grad(getattr(parameters[key], "matrix", parameters[key]))
        parameters.update()
        image = mi.render(scene, parameters, integrator=make(), spp=1)
        dr.backward(dr.mean(image, axis=None))
    causes = [one_line(error.value), str(error.value.__cause__)]
    assert any("which changes geometry" in text for text in causes), causes
    for parameters, message in (
        ({"next_event": "resampled"}, 'no gradients with the "resampled_lights"'),
        ({"directions": "swarm"}, "no gradients"),
        ({"aovs": "d:depth"}, 'no parameter "aovs"'),
    ):
        with pytest.raises(RuntimeError, match=message):
            make(**parameters)


@pytest.mark.parametrize("with_gradients", [False, True])
def test_a_scene_with_its_own_renders_again_and_is_freed(with_gradients: bool) -> None:
    """The integrator held the scene, which holds the integrator: Dr.Jit searched both for arrays
    without an end, and neither was freed."""
    learns = {"directions": "guided", "next_event": "contribution", "pilot_spp": 4}
    described = stage()
    described["integrator"] = {"type": "composed_prb", "max_depth": 3, **learns}
    ids = []
    for _ in range(4):
        scene = mi.load_dict(described, optimize=False)
        parameters = mi.traverse(scene)
        key = next(k for k in parameters.keys() if k.endswith("reflectance.value"))
        for seed in range(3):
            if with_gradients:
                dr.enable_grad(parameters[key])
                dr.backward(dr.mean(mi.render(scene, parameters, seed=seed, spp=8)))
                assert np.isfinite(dr.grad(parameters[key]).numpy()).all()
            else:
                assert np.isfinite(mi.render(scene, seed=seed, spp=8).numpy()).all()
        pointer = mi.BSDFPtr(scene.shapes()[0].bsdf())
        ids.append(int(dr.reinterpret_array(mi.UInt32, pointer)[0]))
        del scene, parameters, pointer
        gc.collect()
    assert len(set(ids)) < len(ids), "the scenes are kept: no BSDF gets the id of one that is gone"
