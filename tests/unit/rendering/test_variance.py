"""The integrator ``variance`` and the batches below it: mean, variance, samples, and film."""

from __future__ import annotations

import math
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import read_exr
from mitsuba_ext.rendering.batches import Batches, batch_seeds, each_batch
from tests.support.batched import film_channels, render_batches, small_scene, with_variance
from tests.support.stage import film, lookat, sensor, stage
from tests.support.statistical import THRESHOLD, z_exact

pytestmark = pytest.mark.usefixtures("variant")

#: One of each family: paths, light tracing, adjoint, ours with learning.
NESTED = ["path", "ptracer", "prb", "neepp"]

FORMATS = {
    "rgb": ["R", "G", "B"],
    "rgba": ["R", "G", "B", "A"],
    "luminance": ["Y"],
    "luminance_alpha": ["Y", "A"],
    "xyz": ["X", "Y", "Z"],
    "xyza": ["X", "Y", "Z", "A"],
}


# ---- Mean and variance ----


@pytest.mark.parametrize("nested", [*NESTED, pytest.param("bdpt", marks=pytest.mark.slow)])
def test_mean_and_variance_are_computed_over_the_batches(nested):
    scene, inner = small_scene(9, 7), mi.load_dict({"type": nested})
    image = mi.render(scene, integrator=with_variance(nested), spp=32, seed=5).numpy()
    images = [
        inner.render(scene, seed=seed, spp=8).numpy().astype(np.float64)
        for seed in batch_seeds(5, 4)
    ]
    scale = np.max(images)
    np.testing.assert_allclose(image[..., :3], np.mean(images, 0), rtol=1e-5, atol=1e-6 * scale)
    variance = np.var(images, axis=0, ddof=1) / 4
    np.testing.assert_allclose(image[..., 3:], variance, rtol=1e-3, atol=1e-8 * scale**2)
    assert (image[..., 3:] > 0).mean() > 0.5, "constant batches prove nothing"


def test_constant_environment_has_no_variance():
    scene = mi.load_dict({"type": "scene", "c": sensor(film=film(8, 8)), "e": {"type": "constant"}})
    image = mi.render(scene, integrator=with_variance(), spp=16).numpy()
    np.testing.assert_allclose(image[..., :3], 1, rtol=1e-6)
    assert not image[..., 3:].any()


@pytest.fixture
def lattice(variant: str) -> mi.Scene:
    """Each of 24 × 24 pixels is lit to 30 %: a sample is worth 1 with this probability, else 0."""
    pixels = np.zeros((240, 240, 3), dtype=np.float32)
    pixels[:, np.arange(240) % 10 < 3] = 1
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True,
                "filter_type": "nearest"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "camera": sensor("orthographic", view, film=film(24, 24)),
            "screen": {"type": "rectangle", "emitter": {"type": "area", "radiance": radiance}},
        }
    )


@pytest.mark.parametrize("batches", [2, 16])
def test_the_variance_belongs_to_the_mean_of_all_samples(lattice, batches):
    """Bernoulli: p (1 − p) / spp. The pixels are independent."""
    spp, p = 64, 0.3
    image = mi.render(lattice, integrator=with_variance("direct", batches), spp=spp, seed=1).numpy()
    mean, variance = (image[..., c].ravel().astype(np.float64) for c in (0, 3))
    exact = p * (1 - p) / spp
    assert abs(z_exact(variance, exact)[0]) < THRESHOLD
    assert z_exact(variance, exact)[1] < 0.07
    assert abs(z_exact((mean - p) ** 2, exact)[0]) < THRESHOLD
    # As a user would: the errors against the exact image have the variance in the channels
    assert abs(z_exact((mean - p) ** 2 - variance, 0.0)[0]) < THRESHOLD


