"""``mitsuba-ext denoise`` and ``render --denoise``."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import denoising
from mitsuba_ext.compare import InputError, images, read_exr
from mitsuba_ext.compare.metrics import relative_mse

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def calls(monkeypatch):
    """A denoiser that halves images, and what it was called with."""
    calls = []

    def denoise(color, albedo=None, normal=None, *, hdr):
        calls.append(SimpleNamespace(color=color, albedo=albedo, normal=normal, hdr=hdr))
        return color / 2

    module = SimpleNamespace(denoise=denoise, oidn_version=lambda: "0")
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", module)
    return calls


def test_a_render_is_denoised_and_its_image_is_kept(run, make_scene, tmp_path, calls):
    command = ("render", make_scene(), "--seed", 3)
    assert run(*command, "-o", tmp_path / "plain.exr")[0] == 0
    assert run(*command, "-o", tmp_path / "a.exr", "--denoise")[0] == 0
    plain, noisy, ours = (
        read_exr(tmp_path / f"{name}.exr")[0] for name in ("plain", "a.noisy", "a"))
    np.testing.assert_array_equal(noisy["R"], plain["R"])
    np.testing.assert_array_equal(ours["R"], plain["R"] / 2)
    (call,) = calls
    assert call.hdr and sorted(ours) == ["B", "G", "R"]
    # A sphere of albedo 0.5 in front of the camera
    np.testing.assert_allclose(call.albedo[2:4, 3:5], 0.5, atol=1e-3)
    np.testing.assert_array_equal(call.albedo[..., 0], noisy["albedo.R"])
    assert call.normal.shape == (6, 8, 3) and (call.normal[2:4, 3:5, 2] < -0.5).all()
    assert "Open Image Denoise" in read_exr(tmp_path / "a.exr")[1]["denoised"]


def test_a_long_render_is_denoised_too(run, make_scene, tmp_path, calls):
    code, _, _ = run("render", make_scene(), "-o", tmp_path / "a.png", "--denoise", "--spp", 4,
                     "--checkpoint", tmp_path / "kept")  # fmt: skip
    assert code == 0 and images.open_bitmap(tmp_path / "a.png").width() == 8
    assert len(calls) == 1 and (tmp_path / "a.noisy.exr").exists()


def test_an_image_is_guided_by_its_layers(run, tmp_path, calls):
    rng = np.random.default_rng(1)
    names = ["R", "G", "B", *(f"View.Albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ")]
    pixels = rng.random((4, 5, 9), dtype=np.float32)
    images.write_exr(tmp_path / "a.exr", pixels, names, {})
    assert "guided by albedo and normal" in run("denoise", tmp_path / "a.exr")[1]
    np.testing.assert_array_equal(calls[0].albedo, pixels[..., 3:6])
    np.testing.assert_array_equal(calls[0].normal, pixels[..., 6:])
    found = read_exr(tmp_path / "a.denoised.exr")[0]
    np.testing.assert_array_equal(found["G"], pixels[..., 1] / 2)
    images.write_exr(tmp_path / "b.exr", pixels[..., :3], "RGB", {})
    assert "nothing but the image" in run("denoise", tmp_path / "b.exr", "-o",
                                          tmp_path / "b.jpg")[1]  # fmt: skip
    code, _, err = run("denoise", tmp_path / "b.exr", "-o", tmp_path / "b.exr")
    assert code == 2 and "is the image itself" in err


def test_without_the_package_one_sentence_says_what_to_install(
    run, make_scene, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    for command in (("denoise", tmp_path / "a.exr"),
                    ("render", make_scene(), "-o", tmp_path / "a.exr", "--denoise")):  # fmt: skip
        code, _, err = run(*command)
        assert code == 2 and "pip install 'mitsuba_ext[denoise]'" in err and err.count("\n") == 1


def test_a_filter_that_correlates_pixels_is_named(run, make_scene, tmp_path, calls):
    scene = make_scene()
    scene.write_text(scene.read_text().replace('rfilter type="box"', 'rfilter type="gaussian"'))
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", "--denoise")
    assert code == 0 and "use a film with a box filter" in err


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_a_film_without_rgb_is_refused_before_the_render(variant):
    band = {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 500.0, "values": "1,1"}
    film = mi.load_dict({"type": "specfilm", "band": band})
    with pytest.raises(InputError, match="no RGB image to denoise"):
        denoising.remark(film)


@pytest.mark.slow
def test_denoising_removes_noise(run, scenes, tmp_path):
    pytest.importorskip("mitsuba_oidn")
    command = ("render", scenes / "cornell_box.xml", "--size", "64x64")
    assert run(*command, "-o", tmp_path / "truth.exr", "--spp", 256, "--seed", 9)[0] == 0
    assert run(*command, "-o", tmp_path / "a.exr", "--spp", 4, "--denoise")[0] == 0
    truth, noisy, ours = (
        np.stack([read_exr(tmp_path / f"{name}.exr")[0][c] for c in "RGB"], axis=2)
        for name in ("truth", "a.noisy", "a"))  # fmt: skip
    assert relative_mse(ours, truth) < 0.5 * relative_mse(noisy, truth)
