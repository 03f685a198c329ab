"""BSDFs return finite values, even where Mitsuba's do not."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.bsdfs import bsdf_density, eval_and_sample_bsdf, eval_bsdf, sample_bsdf

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
