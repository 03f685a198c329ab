"""The dispersive BSDFs alone: directions, weights, densities, parameters."""

from __future__ import annotations

from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.heroes import DISPERSES
from mitsuba_ext.transport.materials.glass import GLASSES
from tests.support.glass_objects import WRAPPERS, wrapped

pytestmark = pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)

COUNT = 20_000
AIR = 1.000277
SMOOTH, ROUGH = "dispersive_dielectric", "dispersive_roughdielectric"
ROUGH_KINDS = [
    {"distribution": "ggx", "sample_visible": True, "alpha": 0.3},
    {"distribution": "ggx", "sample_visible": False, "alpha_u": 0.1, "alpha_v": 0.4},
    {"distribution": "beckmann", "sample_visible": True, "alpha_u": 0.1, "alpha_v": 0.4},
    {"distribution": "beckmann", "sample_visible": False, "alpha": 0.3},
]
#: Masks without the bits of refraction and of reflection.
NO_TRANSMISSION, NO_REFLECTION = 0x1FF & ~0x154, 0x1FF & ~0xAA


def heroic(mask: int = 0x1FF, mode: Any = None) -> mi.BSDFContext:
    """The context of a caller who knows what heroes are."""
    return mi.BSDFContext(mode or mi.TransportMode.Radiance, mask | DISPERSES)


def directions(rng: np.random.Generator) -> mi.Vector3f:
    d = rng.normal(size=(3, COUNT))
    return mi.Vector3f(d / np.linalg.norm(d, axis=0))


def interaction(rng: np.random.Generator) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi = directions(rng)
    si.wavelengths = mi.Spectrum(rng.uniform(360, 830, (4, COUNT)))
    return si


def fresnel(cos_i: np.ndarray, η: np.ndarray) -> np.ndarray:
    """Unpolarised reflectance in double precision; ``η`` is the index of the other side."""
    cos_t = np.sqrt(np.maximum(0, 1 - (1 - cos_i**2) / η**2))
    s = (cos_i - η * cos_t) / (cos_i + η * cos_t)
    p = (η * cos_i - cos_t) / (η * cos_i + cos_t)
    return (s**2 + p**2) / 2


# ---- Directions and weights ----


@pytest.mark.parametrize("glass", GLASSES)
def test_the_hero_obeys_snell_and_all_wavelengths_fresnel(variant: str, glass: str) -> None:
    rng = np.random.default_rng(1)
    si = interaction(rng)
    bsdf = mi.load_dict({"type": SMOOTH, "int_ior": glass})
    bs, weight = bsdf.sample(heroic(), si, mi.Float(rng.uniform(size=COUNT)), mi.Point2f(0))
    wi, wo = np.array(si.wi, dtype=float), np.array(bs.wo, dtype=float)
    λ = np.array(si.wavelengths, dtype=float)
    n = np.vectorize(GLASSES[glass])(λ) / AIR
    η = np.where(wi[2] > 0, n, 1 / n)
    reflects = wi[2] * wo[2] > 0
    np.testing.assert_allclose(wo[2][reflects], wi[2][reflects])
    np.testing.assert_allclose(wo[:2], np.where(reflects, -wi[:2], -wi[:2] / η[0]), atol=2e-6)
    np.testing.assert_allclose(np.array(bs.eta), np.where(reflects, 1, η[0]), rtol=1e-6)
    # Steep slopes near the critical angle enlarge errors of float32
    F = fresnel(np.abs(wi[2]), η)
    far = np.abs(1 - (1 - wi[2] ** 2) / η**2).min(0) > 1e-3
    np.testing.assert_allclose(
        np.array(weight)[:, reflects & far], (F / F[0])[:, reflects & far], rtol=2e-3
    )
    passes = ~reflects & far
    np.testing.assert_allclose(
        np.array(weight)[:, passes], np.tile(1 / η[0] ** 2, (4, 1))[:, passes], rtol=1e-5
    )
    assert (F[0][~reflects] < 1).all() and 0.02 < reflects.mean() < 0.7


