"""``clamp_direct`` and ``clamp_indirect`` bound the light of a sample."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.inputs.scene_remarks import scene_remarks
from mitsuba_ext.inputs.scenes import load_scene

pytestmark = pytest.mark.usefixtures("variant")


def _scene(**more):
    """A Cornell box, smaller than the camera's view in the original."""
    box = mi.cornell_box()
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    return {**box, "sensor": {**box["sensor"], "film": film}, **more}


def _image(scene, spp=4, name="composed_path", **parameters):
    integrator = mi.load_dict({"type": name, "max_depth": 5, **parameters})
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=3)), integrator


def _check_parts(scene):
    """Direct light is what an image with ``max_depth`` 2 shows; indirect light is the rest."""
    (whole, _), (direct, _) = _image(scene), _image(scene, max_depth=2)
    assert direct.mean() > 0 and (whole - direct).mean() > 0.01 * whole.mean()
    tiny = 1e-9
    np.testing.assert_allclose(_image(scene, clamp_indirect=tiny)[0], direct, atol=1e-6)
    np.testing.assert_allclose(_image(scene, clamp_direct=tiny)[0], whole - direct, atol=3e-5)
    high = _image(scene, clamp_direct=1e9, clamp_indirect=1e9)[0]
    np.testing.assert_allclose(high, whole, atol=3e-5)


def test_direct_light_is_that_of_two_segments_and_all_else_is_indirect():
    _check_parts(mi.load_dict(_scene()))


def test_surfaces_between_media_do_not_make_light_indirect():
    fog = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.8}
    bubble = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "null"}, "interior": fog}
    _check_parts(mi.load_dict(_scene(bubble=bubble)))


def test_no_sample_exceeds_its_limit_and_keeps_its_colour():
    scene = mi.load_dict(_scene())
    image, _ = _image(scene, 1, clamp_direct=0.05, clamp_indirect=0.05)
    whole, _ = _image(scene, 1)
    assert whole.mean(2).max() > 0.2 and image.mean(2).max() < 0.1 * (1 + 1e-5)
    direct, _ = _image(scene, 1, clamp_direct=0.05, max_depth=2)
    full, _ = _image(scene, 1, max_depth=2)
    is_clamped = full.mean(2) > 0.05
    assert is_clamped.any()
    scale = np.minimum(1, 0.05 / np.maximum(full.mean(2, keepdims=True), 1e-9))
    np.testing.assert_allclose(direct, full * scale, 1e-4)


def test_an_image_with_clamped_light_is_called_biased():
    loaded = load_scene(_scene())
    _, integrator = _image(loaded.scene, 16, "auto_path", clamp_indirect=2.0)
    said = "light is clamped (clamp_indirect = 2)"
    assert f"{said}; the image is biased" in integrator.statistics.learned
    assert scene_remarks(loaded, integrator, "a") == [f'"a": {said}: the image is biased']
    _, plain = _image(loaded.scene)
    assert "biased" not in plain.statistics.learned and not scene_remarks(loaded, plain, "a")
    assert "clamp" not in str(plain) and "clamp_indirect = 2.0" in str(integrator)


def test_integrators_with_light_paths_or_gradients_refuse_to_clamp():
    for name in ("auto", "bdpt", "composed_prb", "erpt"):
        with pytest.raises(RuntimeError, match=f'"{name}" has no parameter "clamp_direct": only'):
            mi.load_dict({"type": name, "clamp_direct": 1.0})
    with pytest.raises(RuntimeError, match="-1.0; it must be at least 0"):
        mi.load_dict({"type": "composed_path", "clamp_indirect": -1.0})
