"""Light that passes dispersive glass: one wavelength goes on, and the mean stays what it was.

Where all four wavelengths of a ray are the same one, whatever happens to three of them cannot be
wrong, and Mitsuba's ``path`` with a constant index is the reference. With four different ones, the
light of every band of wavelengths must be what it is with four that are the same.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.startup.garbage import garbage_left_alone
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.heroes import DISPERSES, Heroes, disperses, warn_of_sampler
from mitsuba_ext.transport.materials.glass import GLASSES
from mitsuba_ext.transport.walk import Walk
from tests.support.glass_objects import WRAPPERS, wrapped
from tests.support.statistical import batches, compare_pixels, sidak, z_of_means, z_welch
from tests.support.techniques import TECHNIQUES

pytestmark = pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)

SMOOTH = {"type": "dispersive_dielectric", "int_ior": "sf10"}
ROUGH = {
    "type": "dispersive_roughdielectric", "int_ior": "sf10", "distribution": "ggx", "alpha": 0.3
}  # fmt: skip
GLASS = {"smooth": SMOOTH, "rough": ROUGH}
#: The same numbers would be no second opinion.
SEED, OTHER_SEED = 1, 101
BANDS = np.array([360, 470, 530, 600, 830])
CASES = [
    ("smooth", None),
    ("rough", None),
    *(pytest.param("rough", wrapper, marks=pytest.mark.slow) for wrapper in WRAPPERS),
]


def stage(bsdf: dict[str, Any], connects: bool = True, **others: Any) -> mi.Scene:
    """A ball of glass before a coloured wall, in light that depends on place and wavelength."""
    t = mi.ScalarTransform4f()
    lamp = {"type": "spectrum", "value": [(360, 1), (500, 14), (560, 2), (830, 9)]}
    wall = {"type": "spectrum", "value": [(360, 0.9), (560, 0.1), (830, 0.8)]}
    return mi.load_dict({
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": bsdf},
        "wall": {
            "type": "rectangle",
            "to_world": t.translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": wall},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": t.look_at([1.5, 2, -1.5], [0, 0, 0], [0, 1, 0]).scale(0.7),
            "bsdf": {"type": "diffuse"},
            "emitter": {"type": "area", "radiance": lamp, "sampling_weight": float(connects)},
        },
        "sky": {
            "type": "constant",
            "radiance": {"type": "d65", "scale": 0.2},
            "sampling_weight": float(connects),
        },
        **others,
    })  # fmt: skip


def rays(sampler: mi.Sampler) -> mi.Ray3f:
    """From a point, over the ball and a little beyond."""
    target = mi.warp.square_to_uniform_disk(sampler.next_2d()) * 1.1
    d = dr.normalize(mi.Vector3f(target.x, target.y, 4))
    return mi.Ray3f(mi.Point3f(0, 0, -4), d)


def wavelengths(sampler: mi.Sampler, spread: bool = True) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Four wavelengths, as a sensor chooses them or all the same, and their weights."""
    numbers = sampler.next_1d() + mi.Spectrum([k / 4 if spread else 0 for k in range(4)])
    return mi.sample_rgb_spectrum(dr.select(numbers < 1, numbers, numbers - 1))


