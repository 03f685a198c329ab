"""Gradients of ``composed_prb`` from more samples where the loss depends on the image."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.loss_samples import loss_samples
from mitsuba_ext.rendering.pixel_sensitivity import PixelSensitivity
from tests.support.stage import area, film, rectangle, rgb, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")

ENDS = (
    "floor.bsdf.reflectance.value", "metal.bsdf.alpha.value", "lamp.emitter.radiance.value"
)  # fmt: skip


def room(**of_film: Any) -> mi.Scene:
    T = mi.ScalarTransform4f
    metal = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": rgb(0.6, 0.7, 0.8)}
    return mi.load_dict(
        stage(
            camera=sensor(film=film(16, 12, **of_film)),
            metal={"type": "sphere", "center": [-0.5, 0.2, 0.5], "radius": 0.4, "bsdf": metal},
            lamp=rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(0.3),
                           emitter=area(8.0)),
        ),
        optimize=False,
    )  # fmt: skip


def integrator(name: str = "composed_prb", **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 3, **parameters})


def gradients(
    scene: mi.Scene, by: mi.Integrator, derivative: np.ndarray, seed: int, spp: int = 16,
    ends: tuple[str, ...] = ENDS,
) -> np.ndarray:  # fmt: skip
    """The sum over the channels of each parameter's gradient."""
    parameters = mi.traverse(scene)
    keys = [next(k for k in parameters.keys() if k.endswith(end)) for end in ends]
    for key in keys:
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
    parameters.update()
    by.render_backward(scene, parameters, mi.TensorXf(derivative), seed=seed, spp=spp)
    found = [np.array(dr.grad(parameters[key])).sum() for key in keys]
    dr.disable_grad([parameters[key] for key in keys])
    return np.array(found)


def loss_of(scene: mi.Scene, mask: bool = True) -> np.ndarray:
    """The derivative of a loss that depends on a part of the image, unevenly."""
    height, width = scene.sensors()[0].film().crop_size()[::-1]
    weights = np.random.default_rng(3).uniform(-0.5, 1.5, (height, width, 3)) ** 3
    if mask:
        weights[: height // 2] = weights[:, : width // 4] = 0
    return (weights / weights.size).astype(np.float32)


@pytest.mark.parametrize(
    "of_film",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"rfilter": {"type": "gaussian"}}, marks=pytest.mark.slow),
        pytest.param({"rfilter": {"type": "tent"}, "sample_border": True}, marks=pytest.mark.slow),
        {"crop_width": 9, "crop_height": 8, "crop_offset_x": 3, "crop_offset_y": 4,
         "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"},
    ],
    ids=["box", "gaussian", "border", "crop"],
)  # fmt: skip
def test_the_expected_gradient_does_not_change(of_film: dict[str, Any]) -> None:
    scene = room(**of_film)
    derivative = loss_of(scene)
    if of_film.get("pixel_format") == "luminance":
        derivative = derivative[..., :1].copy()
    ours, theirs = (
        np.array([gradients(scene, by, derivative, seed) for seed in seeds])
        for by, seeds in (
            (integrator(gradient_samples="loss"), range(12)),
            (integrator("prb"), range(100, 112)),
        )
    )
    variances = [each.var(axis=0, ddof=1) for each in (ours, theirs)]
    error = np.sqrt(sum(variances) / 12)
    z = (ours.mean(axis=0) - theirs.mean(axis=0)) / error
    assert np.abs(z).max() < 4.5, z
    precision = error / np.abs(theirs.mean(axis=0))
    assert precision[0] < 0.03 and precision[2] < 0.05
    if not of_film:  # and more than half of the pixels have no effect
        assert np.mean(np.log(variances[0] / variances[1])) < np.log(0.8)


def test_samples_follow_what_is_optimized() -> None:
    """A ball that covers a tenth of the image gets half of the samples."""
    scene, ends, seeds = room(), ("metal.bsdf.specular_reflectance.value",), range(12)
    derivative = loss_of(scene, mask=False)
    ours, evenly = (
        np.array([gradients(scene, by, derivative, seed, 8, ends) for seed in seeds])
        for by in (integrator(gradient_samples="loss"), integrator())
    )
    variances = [each.var(axis=0, ddof=1) for each in (ours, evenly)]
    error = np.sqrt(sum(variances) / len(seeds))
    assert (np.abs(ours.mean(axis=0) - evenly.mean(axis=0)) < 4 * error).all()
    assert variances[0] < 0.5 * variances[1]