@pytest.mark.parametrize("plugin", [SMOOTH, ROUGH])
def test_corner_cases_are_finite(variant: str, plugin: str) -> None:
    bsdf = mi.load_dict({"type": plugin, "int_ior": "diamond"})
    x = [-1.0, -1e-4, -0.0, 0.0, 1e-6, 1e-3, 0.5, 1.0]
    cos_i, cos_o, u = (np.ravel(a) for a in np.meshgrid(x, x, [0.0, 1e-7, 0.5, 1 - 1e-7]))
    si = dr.zeros(mi.SurfaceInteraction3f, len(u))
    si.wavelengths = mi.Spectrum(400, 500, 600, 700)
    si.wi = mi.Vector3f(np.sqrt(1 - cos_i**2), 0, cos_i)
    wo = mi.Vector3f(-np.sqrt(1 - cos_o**2), 0, cos_o)
    for mask in (0x1FF, NO_TRANSMISSION, NO_REFLECTION, 0):
        value, pdf = bsdf.eval_pdf(heroic(mask), si, wo)
        bs, weight = bsdf.sample(heroic(mask), si, mi.Float(u), mi.Point2f(mi.Float(u), 0.5))
        for result in (value, pdf, bs.pdf, weight):
            result = np.array(result)
            assert np.isfinite(result).all() and (result >= 0).all()


# ---- Against Mitsuba's own ----


@pytest.mark.parametrize(
    "ours, theirs, extra",
    [(SMOOTH, "dielectric", {}), *((ROUGH, "roughdielectric", kind) for kind in ROUGH_KINDS)],
)
def test_constant_index_agrees_with_mitsuba(variant: str, ours: str, theirs: str, extra) -> None:
    rng = np.random.default_rng(2)
    si, wo = interaction(rng), directions(rng)
    u, v = mi.Float(rng.uniform(size=COUNT)), mi.Point2f(rng.uniform(size=(2, COUNT)))
    parameters = {"int_ior": 1.6, "specular_reflectance": 0.7, **extra}
    a, b = (mi.load_dict({"type": name, **parameters}) for name in (ours, theirs))
    assert a.flags() == b.flags() and [a.flags(k) for k in (0, 1)] == [b.flags(k) for k in (0, 1)]
    modes = (mi.TransportMode.Radiance, mi.TransportMode.Importance)
    for mode, mask in product(modes, (0x1FF, NO_TRANSMISSION, NO_REFLECTION)):
        ctx = mi.BSDFContext(mode, mask)
        (value_a, pdf_a, bs_a, weight_a), (value_b, pdf_b, bs_b, weight_b) = (
            bsdf.eval_pdf_sample(ctx, si, wo, u, v) for bsdf in (a, b)
        )
        lives = dr.any(weight_b != 0)
        bs_a, bs_b = (dr.select(lives, bs, dr.zeros(type(bs))) for bs in (bs_a, bs_b))
        dr.eval(value_a, pdf_a, bs_a, weight_a, value_b, pdf_b, bs_b, weight_b)
        np.testing.assert_allclose(np.array(value_a), np.array(value_b), rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(np.array(pdf_a), np.array(pdf_b), rtol=1e-5, atol=1e-6)
        if extra.get("sample_visible", True):  # Mitsuba's weights are wrong otherwise
            np.testing.assert_allclose(np.array(weight_a), np.array(weight_b), rtol=1e-5)
        for name in ("wo", "pdf", "eta", "sampled_type", "sampled_component"):
            x, y = np.array(getattr(bs_a, name)), np.array(getattr(bs_b, name))
            np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", ROUGH_KINDS)
def test_weight_of_a_sample_is_its_value_over_its_density(variant: str, kind) -> None:
    rng = np.random.default_rng(4)
    si = interaction(rng)
    u, v = mi.Float(rng.uniform(size=COUNT)), mi.Point2f(rng.uniform(size=(2, COUNT)))
    bsdf = mi.load_dict({"type": ROUGH, "int_ior": 1.6, **kind})
    bs, weight = bsdf.sample(heroic(), si, u, v)
    value, _ = bsdf.eval_pdf(heroic(), si, bs.wo)
    lives = dr.any(weight != 0)
    expected = dr.select(lives, value / bs.pdf, 0)
    np.testing.assert_allclose(np.array(weight), np.array(expected), rtol=2e-3)
    assert dr.count(lives)[0] > COUNT / 2


@pytest.mark.parametrize("visible", [True, False])
@pytest.mark.parametrize("wi", [(0.4, 0.2, 0.8), (-0.6, 0.3, -0.7)], ids=["outside", "inside"])
@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
def test_density_agrees_with_the_samples(variant: str, distribution: str, wi, visible) -> None:
    sample, pdf = mi.chi2.BSDFAdapter(
        ROUGH,
        {"type": ROUGH, "int_ior": "sf10", "distribution": distribution, "alpha_u": 0.2,
         "alpha_v": 0.4, "sample_visible": visible},
        wi=mi.ScalarVector3f(wi) / np.linalg.norm(wi),
        ctx=heroic(),
    )  # fmt: skip
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=pdf,
        sample_dim=3,
        sample_count=200_000,
        res=51,
        ires=16,
    )
    assert test.run()


# ---- Scenes and errors ----


