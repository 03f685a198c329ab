"""``mitsuba-ext denoise`` and ``render --denoise``."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import InputError, read_exr
from mitsuba_ext.images import denoising, image_files
from mitsuba_ext.images.metrics import relative_mse
from mitsuba_ext.rendering.scene_guides import render_guides

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def calls(monkeypatch):
    """A denoiser that halves images, and what it was called with."""
    calls = []

    def denoise(color, albedo=None, normal=None, *, hdr, clean_aux=None):
        if clean_aux is None:  # a guide
            assert not hdr and color.min() >= 0 and color.max() <= 1
            return color
        assert clean_aux == (albedo is not None)
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
                     "--checkpoint", tmp_path / "kept",
                     "--preview", tmp_path / "b.png")  # fmt: skip
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert code == 0 and image_files.open_bitmap(tmp_path / "a.png")[0].width() == 8
    assert len(calls) == 1 and (tmp_path / "a.noisy.exr").exists()


def test_guides_are_in_the_form_that_the_denoiser_takes(calls):
    scene = mi.load_dict(mi.cornell_box() | {"sensor": {
        "type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0],
        [0, 1, 0]), "film": {"type": "hdrfilm", "width": 6, "height": 4}}})  # fmt: skip
    guides = render_guides(scene, scene.sensors()[0])
    albedo, normal = np.split(np.stack(list(guides.values()), axis=2), 2, axis=2)
    image = denoising.denoise(np.ones((4, 6, 3)), albedo, normal)
    assert image.shape == (4, 6, 3) and image.dtype == np.float32 and (image == 0.5).all()
    np.testing.assert_array_equal(calls[0].albedo, albedo)
    denoising.denoise(np.ones((4, 6, 3)), normal=normal)
    assert calls[1].albedo is None and calls[1].normal is None


def test_an_image_is_guided_by_its_layers(run, tmp_path, calls):
    rng = np.random.default_rng(1)
    names = ["R", "G", "B", *(f"View.Albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ")]
    pixels = rng.random((4, 5, 9), dtype=np.float32)
    image_files.write_exr(tmp_path / "a.exr", pixels, names, {})
    assert "guided by albedo and normal" in run("denoise", tmp_path / "a.exr")[1]
    np.testing.assert_array_equal(calls[0].albedo, pixels[..., 3:6])
    np.testing.assert_allclose(calls[0].normal, pixels[..., 6:], atol=1e-6)
    found = read_exr(tmp_path / "a.denoised.exr")[0]
    np.testing.assert_array_equal(found["G"], pixels[..., 1] / 2)
    image_files.write_exr(tmp_path / "b.exr", pixels[..., :3], "RGB", {})
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
    command = ("render", scene, "-o", tmp_path / "a.exr", "--denoise")
    code, _, err = run(*command)
    assert code == 0 and "use --filter box" in err
    assert run(*command, "--filter", "box")[2] == ""


def _guides(*shapes, **film):
    """Guides of shapes in front of a camera at the origin that looks along z: [y, x, channel]."""
    film = {"type": "hdrfilm", "width": 9, "height": 9, "rfilter": {"type": "box"}, **film}
    scene = mi.load_dict({
        "type": "scene", "sensor": {"type": "perspective", "fov": 20, "film": film},
        **{f"shape{n}": shape for n, shape in enumerate(shapes)},
    })  # fmt: skip
    found = render_guides(scene, scene.sensors()[0], seed=1)
    assert list(found) == [*(f"albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ")]
    return np.stack(list(found.values()), axis=2)


def _wall(z, bsdf, angle=180, axis=(0, 1, 0)):
    T = mi.ScalarTransform4f
    to_world = T().translate([0, 0, z]).rotate(list(axis), angle).scale(9)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def _diffuse(*rgb):
    return {"type": "twosided", "b": {
        "type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}}  # fmt: skip


@pytest.mark.parametrize("film", [{}, {"width": 1, "height": 1}, {"rfilter": {"type": "gaussian"}}])
def test_guides_show_the_objects_in_a_mirror(film):
    mirror = {"type": "conductor", "material": "none",
              "specular_reflectance": {"type": "rgb", "value": [0.5, 1, 1]}}  # fmt: skip
    # The mirror shows a wall behind the camera
    found = _guides(_wall(4, mirror), _wall(-3, _diffuse(0.2, 0.4, 0.6), 0), **film)
    assert np.abs(found[..., :3] - [0.1, 0.4, 0.6]).max() < 1e-5
    np.testing.assert_allclose(found[..., 3:].mean((0, 1)), [0, 0, 1], atol=1e-5)


def test_guides_show_the_objects_behind_glass_and_holes():
    pane = {"type": "thindielectric", "int_ior": 1.0001}
    hole = {"type": "mask", "opacity": 0.25, "b": _diffuse(0, 0, 0)}
    wall = _wall(6, _diffuse(0.8, 0.8, 0.8))
    found = _guides(_wall(4, pane), wall)
    np.testing.assert_allclose(found[..., :3], 0.8, atol=1e-3)
    # A hole that lets three quarters of the light through
    found = _guides(_wall(4, hole), wall)
    assert abs(found[..., :3].mean() - 0.6) < 0.02
    # Plastic is itself, though it mirrors too; what nothing is behind has no guides
    plastic = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.3}}
    found = _guides(_wall(4, plastic), _wall(-3, _diffuse(1, 1, 1), 0))
    np.testing.assert_allclose(found[..., 5], -1, atol=1e-5)
    assert (_guides({"type": "sphere", "center": [9, 9, 9]}) == 0).all()


def _seen(*bsdfs):
    """The albedo of square panels, side by side in front of the camera: [panel, RGB]."""
    T, count = mi.ScalarTransform4f, len(bsdfs)
    shapes = [
        {"type": "rectangle", "bsdf": bsdf,
         "to_world": T().translate([2 * n + 1 - count, 0, 30]).rotate([0, 1, 0], 180)}
        for n, bsdf in enumerate(bsdfs)
    ]  # fmt: skip
    fov = 2 * np.degrees(np.arctan(count / 30))
    T = T().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0]).scale([-1, 1, 1])
    film = {"type": "hdrfilm", "width": 3 * count, "height": 1, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": fov, "to_world": T, "film": film}
    panels = {f"shape{n}": shape for n, shape in enumerate(shapes)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, **panels})
    found = np.stack(list(render_guides(scene, scene.sensors()[0]).values()), axis=2)
    return found[0, 1::3, :3]


def _metal(alpha, *rgb):
    return {"type": "roughconductor", "material": "none", "alpha": alpha,
            "specular_reflectance": {"type": "rgb", "value": list(rgb)}}  # fmt: skip


def test_the_albedo_of_gloss_is_the_light_that_it_scatters():
    metal, rgb = _metal(0.05, 0.9, 0.6, 0.3), [0.1, 0.2, 0.4]
    coated = {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": rgb}}
    blend = {"type": "blendbsdf", "weight": 0.25, "a": metal, "b": _diffuse(*rgb)["b"]}
    found = _seen(
        # Mitsuba's eval_diffuse_reflectance finds 90, 60, 30 there, or 0 at an angle
        metal, {"type": "bumpmap", "map": {"type": "uniform", "value": 0.0}, "b": metal},
        # Radiance in glass changes by the factor 1 / 1.5 ** 2, which is no absorption
        {"type": "roughdielectric", "alpha": 0.05},
        coated, {"type": "mask", "opacity": 0.5, "b": metal},
    )  # fmt: skip
    np.testing.assert_allclose(found[:2], [[0.9, 0.6, 0.3]] * 2, rtol=0.02)
    np.testing.assert_allclose(found[2], 1, rtol=0.02)
    np.testing.assert_allclose(found[3], rgb, atol=1e-6)  # the gloss does not hide a texture
    np.testing.assert_allclose(found[4], [0.45, 0.3, 0.15], rtol=0.5)  # of 32 samples
    # At an angle, eval_diffuse_reflectance finds the diffuse part alone
    found = _guides(_wall(9, blend, 140))[..., :3].mean((0, 1))
    np.testing.assert_allclose(found, [0.7, 0.5, 0.325], atol=0.03)


def test_what_is_seen_in_glass_is_not_darkened_by_it():
    found = _guides(_wall(4, {"type": "dielectric"}), _wall(6, _diffuse(0.5, 0.5, 0.5)))
    assert abs(found[..., :3].mean() - 0.48) < 0.01  # 4 % is reflected, into the dark


@pytest.mark.parametrize(
    "variant", ["llvm_ad_spectral", "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized"],
    indirect=True,
)
def test_the_albedo_of_metal_is_found_in_all_variants(variant):
    (found,) = _seen(_metal(0.05, 0.5, 0.5, 0.5))
    np.testing.assert_allclose(found, 0.5, atol=0.02)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"], indirect=True)
def test_guides_have_colours_in_spectral_variants_too(variant):
    mirror = {"type": "conductor", "material": "none"}
    for body in ([_wall(4, _diffuse(0.2, 0.4, 0.6))],
                 [_wall(4, mirror), _wall(-3, _diffuse(0.2, 0.4, 0.6), 0)]):  # fmt: skip
        found = _guides(*body)[..., :3].mean((0, 1))
        expected = [0.2, 0.4, 0.6] if variant == "llvm_ad_spectral" else found[0]
        np.testing.assert_allclose(found, expected, atol=0.03)
        assert found.min() > 0.1


def test_paths_between_two_mirrors_end():
    mirror = {"type": "conductor", "material": "none"}
    found = _guides(_wall(4, mirror), _wall(-3, mirror, 0))
    assert np.isfinite(found).all()


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_a_film_without_rgb_is_refused_before_the_render(variant):
    band = {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 500.0, "values": "1,1"}
    film = mi.load_dict({"type": "specfilm", "band": band})
    with pytest.raises(InputError, match="no RGB image to denoise"):
        denoising.remark(film)


@pytest.mark.slow
def test_denoising_removes_noise(run, scenes, tmp_path):
    pytest.importorskip("mitsuba_oidn")
    # With the gaussian filter of the scene, neighbours share their noise, which passes for detail
    command = ("render", scenes / "cornell_box.xml", "--size", "64x64", "-D", "rfilter=box")
    assert run(*command, "-o", tmp_path / "truth.exr", "--spp", 256, "--seed", 9)[0] == 0
    assert run(*command, "-o", tmp_path / "a.exr", "--spp", 4, "--denoise")[0] == 0
    truth, noisy, ours = (
        np.stack([read_exr(tmp_path / f"{name}.exr")[0][c] for c in "RGB"], axis=2)
        for name in ("truth", "a.noisy", "a"))  # fmt: skip
    assert relative_mse(ours, truth) < 0.2 * relative_mse(noisy, truth)  # 0.10 +- 0.01 over seeds
