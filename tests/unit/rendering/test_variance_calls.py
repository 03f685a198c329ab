"""The integrator ``variance``: its calls, its interruption, and its errors."""

from __future__ import annotations

import os
import signal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.batches import batch_seeds
from tests.support.batched import film_channels, render_batches, small_scene, with_variance

pytestmark = pytest.mark.usefixtures("variant")


# ---- Calls ----


def test_render_takes_the_arguments_that_mitsuba_takes():
    scene, integrator = small_scene(6, 5), with_variance()
    sensor_, same = scene.sensors()[0], dict(rtol=1e-5, atol=1e-6)
    image = integrator.render(scene, sensor=sensor_, seed=mi.UInt32(2**32 - 1), spp=8).numpy()
    np.testing.assert_allclose(integrator.render(scene, 0, 2**32 - 1, 8).numpy(), image, **same)
    lazy = integrator.render(scene, seed=2**32 - 1, spp=8, evaluate=False).numpy()
    np.testing.assert_allclose(lazy, image, **same)
    other = integrator.render(scene, seed=0, spp=8).numpy()
    assert np.abs(other - image).max() > 0.01 * image.max()
    assert integrator.render(scene, seed=2**32 - 1, spp=8, develop=False).shape == (0,)
    np.testing.assert_allclose(np.array(sensor_.film().bitmap()), image, **same)
    with pytest.raises(ValueError, match="there is no sensor 1: the scene has 1"):
        integrator.render(scene, sensor=1, spp=4)


def test_scene_with_the_integrator_in_xml():
    scene = mi.load_string(
        """<scene version="3.0.0">
        <integrator type="variance"><integer name="batches" value="3"/>
            <integrator type="path"><integer name="max_depth" value="2"/></integrator>
        </integrator>
        <emitter type="constant"/><shape type="sphere"/>
        <sensor type="perspective"><sampler type="independent"/>
            <transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/>
            </transform><film type="hdrfilm"><integer name="width" value="4"/>
            <integer name="height" value="3"/><string name="pixel_format" value="rgb"/></film>
        </sensor></scene>"""
    )
    assert mi.render(scene, spp=6).shape == (3, 4, 6)
    text = str(scene.integrator())
    assert text.startswith("variance[") and "batches = 3" in text and "max_depth = 2" in text


def test_statistics_are_summed_over_the_batches():
    scene, integrator = small_scene(6, 5), with_variance("neepp")
    integrator.render(scene, spp=32)
    statistics = integrator.statistics
    assert statistics.spp == 32 and statistics.passes >= 4 and statistics.seconds > 0
    assert statistics.rays["camera"] == 6 * 5 * 32 and statistics.rays["shadow"] > 0
    assert 0 < statistics.zero_radiance < 1 and not statistics.interrupted


# ---- Stopping ----


def test_cancelling_returns_the_image_of_the_finished_batches():
    scene, integrator = small_scene(6, 5), with_variance(batches=8)
    fractions = []

    def progress(fraction: float) -> None:
        fractions.append(fraction)
        if fraction >= 0.5:
            integrator.cancel()

    integrator.progress = progress
    image = integrator.render(scene, spp=32, seed=3).numpy()
    assert fractions == [0.125, 0.25, 0.375, 0.5]
    assert integrator.statistics.interrupted and integrator.statistics.spp == 16
    batches = render_batches(integrator.nested, scene, 0, 4, batch_seeds(3, 4))
    np.testing.assert_allclose(image[..., :3], batches.mean, rtol=1e-5, atol=1e-7)
    integrator.progress = None
    integrator.render(scene, spp=32)
    assert integrator.statistics.spp == 32, "a later render is not cancelled"


