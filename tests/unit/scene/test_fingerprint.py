"""The hash that says whether two scenes are the same."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.scene.fingerprint import fingerprint
from tests.support.fogs import fog, homogeneous
from tests.support.stage import stage

pytestmark = pytest.mark.usefixtures("variant")


def test_a_fingerprint_leaves_the_scene_as_it_is() -> None:
    """Kernels contain literals as numbers, and load evaluated arrays. Saving what was learned
    evaluated the literal `g` of a phase function: the first render of a scene then had other
    kernels than the next one, and a path here and there took another way by rounding."""
    scene = mi.load_dict(fog(medium=homogeneous(g=0.3)))
    key = "fog.interior_medium.phase_function.g"
    assert mi.traverse(scene)[key].state == dr.VarState.Literal
    found = fingerprint(scene)
    assert mi.traverse(scene)[key].state == dr.VarState.Literal
    assert fingerprint(mi.load_dict(fog(medium=homogeneous(g=0.3)))) == found
    assert fingerprint(mi.load_dict(fog(medium=homogeneous(g=0.4)))) != found


def test_hair_given_by_its_pigments_has_a_fingerprint() -> None:
    """Mitsuba raises a TypeError for its parameter `sigma_a`, which has no value."""

    def hair(eumelanin: float) -> str:
        bsdf = {"type": "hair", "eumelanin": eumelanin, "pheomelanin": 0.2}
        return fingerprint(mi.load_dict(stage(shape={"type": "sphere", "bsdf": bsdf})))

    assert hair(0.3) == hair(0.3) != hair(0.4)