def means(trace, seed: int, batch_count: int = 12, count: int = 1 << 14) -> np.ndarray:
    """What ``trace(sampler)`` returns, averaged over the paths of each batch: [batch, …]."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, batch_count * count)
    with garbage_left_alone():  # also where Mitsuba's path traces calls of our BSDFs
        values = [mi.Float(value) for value in trace(sampler)]
    dr.eval(values)
    return np.stack([v.numpy().reshape(batch_count, -1).mean(axis=1) for v in values], axis=1)


def assert_agree(a: np.ndarray, b: np.ndarray, precision: float) -> None:
    error = np.hypot(a.std(0, ddof=1), b.std(0, ddof=1)) / np.sqrt(len(a)) / b.mean(0)
    assert error.max() < precision, f"too noisy to say anything: {error}"
    z = z_welch(a, b)
    assert np.abs(z).max() < sidak(z.size), f"{a.mean(0)} instead of {b.mean(0)}: z = {z}"


# ---- The mean ----


@pytest.mark.parametrize("glass, wrapper", CASES)
def test_one_wavelength_agrees_with_path_at_its_index(variant: str, glass, wrapper) -> None:
    λ = 430.0

    def with_walk(sampler):
        ray = rays(sampler)
        ray.wavelengths = mi.Spectrum(λ)
        return [dr.mean(Walk(8, 5)(scene, sampler, CameraRays(ray), mi.Bool(True)).L)]

    def with_path(sampler):
        ray = mi.RayDifferential3f(rays(sampler))
        ray.wavelengths = mi.Spectrum(λ)
        return [dr.mean(path.sample(constant, sampler, ray)[0])]

    scene = stage(wrapped(wrapper, GLASS[glass]))
    index = GLASSES["sf10"](λ)
    path = mi.load_dict({"type": "path", "max_depth": 8})
    theirs = GLASS[glass]["type"].replace("dispersive_", "")
    constant = stage(wrapped(wrapper, {**GLASS[glass], "type": theirs, "int_ior": index}))
    assert_agree(means(with_walk, SEED), means(with_path, OTHER_SEED), precision=0.02)


@pytest.mark.parametrize("glass, wrapper", CASES)
def test_bands_of_wavelengths_have_their_light(variant: str, glass: str, wrapper) -> None:
    scene = stage(wrapped(wrapper, GLASS[glass]))

    def bands(spread: bool):
        def trace(sampler):
            ray = rays(sampler)
            λ, weight = wavelengths(sampler, spread)
            ray.wavelengths = λ
            L = Walk(8, 5)(scene, sampler, CameraRays(ray), mi.Bool(True)).L * weight
            limits = zip(map(float, BANDS), map(float, BANDS[1:]))
            return [dr.mean(dr.select((λ >= a) & (λ < b), L, 0)) for a, b in limits]

        return trace

    assert_agree(means(bands(True), SEED), means(bands(False), OTHER_SEED), precision=0.05)


@pytest.mark.parametrize("glass", GLASS)
def test_connections_and_scattering_agree(variant: str, glass: str) -> None:
    """Without connections, MIS weights cannot hide anything."""

    def trace(sampler):
        ray = rays(sampler)
        λ, weight = wavelengths(sampler)
        ray.wavelengths = λ
        L = Walk(6, 6)(scene, sampler, CameraRays(ray), mi.Bool(True)).L * weight
        return [dr.mean(dr.select(λ < 530.0, L, 0)), dr.mean(dr.select(λ < 530.0, 0, L))]

    scene = stage(GLASS[glass])
    both = means(trace, SEED)
    # Something has to be connected to
    nothing = {"type": "point", "intensity": 1e-9, "position": [0, 0, -9]}
    scene = stage(GLASS[glass], connects=False, nothing=nothing)
    assert_agree(both, means(trace, OTHER_SEED), precision=0.05)


# ---- Exact answers ----


def sensor() -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40, "film": film, "to_world": view}


def furnace(bsdf: dict[str, Any], **others: Any) -> mi.Scene:
    slab = mi.ScalarTransform4f().translate([0, 0, 3]).scale([2, 2, 0.2])
    return mi.load_dict({
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": bsdf},
        "slab": {"type": "cube", "to_world": slab, "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": {"type": "d65"}},
        "sensor": sensor(),
        **others,
    })  # fmt: skip


WHITE = {
    "smooth": SMOOTH,
    "diamond": {**SMOOTH, "int_ior": "diamond"},
    # So smooth that hardly anything is scattered twice, and lost
    "nearly smooth": {**ROUGH, "alpha": 0.002},
}


@pytest.mark.parametrize("name", WHITE)
def test_white_stays_white_behind_several_pieces_of_glass(variant: str, name: str) -> None:
    """Where the sky is all there is, glass cannot be seen, and has no colour."""
    seeds = [SEED, SEED + 1]
    images = batches(furnace(WHITE[name]), TECHNIQUES["composed_path"].make(), 1536, seeds)
    # Channels of single wavelengths may be negative: their means, not their signs, are looked at
    for channel in range(3):
        values = images[..., channel].reshape(2, -1)
        z, error = z_of_means(values, 1.0, allowance=1e-3)
        assert abs(z) < sidak(3) and error < 0.005, (z, error, values.mean())


# ---- Integrators ----


@pytest.mark.parametrize(
    "name",
    [
        "neepp",
        pytest.param("pss_guided", marks=pytest.mark.slow),
        pytest.param("many_connections", marks=pytest.mark.slow),
    ],
)
def test_techniques_keep_the_mean(variant: str, name: str) -> None:
    turned = mi.ScalarTransform4f().translate([-1.3, -1, 0]).rotate([1, 1, 0], 40).scale(0.4)
    gem = {"type": "cube", "bsdf": SMOOTH, "to_world": turned}
    scene = stage(ROUGH, sensor=sensor(), gem=gem)
    ours = batches(scene, TECHNIQUES[name].make(8), 256, [SEED, SEED + 1])
    seeds = [OTHER_SEED, OTHER_SEED + 1]
    reference = batches(scene, TECHNIQUES["composed_path"].make(8), 1024, seeds)
    result = compare_pixels(ours, reference)
    assert np.abs(result.regions).max() < sidak(result.regions.size), str(result)
    assert np.abs(result.tiles).max() < sidak(result.tiles.size), str(result)
    assert result.precision < 0.02, str(result)


@pytest.mark.parametrize("name", ["path", "prb", "direct"])
@pytest.mark.parametrize("glass", GLASS)
def test_integrators_of_mitsuba_are_warned_of_and_show_no_glass(
    variant: str, monkeypatch: pytest.MonkeyPatch, name: str, glass: str
) -> None:
    """The pixels of the glass are not finite. Another scene is rendered as if there were none."""
    warnings = []
    monkeypatch.setattr(mi, "Log", lambda level, text: level < mi.LogLevel.Warn or
                        warnings.append(text))  # fmt: skip
    scene, other = furnace(GLASS[glass]), furnace({"type": "diffuse"})
    ours = TECHNIQUES["composed_path"].make(4)
    assert np.isfinite(batches(scene, ours, 16, [1])).all()
    assert np.isfinite(batches(other, ours, 16, [1])).all()
    assert warnings == []
    theirs = mi.load_dict({"type": name})
    image = batches(scene, theirs, 16, [1])
    assert (~np.isfinite(image)).mean() > 0.7
    assert len(warnings) == 1 and "needs an integrator of mitsuba_ext" in warnings[0]
    assert np.isfinite(batches(other, theirs, 16, [1])).all()


@pytest.mark.parametrize("glass", GLASS)
def test_constant_index_needs_no_integrator_of_ours(variant: str, glass: str) -> None:
    ours = {**GLASS[glass], "int_ior": 1.7}
    theirs = {**ours, "type": ours["type"].replace("dispersive_", "")}
    path = mi.load_dict({"type": "path", "max_depth": 8})
    images = [batches(furnace(bsdf), path, 32, [1]) for bsdf in (ours, theirs)]
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-3)


# ---- What the walk is told ----


def test_refraction_leaves_one_wavelength_and_reflection_four(variant: str) -> None:
    """Through the four faces of two slabs, and with a weight that counts once."""
    t = mi.ScalarTransform4f()

    def light(bsdf: dict[str, Any], hero_weight: float = 1.0) -> np.ndarray:
        slabs = {
            f"slab {z}": {"type": "cube", "to_world": t.translate([0, 0, z]).scale([9, 9, 0.1]),
                          "bsdf": bsdf}
            for z in (0, 1)
        }  # fmt: skip
        scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **slabs})
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, 1000)
        ray = mi.Ray3f(mi.Point3f(0, 0, -4), dr.normalize(mi.Vector3f(sampler.next_1d(), 0, 4)))
        ray.wavelengths = mi.Spectrum(400, 500, 600, 700)
        rays = CameraRays(ray, hero_weight=hero_weight)
        L = Walk(100, 100)(scene, sampler, rays, mi.Bool(True)).L
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = ray.wavelengths
        return np.array(L / scene.environment().eval(si))

    passed = light({**SMOOTH, "specular_reflectance": 0.0})
    assert not passed[1:].any()
    assert set(np.round(passed[0], 3)) == {0.0, 4.0}
    np.testing.assert_array_equal(
        light({**SMOOTH, "specular_reflectance": 0.0}, hero_weight=0.5), passed / 2
    )
    reflected = light({**SMOOTH, "specular_transmittance": 0.0})
    lives = reflected.any(axis=0)
    assert (reflected[:, lives] > 0).all() and 0 < lives.mean() < 0.2
    assert (np.diff(reflected[:, lives], axis=0) < 0).all()  # n falls, and so does F


def test_connections_through_glass_are_the_heros(variant: str) -> None:
    """Samples of the BSDF are too: otherwise MIS weights would not add up."""
    scene = furnace(ROUGH)
    heroes = Heroes(scene)
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi = mi.Vector3f(0, 0, 1)
    wo = mi.Vector3f(0, 0, [-1, 1])
    bsdf = mi.BSDFPtr(scene.shapes()[0].bsdf())
    value = mi.Spectrum(1, 2, 3, 4)
    for is_alone, passed in ((False, [4, 0, 0, 0]), (True, [1, 0, 0, 0])):
        result = heroes.connect(mi.Bool(is_alone), value, bsdf, si, wo).numpy()
        np.testing.assert_array_equal(result.T, [passed, [1, 2, 3, 4]])


def test_nothing_is_left_in_the_kernel_where_nothing_disperses(variant: str) -> None:
    scene = furnace({"type": "dispersive_dielectric", "int_ior": 1.5})
    heroes = Heroes(scene)
    value = mi.Spectrum(1)
    assert heroes.context().type_mask & ~DISPERSES == mi.BSDFContext().type_mask
    assert heroes.begin() is None
    assert heroes.connect((), value, None, None, None) is value
    assert heroes.scatter((), value, None, None, None) == (value, 1.0, ())


def test_dispersive_bsdfs_are_found_inside_other_bsdfs(variant: str) -> None:
    class Mover:
        children = (mi.load_dict({"type": "sphere", "bsdf": wrapped("mask", ROUGH)}),)

        def bsdf(self):
            return None

        def class_name(self):
            return "Mover"

    assert disperses([Mover()]) and not disperses([mi.load_dict({"type": "sphere"})])
    assert Heroes(furnace(SMOOTH)).context().type_mask & DISPERSES


def test_instances_disperse(variant: str) -> None:
    """Mitsuba does not say what is in them: they may."""
    group = {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": SMOOTH}}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({
        "type": "scene", "group": group, "ball": instance, "sky": {"type": "constant"},
        "sensor": sensor(),
    })  # fmt: skip
    images = batches(scene, TECHNIQUES["composed_path"].make(), 384, [SEED, SEED + 1])
    assert abs(z_of_means(images[..., 1].reshape(2, -1), 1.0, allowance=1e-3)[0]) < 4


def test_other_scenes_in_memory_do_no_harm(variant: str) -> None:
    """Dr.Jit traces the BSDFs of all scenes, whichever is rendered."""
    glass, other = furnace(SMOOTH), furnace({"type": "diffuse"})

    def render(scene: mi.Scene, name: str) -> np.ndarray:
        return batches(scene, TECHNIQUES[name].make() if name in TECHNIQUES
                       else mi.load_dict({"type": name}), 4, [1])  # fmt: skip

    a, b = render(other, "path"), render(other, "composed_path")
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    assert np.isfinite(render(glass, "composed_path")).all()


def test_dependent_numbers_of_ldsampler_are_warned_of(variant: str, monkeypatch) -> None:
    """Once per render, where light disperses and the sampler chooses the wavelengths."""
    warnings = []
    monkeypatch.setattr(mi, "Log", lambda level, text: level < mi.LogLevel.Warn or
                        warnings.append(text))  # fmt: skip
    film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}}
    walk = {"type": "composed_path", "max_depth": 1, "samples_per_pass": 2}
    reweighted = {"type": "reweighted_wavelength", "nested": walk}
    glass, opaque = (
        mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": bsdf}})
        for bsdf in (SMOOTH, {"type": "diffuse"})
    )
    samplers = {name: mi.load_dict({"type": name}) for name in ("ldsampler", "independent")}
    warn_of_sampler(glass, samplers["independent"])
    warn_of_sampler(opaque, samplers["ldsampler"])
    assert warnings == []
    for integrator, count in ((walk, 1), (reweighted, 0)):
        sensor = mi.load_dict(
            {"type": "perspective", "film": film, "sampler": samplers["ldsampler"]}
        )
        mi.render(glass, sensor=sensor, integrator=mi.load_dict(integrator), spp=4)
        found = [text for text in warnings if "ldsampler" in text]
        assert len(found) == count, (integrator["type"], warnings)
        warnings.clear()