@pytest.mark.parametrize("nested", ["path", "neepp"])
def test_ctrl_c_leaves_the_finished_batches_in_the_film(nested):
    scene, integrator = small_scene(6, 5), with_variance(nested)
    integrator.progress = lambda fraction: fraction < 0.5 or os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, spp=64)
    assert integrator.statistics.interrupted and integrator.statistics.spp in (32, 48)
    channels = film_channels(scene)
    assert "variance.R" in channels and np.isfinite(list(channels.values())).all()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_inside_of_a_batch_drops_it():
    """Ours finish the pass and raise."""
    scene, integrator = small_scene(6, 5), with_variance("neepp")
    whole = integrator.render(scene, spp=64)
    count = []

    def interrupt(fraction: float) -> None:
        count.append(fraction)
        if integrator.statistics.spp == 32:  # in the third batch
            os.kill(os.getpid(), signal.SIGINT)

    integrator.nested.progress = interrupt
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, spp=64)
    assert integrator.statistics.spp == 32
    assert film_channels(scene)["variance.R"].shape == whole.shape[:2]


def test_variance_after_a_single_batch_is_unknown():
    scene, integrator = small_scene(6, 5), with_variance()
    integrator.progress = lambda _: integrator.cancel()
    image = integrator.render(scene, spp=16).numpy()
    assert np.isfinite(image[..., :3]).all() and np.isnan(image[..., 3:]).all()


def test_an_error_in_the_progress_callback_leaves_a_valid_film():
    scene, integrator = small_scene(6, 5), with_variance()

    def fail(fraction: float) -> None:
        if fraction > 0.5:
            raise OSError("no terminal")

    integrator.progress = fail
    with pytest.raises(OSError, match="no terminal"):
        integrator.render(scene, spp=16)
    assert np.isfinite(list(film_channels(scene).values())).all()


# ---- Errors ----


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "exactly one integrator must be nested in it; found none"),
        ({"a": {"type": "path"}, "b": {"type": "path"}}, "exactly one .*Path.*, Path"),
        ({"a": {"type": "sphere"}}, "exactly one integrator.*Sphere"),
        ({"a": {"type": "path"}, "batches": 1}, '"batches" is 1; it must be at least 2'),
        ({"a": {"type": "path"}, "batches": 2.5}, '"batches" is 2.5; .* type int'),
        ({"a": {"type": "variance", "n": {"type": "path"}}}, "nested in another"),
        ({"a": {"type": "neepp", "aovs": "variance:albedo"}}, 'AOV of the name "variance.B"'),
    ],
)
def test_wrong_use_is_explained(parameters, message):
    with pytest.raises((TypeError, ValueError, RuntimeError), match=f'"variance".*{message}'):
        mi.load_dict({"type": "variance", **parameters})


@pytest.mark.parametrize("unknown", ["max_depth", "hide_emitters", "timeout", "spp"])
def test_parameters_of_the_nested_integrator_are_refused(unknown):
    with pytest.raises(RuntimeError, match=f'"variance" has no parameter "{unknown}"'):
        with_variance(**{unknown: 4})


@pytest.mark.parametrize("outer", [{"type": "moment"}, {"type": "aov", "aovs": "d:depth"}])
def test_integrators_that_draw_single_samples_refuse_to_nest_it(outer):
    with pytest.raises(RuntimeError, match="Child objects must be of type 'SamplingIntegrator'"):
        mi.load_dict({**outer, "x": {"type": "variance", "nested": {"type": "path"}}})


def test_gradients_are_refused_with_a_hint_at_prb():
    scene = small_scene(4, 4)
    parameters = mi.traverse(scene)
    key = "light.emitter.radiance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    integrator = with_variance("prb")
    image = mi.render(scene, parameters, integrator=integrator, spp=4)
    with pytest.raises((NotImplementedError, RuntimeError)) as caught:
        dr.backward(dr.sum(image))
    error, texts = caught.value, ""
    while error is not None:
        texts, error = texts + str(error), error.__cause__ or error.__context__
    assert '"variance" does not compute gradients' in texts and '"prb"' in texts
    for method, arguments in (("render_forward", ()), ("render_backward", (None,))):
        with pytest.raises(NotImplementedError, match='"variance".*"prb"'):
            getattr(integrator, method)(scene, parameters, *arguments)