def test_xml_and_dictionary_say_the_same(variant: str) -> None:
    xml = mi.load_string(
        f'<bsdf version="3.0.0" type="{ROUGH}"><string name="cauchy" value="1.5, 0.01"/>'
        '<float name="alpha" value="0.2"/><string name="distribution" value="ggx"/></bsdf>'
    )
    dictionary = mi.load_dict(
        {"type": ROUGH, "cauchy": "1.5 0.01", "alpha": 0.2, "distribution": "ggx"}
    )
    assert "cauchy 1.5, 0.01" in str(xml) and "GGX" in str(xml)
    assert str(xml).replace("1.5, 0.01", "1.5 0.01") == str(dictionary)
    textured = mi.load_dict({"type": SMOOTH, "specular_transmittance": 0.5})
    assert "specular_transmittance.value" in mi.traverse(textured)
    assert "alpha.value" in mi.traverse(xml)


def test_sellmeier_and_name_say_the_same(variant: str) -> None:
    sellmeier = "1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653"
    si = interaction(np.random.default_rng(3))
    results = [
        bsdf.sample(heroic(), si, mi.Float(0.9), mi.Point2f(0))[0].wo
        for bsdf in (mi.load_dict({"type": SMOOTH, **p}) for p in ({}, {"sellmeier": sellmeier}))
    ]
    np.testing.assert_array_equal(*map(np.array, results))


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("plugin", [SMOOTH, ROUGH])
def test_wrappers_hand_on_that_it_disperses(variant: str, wrapper: str, plugin: str) -> None:
    for index, disperses in (("f2", True), (1.5, False)):
        bsdf = mi.load_dict(wrapped(wrapper, {"type": plugin, "int_ior": index}))
        assert bool(bsdf.flags() & DISPERSES) == disperses
        si = interaction(np.random.default_rng(4))
        bsdf.sample(heroic(), si, mi.Float(0.5), mi.Point2f(0.5))
        if disperses:
            for ctx in (mi.BSDFContext(), heroic(0xFFFFFFFF)):
                with pytest.raises(Exception, match="composed_path"):
                    bsdf.sample(ctx, si, mi.Float(0.5), mi.Point2f(0.5))


@pytest.mark.parametrize("plugin, parameters, message", [
    (SMOOTH, {"int_ior": "chalk"}, "'chalk'; it must be a number or one of bk7, bak4"),
    (SMOOTH, {"int_ior": -1.5}, "-1.5; it must be positive"),
    (SMOOTH, {"int_ior": True}, "a number or a name"),
    (SMOOTH, {"ext_ior": "bk7"}, "'bk7'; it must be a number or one of vacuum"),
    (SMOOTH, {"int_ior": "f2", "cauchy": "1.5, 0.1"}, "int_ior and cauchy are given"),
    (SMOOTH, {"cauchy": "1.5"}, "a text of 2 or 3 numbers"),
    (SMOOTH, {"cauchy": 1.5}, "a text of 2 or 3 numbers"),
    (SMOOTH, {"cauchy": "1.5, b"}, "a text of 2 or 3 numbers"),
    (SMOOTH, {"cauchy": "-1, 0.2"}, "not a positive number at 448 nm"),
    (SMOOTH, {"sellmeier": "1, 0, 0, 0.25, 0, 0"}, "pole at 500 nm"),
    (SMOOTH, {"sellmeier": "1, 2"}, "a text of 6 numbers"),
    (SMOOTH, {"alpha": 0.1}, "alpha"),
    (ROUGH, {"int_ior": "f2", "ext_ior": 1.62}, "must differ at all wavelengths"),
    (ROUGH, {"int_ior": 1.5, "ext_ior": 1.5}, "must differ at all wavelengths"),
    (ROUGH, {"distribution": "phong"}, "must be one of beckmann, ggx"),
    (ROUGH, {"alpha_u": 0.1}, "either alpha, or alpha_u and alpha_v"),
])  # fmt: skip
def test_wrong_parameters_are_named(variant: str, plugin: str, parameters, message: str) -> None:
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": plugin, **parameters})


@pytest.mark.parametrize("plugin", [SMOOTH, ROUGH])
@pytest.mark.parametrize("other", ["llvm_ad_rgb", "llvm_ad_mono"])
def test_variants_without_wavelengths_are_refused(variant: str, other: str, plugin: str) -> None:
    mi.set_variant(other)
    with pytest.raises(Exception, match="use a spectral one such as"):
        mi.load_dict({"type": plugin})
    bsdf = mi.load_dict({"type": plugin, "int_ior": 1.5})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0.6, 0, 0.8)
    assert dr.all(bsdf.sample(mi.BSDFContext(), si, 0.9, mi.Point2f(0.5))[1] > 0, axis=None)