@pytest.mark.parametrize(
    ("nested", "sampler", "batches"),
    [("path", "ldsampler", 4), ("ptracer", "independent", 4), ("neepp", "independent", 2)],
)
def test_variance_announces_the_differences_of_independent_renders(nested, sampler, batches):
    """E[(a − b)²] = Var a + Var b, for a wide filter too."""
    # Below the lamp, because its edge would dominate the variance
    view = lookat([0, -4, 1.2], [0, 0, -0.2], [0, 0, 1])
    wide = film(12, 12, rfilter={"type": "gaussian"})
    scene = mi.load_dict(stage(camera=sensor(to_world=view, film=wide, sampler=sampler)))
    integrator = with_variance({"type": nested, "max_depth": 3}, batches=batches)
    images = [
        mi.render(scene, integrator=integrator, spp=64, seed=seed).numpy().astype(np.float64)
        for seed in range(24)
    ]
    a, b = np.array(images[::2]), np.array(images[1::2])
    squares = ((a - b)[..., :3] ** 2).mean(axis=(1, 2, 3))
    announced = (a + b)[..., 3:].mean(axis=(1, 2, 3))
    assert abs(z_exact(squares - announced, 0.0)[0]) < THRESHOLD
    error = (squares - announced).std(ddof=1) / math.sqrt(len(a))
    assert error < 0.1 * announced.mean(), "too noisy to say anything"


def test_update_keeps_small_variances_of_large_means():
    """For values whose sums of squares would cancel completely."""
    random = np.random.default_rng(1)
    images = 1e9 + random.normal(size=(50, 4, 4, 1))
    batches = Batches(["Y"], 1)
    for image in images:
        batches.add(image, 2)
    assert (batches.count, batches.spp) == (50, 100)
    np.testing.assert_allclose(batches.mean, images.mean(axis=0), rtol=1e-15)
    np.testing.assert_allclose(batches.variance, images.var(axis=0, ddof=1) / 50, rtol=1e-5)


# ---- Batches ----


def test_seeds_of_batches_are_not_shared():
    """Neither by neighbouring seeds nor with the passes of our integrators (see rendering.py)."""
    seeds = [batch_seeds(seed, 64) for seed in (0, 1, 2, 2**32 - 1)]
    assert len({seed for group in seeds for seed in group}) == 4 * 64
    assert batch_seeds(2**32 - 1, 64) == batch_seeds(mi.UInt32(2**32 - 1), 64) == seeds[3]
    assert batch_seeds(0, 3) == seeds[0][:3]
    passes = mi.sample_tea_32(mi.UInt32(seeds[0][0]), dr.arange(mi.UInt32, 64))[0].numpy()
    assert not set(passes.tolist()) & set(seeds[0])
    assert not set(mi.sample_tea_32(mi.UInt32(0), dr.arange(mi.UInt32, 64))[0]) & set(seeds[0])


def test_batches_come_one_by_one_and_can_be_continued(tmp_path):
    scene, path = small_scene(6, 5), mi.load_dict({"type": "path"})
    counts = [batches.count for batches in each_batch(path, scene, 0, 4, [7, 8])]
    assert counts == [1, 2]
    render_batches(path, scene, 0, 4, [7, 8]).save(tmp_path / "batches")
    stored = Batches.load(tmp_path / "batches")
    batches = render_batches(path, scene, 0, 4, [9, 10], stored)
    assert batches.channels == ("R", "G", "B") and (batches.count, batches.spp) == (4, 16)
    images = [path.render(scene, seed=seed, spp=4).numpy() for seed in (7, 8, 9, 10)]
    np.testing.assert_allclose(batches.mean, np.mean(images, axis=0), rtol=1e-5)
    assert batches.mean.dtype == batches.variance.dtype == np.float64


def test_non_finite_batch_is_not_averaged_away():
    scene = small_scene(6, 5)

    class Broken(mi.SamplingIntegrator):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            image = mi.load_dict({"type": "path"}).render(scene, sensor, seed, spp)
            return image if seed != 2 else image * math.nan

    broken = Broken(mi.Properties())
    finite = [np.isfinite(b.mean).all() for b in each_batch(broken, scene, 0, 4, [1, 2, 3])]
    assert finite == [True, False, False]


def test_no_batch_is_kept(monkeypatch):
    """Neither the images nor the tensors."""
    kept: list[weakref.ref] = []
    add = Batches.add

    def watched(self, image, spp):
        kept.append(weakref.ref(image))
        add(self, image, spp)

    monkeypatch.setattr(Batches, "add", watched)
    mi.render(small_scene(6, 5), integrator=with_variance(batches=8), spp=8)
    assert len(kept) == 8 and not any(image() is not None for image in kept)


# ---- Samples ----