def test_sensitivity_is_measured_less_and_less_often() -> None:
    view = PixelSensitivity()
    assert [n for n in range(1, 40) if view.is_due()] == [1, 2, 4, 8, 16, 32]


def test_without_an_effect_the_gradient_is_zero() -> None:
    scene, by = room(), integrator(gradient_samples="loss")
    derivative = np.zeros_like(loss_of(scene))
    assert (gradients(scene, by, derivative, 1) == 0).all()
    # With "prb", too, pixels whose derivative is not a number have no gradient
    derivative[8, 8] = np.nan
    assert (gradients(scene, by, derivative, 1) == 0).all()
    assert "gradient_samples = loss" in str(by)
    with pytest.raises(RuntimeError, match="must be one of even, loss"):
        integrator(gradient_samples="x")


def test_samples_are_where_the_loss_is() -> None:
    """A single pixel gets all of them: the gradient of many samples from few."""
    scene = room()
    derivative = np.zeros_like(loss_of(scene))
    derivative[9, 5] = 1
    few = gradients(scene, integrator(gradient_samples="loss"), derivative, 1, spp=16)
    many = gradients(scene, integrator(), derivative, 2, spp=16 * derivative[..., 0].size)
    np.testing.assert_allclose(few[0], many[0], rtol=0.1)


def test_pixels_that_are_certain_to_be_sampled_have_no_noise_of_their_number_of_samples() -> None:
    """Under a sky alone, all samples of a pixel are equal."""
    view = sensor(film=film(8, 6, pixel_format="luminance"))
    scene = mi.load_dict({"type": "scene", "sensor": view, "sky": {"type": "constant"}})
    parameters, by = mi.traverse(scene), integrator(gradient_samples="loss")
    derivative = np.where(np.arange(48) % 5 == 0, -1.0, 1.7).reshape(6, 8, 1)
    derivative[:3] = 0
    for seed in range(3):
        dr.enable_grad(parameters["sky.radiance.value"])
        dr.set_grad(parameters["sky.radiance.value"], 0)
        parameters.update()
        weights = mi.TensorXf(derivative.astype(np.float32))
        by.render_backward(scene, parameters, weights, seed=seed, spp=4)
        found = dr.grad(parameters["sky.radiance.value"]).numpy().sum()
        np.testing.assert_allclose(found, derivative.sum(), rtol=1e-4)


def test_pixels_that_are_rarely_sampled_count_as_much_on_average() -> None:
    """With one sample per pixel, some pixels have none in most passes."""
    view = mi.load_dict(sensor(film=film(8, 6)))
    view.film().prepare([])
    derivative, sensitivity = np.ones((6, 8, 3), np.float32), np.ones((6, 8))
    derivative[0, 0], sensitivity[5] = 40, 0.01
    weights, passes = np.zeros(48), 300
    for seed in range(passes):
        samples = loss_samples(view, 1, mi.TensorXf(derivative), seed, sensitivity)
        pixels = samples.lanes.lanes(view.film()).pixel.numpy()
        np.add.at(weights, pixels, samples.weight.numpy() / passes)
    np.testing.assert_allclose(weights, 1, atol=0.3)
    assert abs(weights.mean() - 1) < 0.02


def test_image_and_gradient_need_numbers_of_their_own() -> None:
    """The gradient of a squared error is a product of the image and its derivative. With the same
    random numbers, it contains their covariance."""
    scene, by = room(), integrator()
    target = np.array(by.render(scene, seed=10**6, spp=256)) * 0.9

    def of_loss(image: mi.TensorXf, seed: int, spp: int) -> float:
        derivative = (2 * (np.array(image) - target) / target.size).astype(np.float32)
        return float(gradients(scene, by, derivative, seed, spp)[0])

    def several(offset: int) -> tuple[float, float]:
        found = [of_loss(by.render(scene, seed=s, spp=1), s + offset, 1) for s in range(16)]
        # Few seeds have most of the variance: medians
        spread = np.median(np.abs(found - np.median(found)))
        return float(np.median(found)), float(spread)

    exact = of_loss(by.render(scene, seed=10**6 + 1, spp=256), 1, 256)
    (own, error), (shared, _) = several(1000), several(0)
    assert abs(own - exact) < error < (shared - exact) / 3, (own, shared, exact, error)
