"""Recursive control variates around integrators with gradients: the images are unbiased and less
noisy, and nothing is carried over where it does not belong."""

from __future__ import annotations

import re
import threading
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.recursive_estimate import RecursiveEstimate
from mitsuba_ext.util.errors import one_line
from tests.support.stage import area, film, rectangle, sensor, stage
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

_DEPTH = 3


def plain(name: str = "path", **parameters: Any) -> dict[str, Any]:
    return {"type": name, "max_depth": _DEPTH, **parameters}


def wrapped(nested: dict[str, Any] | None = None, **parameters: Any) -> mi.Integrator:
    nested = nested or plain()
    return mi.load_dict({"type": "control_variate", "nested": nested, **parameters})


def small(size: tuple[int, int] = (12, 8), **changes: Any) -> mi.Scene:
    return mi.load_dict(stage(camera=sensor(film=film(*size)), **changes), optimize=False)


def seed_after(seed: int) -> mi.UInt32:
    return mi.sample_tea_32(mi.UInt32(seed), 0x637626C5)[0]


def floor_of(scene: mi.Scene) -> tuple[mi.SceneParameters, str]:
    parameters, end = mi.traverse(scene), "floor.bsdf.reflectance.value"
    return parameters, next(key for key in parameters.keys() if key.endswith(end))


def test_where_nothing_changes_the_image_is_the_mean_of_all_renders() -> None:
    scene, integrator = small(), wrapped()
    path, single = mi.load_dict(plain()), []
    for step in range(5):
        image = mi.render(scene, integrator=integrator, seed=step, spp=4).numpy()
        seed = 0 if step == 0 else seed_after(step - 1)
        single.append(path.render(scene, seed=seed, spp=4).numpy())
        np.testing.assert_allclose(image, np.mean(single, axis=0), rtol=1e-4, atol=1e-5)
        weight = integrator.weight.numpy()
        is_noisy = np.var(single, axis=0) > 1e-8
        np.testing.assert_allclose(weight[is_noisy], step / (step + 1), rtol=1e-3)


@pytest.mark.parametrize(
    "is_rare, runs", [(False, 16), pytest.param(True, 150, marks=pytest.mark.slow)]
)
def test_images_of_a_changing_scene_are_unbiased_and_less_noisy(is_rare: bool, runs: int) -> None:
    """With rare light, the noise is far from normal: weights that favour dark values would show.
    It comes from a small lamp that few of the paths find."""
    lamp = rectangle(
        mi.ScalarTransform4f().translate([0.3, -0.5, 0.1]).rotate([1, 0, 0], 180).scale(0.05),
        emitter=area(300.0),
    )
    scene = small((24, 16), **({"small_lamp": lamp} if is_rare else {}))
    parameters, key = floor_of(scene)
    path, integrator = mi.load_dict(plain()), wrapped()
    images, single = [], []
    for run in range(runs):
        integrator.forget()
        for step in range(8):
            parameters[key] = mi.Color3f(0.3 * 1.05**step)
            parameters.update()
            seed = 1000 * run + step
            image = mi.render(scene, integrator=integrator, seed=seed, spp=2).numpy()
        images.append(image)
        single.append(path.render(scene, seed=seed + 500, spp=2).numpy())
    expected = np.mean([path.render(scene, seed=10**6 + i, spp=4096).numpy() for i in range(4)], 0)
    # 1 / 8 if the scene did not change
    ours, theirs = (np.var(each, axis=0, ddof=1).mean() for each in (images, single))
    assert ours < 0.3 * theirs
    means = np.mean(images, axis=(1, 2))
    error = np.std(means, axis=0, ddof=1) / np.sqrt(runs)
    expected = expected.mean(axis=(0, 1))
    assert (error < 0.015 * expected).all()
    z = (means.mean(axis=0) - expected) / error
    assert np.abs(z).max() < 4, z