@pytest.mark.parametrize(
    ("sampler", "spp", "expected"),
    [
        ("independent", 64, (16, 4)),
        ("independent", 17, (9, 2)),
        ("independent", 100, (15, 7)),
        ("independent", 5, (5, 1)),
        ("independent", 2, (2, 1)),
        ("stratified", 64, (16, 4)),
        ("stratified", 100, (12, 9)),
        ("ldsampler", 256, (16, 16)),
        ("ldsampler", 2, (2, 4)),
        ("orthogonal", 1000, (9, 121)),
    ],
)
def test_samples_exceed_the_request_by_less_than_a_batch(sampler, spp, expected):
    scene, integrator = small_scene(3, 2, sampler=sampler), with_variance("direct", 16)
    integrator.render(scene, spp=spp)
    count, batch_spp = expected
    assert (integrator.statistics.passes, integrator.statistics.spp) == (count, count * batch_spp)


def test_one_sample_is_refused():
    with pytest.raises(ValueError, match='"variance".* at least 2 samples.* spp = 1'):
        with_variance().render(small_scene(4, 4), spp=1)


def test_the_samplers_count_is_used_and_left_as_it_was():
    scene = mi.load_dict(stage(camera=sensor(film=film(4, 4))))
    sampler = scene.sensors()[0].sampler()
    sampler.set_sample_count(12)
    for nested in ("path", "prb", "neepp"):
        integrator = with_variance(nested)
        integrator.render(scene)
        assert integrator.statistics.spp == 12, "spp=0 means the sampler's count"
        integrator.render(scene, spp=8)
        assert integrator.statistics.spp == 8 and sampler.sample_count() == 12


# ---- The film ----


@pytest.mark.parametrize(
    ("nested", "pixel_format"), [*(("path", name) for name in FORMATS), ("ptracer", "xyza")]
)
def test_film_develops_the_mean_in_every_pixel_format(nested, pixel_format):
    scene = small_scene(7, 5, pixel_format=pixel_format, rfilter={"type": "gaussian"})
    integrator = with_variance(nested)
    image = mi.render(scene, integrator=integrator, spp=16, seed=2).numpy()
    names = FORMATS[pixel_format]
    colors = [name for name in names if name != "A"]
    assert integrator.aov_names() == [f"variance.{color}" for color in colors]
    channels = film_channels(scene)
    assert list(channels) == names + integrator.aov_names()
    np.testing.assert_allclose(np.stack(list(channels.values()), 2), image, rtol=1e-6)
    batches = render_batches(integrator.nested, scene, 0, 4, batch_seeds(2, 4))
    scale = batches.mean.max()
    np.testing.assert_allclose(image[..., : len(names)], batches.mean, rtol=1e-5, atol=1e-6 * scale)
    variance = batches.variance[..., : len(colors)]
    np.testing.assert_allclose(
        image[..., len(names) :], variance, rtol=1e-3, atol=1e-8 * scale**2
    )


_ONE_PIXEL = {"width": 1, "height": 1, "rfilter": {"type": "gaussian"}}
_CROP_AND_BORDER = {"width": 31, "height": 29, "crop_offset_x": 5, "crop_offset_y": 9,
                    "crop_width": 13, "crop_height": 11, "rfilter": {"type": "gaussian"},
                    "sample_border": True}  # fmt: skip


