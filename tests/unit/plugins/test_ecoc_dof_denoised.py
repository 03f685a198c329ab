"""Depth of field of layers that are denoised first."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from tests.support.defocus import EMITTED, PATH, ecoc, rendered, signs, thin_lens
from tests.support.stage import stage

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def calls(monkeypatch):
    """A denoiser that changes nothing, and what it was called with."""
    calls = []

    def denoise(color, albedo, normal, *, hdr):
        calls.append(SimpleNamespace(color=color, albedo=albedo, normal=normal, hdr=hdr))
        return color

    monkeypatch.setitem(sys.modules, "mitsuba_oidn", SimpleNamespace(denoise=denoise))
    return calls


def test_a_denoiser_that_changes_nothing_leaves_the_picture_alone(calls):
    scene = mi.load_dict(stage(camera=thin_lens(rfilter={"type": "box"})))
    plain = rendered(scene, ecoc(PATH), 8)
    image = rendered(scene, ecoc(PATH, denoise=True), 8)
    assert np.allclose(image, plain, rtol=1e-4, atol=1e-6)
    assert calls and all(call.hdr for call in calls)
    # Below the film is the floor; beside it, and in the last row, it ends
    below = np.s_[-2, 3:-3]
    assert any(np.allclose(call.albedo[below], [0.6, 0.5, 0.4], atol=1e-3) for call in calls)
    assert any(np.allclose(call.normal[below], [0, 0, 1], atol=1e-3) for call in calls)


def test_the_denoiser_sees_no_edges_at_holes_of_a_layer(calls):
    """A panel near the lens, and lamps around it: the near layer holds the panel alone."""
    rendered(signs(rfilter={"type": "box"}), ecoc(denoise=True), 4)
    near = calls[0].color
    assert np.allclose(near, 0.1, rtol=1e-3), "the panel's radiance everywhere"


def test_lights_are_not_denoised(monkeypatch):
    """All that is seen are lights; the denoiser makes everything brighter."""
    brighter = SimpleNamespace(denoise=lambda color, albedo, normal, *, hdr: 2 * color)
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", brighter)
    scene = signs(rfilter={"type": "box"})
    plain, image = (rendered(scene, ecoc(denoise=d), 4) for d in (False, True))
    assert np.allclose(image, plain, rtol=1e-4, atol=1e-6)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(RuntimeError, match="denoising needs the package mitsuba-oidn"):
        ecoc(denoise=True)


@pytest.mark.slow
def test_noise_is_reduced_and_edges_stay():
    pytest.importorskip("mitsuba_oidn")
    scene = mi.load_dict(stage(camera=thin_lens(64, 48, rfilter={"type": "box"})))
    reference = rendered(scene, ecoc(PATH), 512)
    errors = [
        np.abs(rendered(scene, ecoc(PATH, denoise=denoise), 4) - reference).mean()
        for denoise in (False, True)
    ]
    assert errors[1] < 0.8 * errors[0], errors
    # Without noise, there is nothing to remove
    clean = signs(rfilter={"type": "box"})
    plain, image = (rendered(clean, ecoc(EMITTED, denoise=d), 64) for d in (False, True))
    assert np.abs(image - plain).mean() < 0.03 * plain.mean()
