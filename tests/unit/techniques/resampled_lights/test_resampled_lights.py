"""Resampled importance sampling: candidates of connections, and the choice among them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.resampled_lights.resampled_lights import ResampledLights
from mitsuba_ext.transport.path_decisions import EmitterSampling, LightNumbers
from tests.support.maps import lamp
from tests.support.statistical import two_halves
from tests.support.techniques import TECHNIQUES

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 16


def _scene(bsdf: dict) -> mi.Scene:
    """A floor under a map with a sun and a lamp."""
    pixels = np.full((8, 16, 3), 0.3, np.float32)
    pixels[2, 5] = 40
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels),
           "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}
    return mi.load_dict({
        "type": "scene", "sky": sky, "lamp": lamp(0.5, 0.2, 1.0, radiance=9.0),
        "floor": {"type": "rectangle", "bsdf": bsdf},
    })  # fmt: skip


_BSDFS = {
    "diffuse": {"type": "diffuse"},
    "metal": {"type": "roughconductor", "alpha": 0.1},
    "coated": {"type": "plastic"},
}


def _vertex(scene: mi.Scene) -> mi.SurfaceInteraction3f:
    ray = mi.Ray3f(mi.Point3f(0.1, -2, 2), dr.normalize(mi.Vector3f(-0.1, 2, -2)))
    si = scene.ray_intersect(ray)
    assert dr.all(si.is_valid())
    return dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, LANES))


def _estimates(decision, scene, si, seed: int = 0) -> np.ndarray:
    """What connections bring if nothing is in between."""
    numbers = mi.PCG32(size=LANES, initseq=seed)
    point = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    choice = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    active = mi.Bool(True)
    place = decision.visit(decision.begin(None, None), scene, si, active)
    ds, weight, _ = decision.sample(place, scene, LightNumbers(point, choice), si, active)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d)) * weight
    return dr.select(ds.pdf > 0, mi.luminance(value), 0).numpy()


@pytest.mark.parametrize("candidates", [1, 2, 9])
@pytest.mark.parametrize("bsdf", _BSDFS)
def test_the_chosen_candidate_stands_for_all(bsdf: str, candidates: int) -> None:
    """Without MIS, the mean agrees with single light samples."""
    scene = _scene(_BSDFS[bsdf])
    si = _vertex(scene)
    plain = np.concatenate([_estimates(EmitterSampling(), scene, si, s) for s in range(1, 5)])
    resampled = _estimates(ResampledLights(scene, candidates), scene, si)
    error = np.hypot(plain.std() / np.sqrt(len(plain)), resampled.std() / np.sqrt(LANES))
    assert abs(plain.mean() - resampled.mean()) < 4 * error
    assert np.isfinite(resampled).all() and resampled.min() >= 0


def test_more_candidates_are_less_noisy() -> None:
    scene = _scene(_BSDFS["metal"])
    si = _vertex(scene)
    noise = [_estimates(ResampledLights(scene, count), scene, si).std() for count in (2, 8, 32)]
    assert noise[0] > 1.5 * noise[1] > 2.2 * noise[2]


def test_the_density_of_a_direction_is_the_same_when_a_bsdf_sample_finds_it() -> None:
    scene = _scene(_BSDFS["metal"])
    si, active = _vertex(scene), mi.Bool(True)
    decision = ResampledLights(scene, 6)
    numbers = mi.PCG32(size=LANES)
    point = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    choice = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    ds, _weight, place = decision.sample(
        decision.begin(None, None), scene, LightNumbers(point, choice), si, active
    )
    hit = scene.ray_intersect(si.spawn_ray(ds.d))
    found = mi.DirectionSample3f(scene, hit, si)
    pdf = si.bsdf().pdf(mi.BSDFContext(), si, si.to_local(ds.d))
    state = decision.remember(place, scene, ds.d, pdf, active)
    density = decision.density(state, scene, mi.Interaction3f(si), hit, found, active)
    # The same light: the lamp may stand before the sky
    same = ((ds.pdf > 0) & (found.emitter == ds.emitter)).numpy()
    assert same.mean() > 0.5
    ratio = density.numpy()[same] / ds.pdf.numpy()[same]
    assert np.mean(np.abs(ratio - 1) > 1e-2) < 1e-3


def test_a_surface_that_faces_away_gets_no_connection() -> None:
    """All candidates have the weight 0."""
    scene = _scene(_BSDFS["diffuse"])
    si = _vertex(scene)
    si.wi.z = -si.wi.z
    decision = ResampledLights(scene, 4)
    numbers = LightNumbers(mi.Point2f(0.3, 0.6), mi.Point2f(0.2, 0.7))
    ds, weight, _ = decision.sample(mi.Float(0), scene, numbers, si, mi.Bool(True))
    assert dr.all(ds.pdf == 0) and dr.all(weight.x == 0)


@pytest.mark.parametrize("plugin", ["bdpt", "pssmlt"])
def test_integrators_with_light_paths_refuse_it(plugin: str) -> None:
    with pytest.raises((RuntimeError, ValueError), match='"resampled_lights".*without light paths'):
        mi.load_dict({"type": plugin, "next_event": "resampled"})


def test_shadow_rays_stay_one_for_a_connection() -> None:
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant"},
        "floor": {"type": "rectangle", "bsdf": _BSDFS["diffuse"]},
        "sensor": {"type": "perspective",
                   "film": {"type": "hdrfilm", "width": 8, "height": 8},
                   "to_world": mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])},
    })  # fmt: skip
    integrator = TECHNIQUES["resampled"].make(2)
    two_halves(scene, integrator, 16, [1, 2])
    statistics = integrator.statistics
    assert 0 < statistics.rays["shadow"] <= 8 * 8 * 8
