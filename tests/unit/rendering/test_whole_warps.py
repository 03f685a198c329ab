"""Renders whose passes have the lengths that a GPU asks for."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning import verdicts
from mitsuba_ext.rendering import device, passes
from tests.support.clock import PassClock
from tests.support.constant_renders import HEIGHT, WIDTH, TwoStages, small_scene

pytestmark = pytest.mark.usefixtures("passes_of_a_gpu")


@pytest.fixture
def scene(variant: str) -> mi.Scene:
    return small_scene()


@pytest.fixture
def passes_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most 64 samples per pixel and pass, in whole warps."""
    gpu = device.Device(True, 64 * WIDTH * HEIGHT * 128)
    monkeypatch.setattr(passes, "device_of", lambda kind: gpu)


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
@pytest.mark.parametrize("name", ["composed_path", "neepp", "auto", "bdpt"])
def test_passes_of_whole_warps_take_all_samples(scene, name, sampler, monkeypatch):
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}})
    integrator, told = mi.load_dict({"type": name, "max_depth": 3}), []
    integrator.progress = told.append
    assert np.isfinite(integrator.render(scene, sensor, spp=100).numpy()).all()
    assert integrator.statistics.spp == 100
    assert told == sorted(told) and told[-1] == 1


@pytest.mark.parametrize("timeout", [3.0, 8.0, 1000.0])
def test_passes_of_whole_warps_keep_the_timeout(scene, monkeypatch, timeout):
    clock = PassClock(monkeypatch)
    integrator = TwoStages(pilot_spp=25, timeout=timeout)
    integrator.render(scene, 144)
    assert integrator.statistics.spp == round(clock.now / 0.1)
    assert integrator.statistics.spp == 144 or timeout * 0.9 <= clock.now <= timeout * 1.05


@pytest.mark.parametrize("name", ["adaptive", "variance"])
def test_passes_of_whole_warps_serve_adaptive_sampling_and_variances(scene, name):
    nested = {"type": "composed_path", "max_depth": 3}
    image = mi.load_dict({"type": name, "nested": nested}).render(scene, spp=200).numpy()
    expected = mi.load_dict(nested).render(scene, spp=200).numpy()
    np.testing.assert_allclose(image[..., :3].mean(), expected.mean(), rtol=0.05)


def test_a_render_in_whole_warps_can_be_cancelled(scene):
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    integrator.progress = lambda fraction: integrator.cancel()
    integrator.render(scene, spp=200)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 64