@pytest.mark.parametrize(
    ("nested", "changes"),
    [
        ("path", {"width": 1, "height": 1}),
        ("path", {"width": 9, "height": 7, "rfilter": {"type": "mitchell"}}),
        ("path", {"width": 9, "height": 7, "component_format": "float16"}),
        ("neepp", _ONE_PIXEL),
        ("neepp", _CROP_AND_BORDER),
        ("ptracer", _CROP_AND_BORDER),
    ],
    ids=["one pixel", "mitchell", "float16", "one pixel, neepp", "crop, neepp", "crop, ptracer"],
)
def test_odd_films_hold_the_returned_image(nested, changes):
    scene = small_scene(**changes)
    # A single pixel has few samples to tell its variance from
    spp = 64 if "crop_width" in changes else 1024
    image = mi.render(scene, integrator=with_variance(nested), spp=spp).numpy()
    crop = scene.sensors()[0].film().crop_size()
    assert image.shape[:2] == (crop[1], crop[0])
    assert np.isfinite(image).all() and image.any() and (image[..., -3:] >= 0).all()
    channels = film_channels(scene)
    np.testing.assert_allclose(np.stack(list(channels.values()), 2), image, rtol=1e-6)
    plain = mi.load_dict({"type": nested}).render(scene, spp=4 * spp).numpy()
    error = np.sqrt(image[..., -3:].mean())
    assert abs(image[..., :3].mean() - plain[..., :3].mean()) < 4 * error + 1e-3 * plain.mean()


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_other_variants(variant):
    colors = ["Y"] if mi.is_monochromatic else ["R", "G", "B"]
    scene = small_scene(6, 5, pixel_format="luminance" if mi.is_monochromatic else "rgb")
    for nested in ("path", "ptracer", "neepp"):
        integrator = with_variance(nested)
        assert integrator.aov_names() == [f"variance.{color}" for color in colors]
        image = mi.render(scene, integrator=integrator, spp=64).numpy()
        assert image.shape == (5, 6, 2 * len(colors))
        assert np.isfinite(image).all() and (image[..., len(colors) :] > 0).any()
        assert list(film_channels(scene)) == colors + integrator.aov_names()


def test_aovs_of_the_nested_integrator_are_passed_on_as_means():
    scene = small_scene(8, 6)
    ours = with_variance({"type": "composed_path", "aovs": "d:depth,n:sh_normal"})
    image = mi.render(scene, integrator=ours, spp=16).numpy()
    assert ours.aov_names()[:4] == ["d.T", "n.X", "n.Y", "n.Z"]
    channels = film_channels(scene)
    assert list(channels) == ["R", "G", "B", *ours.aov_names()]
    np.testing.assert_allclose(np.stack(list(channels.values()), 2), image, rtol=1e-6)

    aov = {"type": "aov", "aovs": "d:depth,n:sh_normal", "img": {"type": "path"}}
    mitsubas = with_variance(aov)
    wrapped = mi.render(scene, integrator=mitsubas, spp=16).numpy()
    assert mitsubas.aov_names() == [
        "img.R", "img.G", "img.B", "img.A", "d.T", "n.X", "n.Y", "n.Z",
        "variance.R", "variance.G", "variance.B",
    ]  # fmt: skip
    assert list(film_channels(scene)) == ["R", "G", "B", *mitsubas.aov_names()]
    # Both see the same camera rays, and the nested integrator makes the image
    np.testing.assert_allclose(wrapped[..., 7:11], image[..., 3:7], rtol=1e-3, atol=1e-4)
    plain = mi.render(scene, integrator=with_variance("path"), spp=16).numpy()
    np.testing.assert_allclose(wrapped[..., :3], plain[..., :3], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(wrapped[..., -3:], plain[..., -3:], rtol=1e-2, atol=1e-6)


def test_moment_can_be_nested():
    scene = small_scene(6, 5)
    integrator = with_variance({"type": "moment", "m": {"type": "path"}})
    mi.render(scene, integrator=integrator, spp=16)
    assert "m2_m.X" in film_channels(scene) and "variance.R" in film_channels(scene)


def test_films_that_are_not_rgb_are_refused():
    mi.set_variant("llvm_ad_spectral")
    try:
        special = {"type": "specfilm", "width": 4, "height": 4,
                   "band": {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}}  # fmt: skip
        scene = mi.load_dict(stage(camera=sensor(film=special)))
        with pytest.raises(NotImplementedError, match='"variance".*hdrfilm'):
            with_variance().render(scene, spp=4)
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_command_line_writes_the_channels(run, make_scene, tmp_path):
    xml = """<integrator type="variance"><integer name="batches" value="5"/>
             <integrator type="ptracer"><integer name="max_depth" value="3"/></integrator>
             </integrator>"""
    code, _, err = run(
        "render", make_scene(integrator=xml), "-o", tmp_path / "a.exr", "--spp", 20
    )
    assert (code, err) == (0, "")
    channels, metadata = read_exr(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B", "variance.R", "variance.G", "variance.B"}
    assert metadata["spp"] == 20 and np.isfinite(list(channels.values())).all()
    assert run("render", make_scene(integrator=xml), "-o", tmp_path / "a.png", "--spp", 20)[0] == 0