def test_gradients_are_those_of_the_nested_integrator() -> None:
    scene = small()
    parameters, key = floor_of(scene)
    found = []
    for integrator in (wrapped(plain("prb")), mi.load_dict(plain("prb"))):
        for seed in range(2):
            dr.enable_grad(parameters[key])
            dr.set_grad(parameters[key], 0)
            parameters.update()
            image = mi.render(scene, parameters, integrator=integrator, seed=seed, spp=8)
            dr.backward(dr.mean(image))
        found.append(dr.grad(parameters[key]).numpy())
        step = mi.Float(0)
        dr.enable_grad(step)
        parameters[key] = mi.Color3f(0.5) + step
        parameters.update()
        dr.forward(step, dr.ADFlag.ClearEdges)
        image = mi.render(scene, parameters, integrator=integrator, seed=1, spp=8)
        found.append(dr.forward_to(image).numpy())
        parameters[key] = mi.Color3f(0.5)
        parameters.update()
    assert (found[0] > 0).all() and (found[1] > 0).any()
    np.testing.assert_allclose(found[0], found[2], rtol=1e-4)
    np.testing.assert_allclose(found[1], found[3], rtol=1e-3, atol=1e-6)


def test_each_sensor_has_an_image_of_its_own() -> None:
    cameras = {f"camera{i}": sensor(film=film(8 + i, 8)) for i in range(3)}
    scene = mi.load_dict({**stage(), "sensor": None, **cameras} | {"sensor": cameras["camera0"]},
                         optimize=False)  # fmt: skip
    integrator = wrapped(max_sensors=2)

    def weights(*views: int) -> list[float]:
        found = []
        for view in views:
            integrator.render(scene, view, seed=view, spp=1)
            found.append(float(integrator.weight.numpy().max()))
        return found

    assert weights(0, 1, 0, 1) == [0, 0, 0.5, 0.5]
    # The third takes the place of the one that was not used for the longest time
    assert weights(2, 1, 0) == [0, pytest.approx(2 / 3), 0]
    integrator.forget()
    assert weights(0) == [0]


def test_other_samples_or_another_scene_begin_anew() -> None:
    scene, integrator = small(), wrapped()
    camera = scene.sensors()[0]
    parameters = mi.traverse(camera)

    def weight(of: mi.Scene = scene, spp: int = 2) -> float:
        image = integrator.render(of, camera, seed=3, spp=spp)
        assert image.shape == (*reversed(camera.film().crop_size()), 3)
        return float(integrator.weight.numpy().max())

    assert [weight(), weight()] == [0, 0.5]
    assert [weight(spp=4), weight(spp=4)] == [0, 0.5]
    for key, value in (("film.size", [10, 6]), ("film.crop_size", [5, 4]),
                       ("film.crop_offset", [1, 2])):  # fmt: skip
        parameters[key] = value
        parameters.update()
        assert [weight(), weight()] == [0, 0.5], key
    other = small()
    assert [weight(other), weight(other), weight()] == [0, 0.5, 0]


