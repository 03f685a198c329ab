"""The renders of ``composed_prb`` learn when they should, and can be repeated and recorded."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.clock import PassClock
from tests.support.gradients import make, small
from tests.support.stage import area, rectangle, stage
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")


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


def test_a_recorded_step_has_the_same_gradient() -> None:
    """The seed may be an array, and the sensor need not be in the scene."""
    described = stage(floor=rectangle(bsdf={"type": "diffuse"}))
    camera = mi.load_dict(described.pop("sensor"))
    scene = mi.load_dict(described, optimize=False)
    parameters, integrator = mi.traverse(scene), make()
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))

    def gradient(value: mi.Float, seed: mi.UInt32) -> mi.Float:
        dr.enable_grad(value)
        parameters[key] = value
        parameters.update()
        image = mi.render(scene, parameters, camera, integrator, seed=seed, spp=4)
        dr.backward(dr.mean(image))
        return dr.grad(value)

    recorded, found = dr.freeze(gradient), []
    for value, seed in ((0.3, 1), (0.4, 2), (0.4, 3)):
        ours, expected = (
            f(dr.opaque(mi.Float, value), dr.opaque(mi.UInt32, seed))[0]
            for f in (recorded, gradient)
        )
        assert ours == pytest.approx(expected, rel=1e-4)
        found.append(ours)
    assert 0 < found[1] != found[2] > 0


@pytest.mark.parametrize(
    "parameters, what",
    [({"directions": "guided"}, "learned decisions"), ({"gradient_samples": "loss"}, "loss")],
    ids=lambda x: "",
)
def test_steps_that_cannot_be_recorded_are_refused(parameters: dict, what: str) -> None:
    scene, integrator = mi.load_dict(stage()), make(**parameters)
    known = mi.traverse(scene)
    key = next(key for key in known.keys() if key.endswith("reflectance.value"))
    dr.enable_grad(known[key])
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope), pytest.raises(NotImplementedError) as error:
        integrator.render(scene, spp=1)
        integrator.render_backward(scene, known, dr.ones(mi.TensorXf, (16, 16, 3)), spp=1)
    assert "dr.freeze cannot record" in str(error.value) and what in str(error.value)


def test_a_timeout_includes_learning(monkeypatch) -> None:
    clock = PassClock(monkeypatch)
    integrator = make(next_event="contribution", timeout=2.0)
    integrator.render(mi.load_dict(stage()), spp=64)
    assert integrator.statistics.learned and clock.now < 2.5


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
