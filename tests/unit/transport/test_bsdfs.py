"""BSDFs return finite values, even where Mitsuba's do not."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.bsdfs import (
    DiffuseLobes,
    bsdf_density,
    diffuse_share,
    eval_and_sample_bsdf,
    eval_bsdf,
    sample_bsdf,
)

pytestmark = pytest.mark.usefixtures("variant")

_LANES = 1 << 14

_SIMPLE: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse"},
    "roughconductor": {"type": "roughconductor", "alpha": 0.3},
    "narrow": {"type": "roughconductor", "alpha": 1e-3, "distribution": "beckmann"},
    "all_normals": {"type": "roughconductor", "alpha": 0.3, "sample_visible": False},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    "principled": {"type": "principled", "roughness": 0.3, "metallic": 0.5, "clearcoat": 0.6},
    "principledthin": {"type": "principledthin", "spec_trans": 0.4, "diff_trans": 0.7},
}


def _nested() -> dict[str, dict[str, Any]]:
    pixels = np.random.default_rng(1).uniform(0, 1, (6, 6, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    found = dict(_SIMPLE)
    for name, bsdf in _SIMPLE.items():
        metal = _SIMPLE["roughconductor"]
        found[f"{name} and roughconductor"] = {
            "type": "blendbsdf", "weight": 0.7, "first": bsdf, "second": metal,
        }  # fmt: skip
    for name in ("roughconductor", "roughplastic", "roughdielectric"):
        bsdf = _SIMPLE[name]
        found[f"mask of {name}"] = {"type": "mask", "opacity": 0.5, "bsdf": bsdf}
        found[f"bumps of {name}"] = {"type": "bumpmap", "texture": texture, "bsdf": bsdf}
        found[f"normals of {name}"] = {"type": "normalmap", "normalmap": texture, "bsdf": bsdf}
    return found


def _directions(rng: np.random.Generator) -> mi.Vector3f:
    """On the whole sphere; many almost, and some exactly, in the plane of the surface."""
    d = rng.normal(size=(3, _LANES))
    d[2, : _LANES // 4] *= 1e-4
    d[2, : _LANES // 64] = 0
    return mi.Vector3f(rng.permutation(d / np.linalg.norm(d, axis=0), axis=1).astype(np.float32))


def _is_finite(value: Any) -> bool:
    return bool(np.isfinite(np.array(value)).all())


def test_everything_that_a_bsdf_returns_is_finite() -> None:
    rng, ctx = np.random.default_rng(2), mi.BSDFContext()
    si = dr.zeros(mi.SurfaceInteraction3f, _LANES)
    si.t, si.n, si.sh_frame = mi.Float(1), mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(rng.random((2, _LANES)).astype(np.float32))
    si.wi, wo = _directions(rng), _directions(rng)
    number = mi.Float(rng.random(_LANES).astype(np.float32))
    numbers = mi.Point2f(rng.random((2, _LANES)).astype(np.float32))
    is_undefined = set()
    for name, description in _nested().items():
        bsdf = mi.load_dict(description)
        ours = eval_and_sample_bsdf(bsdf, ctx, si, wo, number, numbers)
        theirs = bsdf.eval_pdf_sample(ctx, si, wo, number, numbers)
        alone = eval_bsdf(bsdf, ctx, si, wo), sample_bsdf(bsdf, ctx, si, number, numbers)
        density = bsdf_density(bsdf, ctx, si, wo)
        dr.eval(ours, theirs, alone, density)

        (value, pdf, bs, weight), (their_value, their_pdf, given, their_weight) = ours, theirs
        assert all(map(_is_finite, (value, pdf, bs.wo, bs.pdf, weight, density))), name
        if not (_is_finite(their_weight) and _is_finite(their_pdf)):
            is_undefined.add(name)
        # What is finite stays as it is
        is_kept = dr.all(dr.isfinite(their_weight) & dr.isfinite(given.wo)) & dr.isfinite(given.pdf)
        is_same = dr.all((weight == their_weight) & (bs.wo == given.wo)) & (bs.pdf == given.pdf)
        assert dr.all(is_same | ~is_kept), name
        assert dr.all((value == their_value) | ~dr.isfinite(their_value), axis=None), name
        # Alone as together
        (same_value, same_pdf), (again, same_weight) = alone
        is_sampled = dr.max(weight) > 0
        for mine, other in [(same_value, value), (same_pdf, pdf), (density, pdf),
                            (again.pdf, dr.select(is_sampled, bs.pdf, 0)),
                            (same_weight, weight)]:  # fmt: skip
            assert dr.allclose(mine, other, rtol=1e-3, atol=1e-5), name
    assert "diffuse and roughconductor" in is_undefined, "Mitsuba's are finite now"


def test_the_diffuse_share_is_the_same_however_the_whole_value_is_known() -> None:
    """From an evaluation, from a connection, and from a sample, whose weight is value / density."""
    rng, ctx = np.random.default_rng(4), mi.BSDFContext()
    metal, paint = _SIMPLE["roughconductor"], {"type": "diffuse", "reflectance": 0.4}
    kinds = {
        "both": {"type": "blendbsdf", "weight": 0.4, "first": paint, "second": metal},
        "two sides": {"type": "twosided", "bsdf": _SIMPLE["roughplastic"]},
        "principled": _SIMPLE["principled"],
    }
    si = dr.zeros(mi.SurfaceInteraction3f, _LANES)
    si.wi, si.sh_frame = _directions(rng), mi.Frame3f(mi.Normal3f(0, 0, 1))
    numbers = mi.Float(rng.random(_LANES)), mi.Point2f(rng.random((2, _LANES)))
    for name, described in kinds.items():
        plugin = mi.load_dict(described)
        bsdf = mi.BSDFPtr(plugin)
        weight = mi.Float(0.5) if name == "principled" else None
        bs, value = sample_bsdf(bsdf, ctx, si, *numbers)
        is_smooth = (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        evaluated, _ = eval_bsdf(bsdf, ctx, si, bs.wo)
        shares = [
            diffuse_share(bsdf, ctx, si, bs.wo, whole, weight)
            for whole in (None, evaluated, value * bs.pdf)
        ]
        if name != "principled":
            # And with the diffuse lobes from the call that samples
            lobes = DiffuseLobes()
            eval_and_sample_bsdf(bsdf, ctx, si, bs.wo, *numbers, lobes)
            shares += [
                diffuse_share(bsdf, ctx, si, bs.wo, evaluated, weight, known=known)
                for known in (lobes.connected, lobes.sampled)
            ]
        dr.eval(shares, is_smooth)  # in one kernel
        shares = [np.array(share)[:, np.array(is_smooth)] for share in shares]
        assert 0.05 < shares[0].mean() < 0.95, name
        for share in shares[1:]:
            assert np.quantile(np.abs(share - shares[0]), 0.999) < 1e-4, name


def test_bsdfs_with_lobes_of_one_kind_are_not_divided() -> None:
    si, wo = dr.zeros(mi.SurfaceInteraction3f), mi.Vector3f(0, 0, 1)
    si.wi = mi.Vector3f(0.6, 0, 0.8)
    for name, expected in (("diffuse", 1), ("roughconductor", 0), ("roughdielectric", 0)):
        plugin = mi.load_dict(_SIMPLE[name])
        share = diffuse_share(mi.BSDFPtr(plugin), mi.BSDFContext(), si, wo, None, None)
        np.testing.assert_array_equal(share, expected)
