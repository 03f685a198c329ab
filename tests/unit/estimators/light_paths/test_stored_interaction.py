"""A stored vertex is read back as the light walk saw it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.stored_interaction import (
    from_words,
    interaction_words,
    needs_whole_interaction,
    to_words,
)
from tests.support.stage import diffuse

pytestmark = pytest.mark.usefixtures("variant")

_STRIPES = {"type": "checkerboard"}

_BUMPS = ("bump", "normals")

_PLAIN = {
    "textured": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _STRIPES}},
    "anisotropic": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4},
    "transmits": {"type": "roughdielectric", "alpha": 0.3},
    "layered": {"type": "roughplastic"},
    "principled": {"type": "principled", "anisotropic": 0.7, "roughness": 0.4, "spec_trans": 0.4},
    "thin": {"type": "principledthin", "roughness": 0.4, "spec_trans": 0.4, "diff_trans": 0.5},
    "masked": {"type": "mask", "opacity": _STRIPES, "bsdf": {"type": "plastic"}},
    "blended": {
        "type": "blendbsdf", "weight": _STRIPES, "one": diffuse(0.5), "two": {"type": "plastic"},
    },
}  # fmt: skip


def _bumps(kind: str) -> dict[str, Any]:
    """A BSDF that turns the frame."""
    channels = 1 if kind == "bump" else 3
    values = np.random.default_rng(3).uniform(0.4, 0.6, (8, 8, channels)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
    if kind == "bump":
        return {"type": "bumpmap", "bsdf": diffuse(0.5), "texture": texture}
    return {"type": "normalmap", "bsdf": diffuse(0.5), "normalmap": texture}


def _scene(bsdf: dict[str, Any]) -> mi.Scene:
    """Smooth and flat shapes, turned and stretched."""
    T = mi.ScalarTransform4f().rotate([1, 2, 3], 50).scale([1, 0.6, 1.4])
    apart = mi.ScalarTransform4f().translate
    return mi.load_dict({
        "type": "scene", "material": bsdf,
        "sphere": {"type": "sphere", "radius": 0.8, "b": {"type": "ref", "id": "material"}},
        "cube": {"type": "cube", "to_world": apart([3, 0, 0]) @ T,
                 "b": {"type": "ref", "id": "material"}},
        "cylinder": {"type": "cylinder", "to_world": apart([0, 3, 0]) @ T,
                     "b": {"type": "ref", "id": "material"}},
    })  # fmt: skip


def _hits(scene: mi.Scene) -> mi.SurfaceInteraction3f:
    rng = np.random.default_rng(1)
    origin = rng.normal(size=(3, 30000))
    origin *= 8 / np.linalg.norm(origin, axis=0)
    target = rng.uniform(-1, 1, size=(3, 30000)) + np.eye(3)[rng.integers(0, 2, 30000)].T * 3
    o = mi.Point3f(*origin.astype(np.float32))
    ray = mi.Ray3f(o, dr.normalize(mi.Point3f(*target.astype(np.float32)) - o))
    si = scene.ray_intersect(ray)
    hit = dr.compress(si.is_valid())
    assert len(hit) > 2000
    return dr.gather(mi.SurfaceInteraction3f, si, hit)


@pytest.mark.parametrize("bsdf", [*_PLAIN, *_BUMPS])
def test_a_bsdf_has_the_same_value_and_density_at_a_stored_interaction(bsdf: str) -> None:
    scene = _scene(_bumps(bsdf) if bsdf in _BUMPS else _PLAIN[bsdf])
    is_whole = needs_whole_interaction(scene)
    assert is_whole == (bsdf in _BUMPS)
    si = _hits(scene)
    words = to_words(si, is_whole)
    assert len(words) == interaction_words(is_whole)
    stored = from_words(words, is_whole)
    for axis in range(3):
        d = mi.Vector3f(*(1.0 if i == axis else 0.3 for i in range(3)))
        np.testing.assert_allclose(
            stored.sh_frame.to_world(d).numpy(), si.sh_frame.to_world(d).numpy(), atol=1e-6
        )
    np.testing.assert_allclose(stored.n.numpy(), si.n.numpy(), atol=1e-6)
    wo = si.to_local(dr.normalize(mi.Vector3f(0.3, -0.5, 0.8)))
    found = stored.bsdf().eval_pdf(mi.BSDFContext(), stored, wo)
    expected = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo)
    assert np.max(expected[1].numpy()) > 0
    for a, b in zip(found, expected):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4, atol=1e-5)


def test_the_whole_interaction_is_stored_for_other_bsdfs_and_textures() -> None:
    hair = {"type": "hair"}
    nested = {"type": "twosided", "bsdf": _bumps("bump")}
    attribute = {
        "type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"},
    }  # fmt: skip
    for bsdf in (hair, nested, attribute):
        assert needs_whole_interaction(mi.load_dict({
            "type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf},
        }))  # fmt: skip
    T = mi.ScalarTransform4f()
    assert needs_whole_interaction(mi.load_dict({
        "type": "scene",
        "group": {"type": "shapegroup", "shape": {"type": "sphere", "bsdf": diffuse(0.5)}},
        "instance": {"type": "instance", "to_world": T, "g": {"type": "ref", "id": "group"}},
    }))  # fmt: skip