def test_a_step_that_is_interrupted_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, integrator = small(), wrapped(plain("composed_prb"))
    for seed in range(2):
        integrator.render(scene, seed=seed, spp=1)
    assert integrator.weight.numpy().max() == 0.5

    def interrupt(*_arguments: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(integrator.nested, "render", interrupt)
        with pytest.raises(KeyboardInterrupt):
            integrator.render(scene, seed=2, spp=1)
    integrator.render(scene, seed=3, spp=1)
    assert integrator.weight.numpy().max() == 0


def test_values_that_are_not_finite_do_not_stay_in_the_image() -> None:
    """A reflectance that is not a number in one step has no effect on the images of later ones."""
    scene, integrator = small(), wrapped()
    parameters, key = floor_of(scene)
    for step in range(5):
        parameters[key] = mi.Color3f(float("nan") if step == 1 else 0.5)
        parameters.update()
        image = mi.render(scene, integrator=integrator, seed=step, spp=4).numpy()
        # The control variate of step 2 was rendered in step 1
        assert np.isfinite(image).all() == (step != 1), step
        weight = integrator.weight.numpy()
        assert np.isfinite(weight).all()
    assert (weight > 0.3).all()


def test_what_composed_prb_learns_again_does_not_part_two_renders() -> None:
    """Both renders of equal random numbers know the same, so that they are equal."""
    lamps = {
        f"lamp{x}": rectangle(
            mi.ScalarTransform4f().translate([x - 1, 0, 2]).rotate([1, 0, 0], 180).scale(0.2),
            emitter=area(3.0 * x + 1),
        )
        for x in range(3)
    }
    scene = small(**lamps)
    integrator = wrapped(plain("composed_prb", next_event="contribution", learn_every=3))
    known = []
    for step in range(7):
        integrator.render(scene, seed=step, spp=16)
        known.append(integrator.nested.learned)
        # The scene does not change. Any difference of renders would lower the weight
        assert integrator.weight.numpy().max() == pytest.approx(step / (step + 1), rel=1e-3)
    assert len({id(each) for each in known}) >= 3
    # What is learned in between parts them: the step begins anew
    integrator.nested.forget()
    integrator.render(scene, seed=9, spp=16)
    assert integrator.weight.numpy().max() == 0


def test_threads_take_turns() -> None:
    cameras = {f"camera{i}": sensor(film=film(8 + i, 8)) for i in range(2)}
    scene = mi.load_dict({**stage(camera=cameras["camera0"]), **cameras}, optimize=False)
    integrator, images = wrapped(), {}

    def optimize(view: int) -> None:
        for seed in range(3):
            images[view] = integrator.render(scene, view, seed=seed, spp=2).numpy()

    threads = [threading.Thread(target=optimize, args=(view,)) for view in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    both = dict(images)
    integrator.forget()
    for view in (0, 1):
        optimize(view)
        np.testing.assert_allclose(both[view], images[view], rtol=1e-4, atol=1e-6)


def test_films_of_all_sizes_share_kernels() -> None:
    def step_through(*shape: int) -> None:
        estimate, numbers = RecursiveEstimate(), mi.PCG32(int(np.prod(shape)))
        for _ in range(4):
            assert np.isfinite(estimate.add(mi.TensorXf(numbers.next_float32(), shape))).all()
            estimate.prepare(mi.TensorXf(numbers.next_float32(), shape))

    step_through(5, 4, 3)
    before = dr.detail.launch_stats()
    for shape in ((6, 7, 3), (2, 9, 4), (31, 17, 1)):
        step_through(*shape)
    assert dr.detail.launch_stats()[1:] == before[1:]


def test_what_cannot_work_is_refused() -> None:
    scene = small()
    with pytest.raises(ValueError, match='"control_variate": .* develop must be True'):
        wrapped().render(scene, develop=False)
    with pytest.raises(ValueError, match="no sensor 1"):
        wrapped().render(scene, sensor=1)
    learns = plain("composed_prb", next_event="contribution", learn_every=2)
    for parameters, message in (
        ({"a": plain(), "b": plain()}, "at most one integrator"),
        ({"a": {"type": "control_variate", "b": plain()}}, "at most one integrator"),
        ({"a": {"type": "path"}, "max_depth": 3}, 'uses the parameter "max_depth"'),
        ({"a": learns}, 'set its "learn_every" to 0, or to 3 or more, found 2'),
        ({"a": plain(), "max_sensors": 0}, '"max_sensors" is 0'),
        ({"a": plain(), "spp": 4}, 'no parameter "spp"'),
        ({"a": plain("neepp", checkpoint="a")}, "checkpoint"),
        ({"type": "moment", "a": {"type": "control_variate", "b": plain()}}, "SamplingIntegrator"),
    ):
        with pytest.raises(RuntimeError) as error:
            mi.load_dict({"type": "control_variate", **parameters})
        assert re.search(message, one_line(error.value)), one_line(error.value)


def test_by_default_samples_follow_lights_and_the_loss() -> None:
    described = str(mi.load_dict({"type": "control_variate", "max_depth": 3}))
    for words in ("composed_prb", "max_depth = 3", "contribution", "gradient_samples = loss"):
        assert words in described, described


@pytest.mark.slow
def test_an_optimization_has_less_noise() -> None:
    scene = load("rooms", width=48, height=27)
    parameters = mi.traverse(scene)
    keys = [key for key in parameters.keys() if key.endswith("reflectance.value")]
    target = mi.render(scene, integrator=mi.load_dict(plain()), spp=1024)
    losses = []
    for integrator in (mi.load_dict(plain("prb")), wrapped(plain("prb"))):
        optimizer = mi.ad.Adam(lr=0.02)
        for key in keys:
            optimizer[key] = mi.Color3f(0.4)
        for step in range(30):
            parameters.update(optimizer)
            image = mi.render(scene, parameters, integrator=integrator, seed=step, spp=2)
            loss = dr.mean(dr.square((image - target) / (target + 0.01)), axis=None)
            dr.backward(loss)
            optimizer.step()
            for key in keys:
                optimizer[key] = dr.clip(optimizer[key], 0.01, 0.99)
        losses.append(loss.array[0])
    assert losses[1] < 0.3 * losses[0]
