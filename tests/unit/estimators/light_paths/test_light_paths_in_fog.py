"""Light paths in participating media: ``light_tracer``, ``bdpt`` and ``vcm`` in fog."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.fogs import (
    HARD_SCENES,
    SCENES,
    camera,
    caustic_in_fog,
    cube,
    fog,
    fog_around_the_camera,
    homogeneous,
)
from tests.support.stage import area, diffuse, lookat
from tests.support.statistical import (
    assert_images_are_sound,
    assert_same_quarters,
    batches,
    some,
    z_exact,
)

pytestmark = pytest.mark.usefixtures("variant")


def make(name: str = "bdpt", max_depth: int = 5, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": max_depth, **parameters})


# ---- Weights ----


def test_techniques_of_each_length_find_the_same_light(tmp_path: Path) -> None:
    """Connections to the light, light paths alone, and all techniques with their weights."""
    file = tmp_path / "techniques.exr"
    scene = mi.load_dict(fog("area", homogeneous([0.3, 0.6, 1.2])), optimize=False)
    make(max_depth=4, technique_images=str(file)).render(scene, spp=512, seed=3)
    layers = {}
    for name, values in mi.Bitmap(str(file)).split():
        layers[name] = np.array(values)[..., :3].mean()
    for length in (2, 3, 4):
        names = [f"s{s}_t{length + 1 - s}" for s in range(length + 1)]
        weighted = sum(layers.get(f"weighted.{name}", 0.0) for name in names)
        assert layers[f"plain.s1_t{length}"] == pytest.approx(weighted, rel=0.02)
        assert layers[f"plain.s{length}_t1"] == pytest.approx(weighted, rel=0.1)
        # Weights neglect connections between vertices that are close to each other
        assert layers[f"plain.s2_t{length - 1}"] == pytest.approx(weighted, rel=0.3)


WHITE = {
    "homogeneous": lambda: homogeneous(1.0, 1.0),
    "chromatic": lambda: homogeneous([0.5, 1.0, 2.0], 1.0),
}


@pytest.mark.parametrize("name", some("chromatic", of=WHITE))
def test_white_fog_in_a_white_box_is_invisible(name: str) -> None:
    """What scatters without loss, between walls of radiance 1, has the radiance 1."""
    walls = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(8), "flip_normals": True,
             "bsdf": diffuse(0.0), "emitter": area(1.0)}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "sensor": camera(), "fog": cube(WHITE[name]()),
                          "light": walls})  # fmt: skip
    images = batches(scene, make(max_depth=-1), 32, range(1, 9))
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0, allowance=5e-4)
    assert abs(z) < 4 and error < 0.01


# ---- The image of volpath ----


def compare(scene: dict, name: str, precision: float, spp: int = 256, **parameters: Any) -> None:
    loaded = mi.load_dict(scene, optimize=False)
    found = batches(loaded, make(name, **parameters), spp, range(1, 5))
    assert_images_are_sound(found)
    expected = batches(loaded, make("volpath"), 2 * spp, range(101, 105))
    assert_same_quarters(found, expected, precision)


@pytest.mark.parametrize("name", some("glass_in_fog", of=[
    "glass_in_fog", "mixed", "sun", "forward", "grid", "around_the_camera", "leaves", "white",
    "black",
]))  # fmt: skip
def test_bdpt_has_the_image_of_volpath_in_fog(name: str) -> None:
    compare({**SCENES, **HARD_SCENES}[name](), "bdpt", 0.04, 128)


@pytest.mark.parametrize("name", some(of=["chromatic", "empty_cloud", "nested"]))
def test_light_tracer_has_the_image_of_volpath_in_fog(name: str) -> None:
    compare({**SCENES, **HARD_SCENES}[name](), "light_tracer", 0.05)


@pytest.mark.parametrize(("make_fog", "far", "name"), [
    (fog, 6.0, "light_tracer"), (fog_around_the_camera, 3.5, "bdpt")
])  # fmt: skip
def test_the_far_clip_plane_ends_camera_rays_before_the_first_boundary(
    make_fog: Callable[..., dict], far: float, name: str
) -> None:
    """Camera rays that pass an index-matched surface see all that is behind it."""
    scene = make_fog("area")
    scene["sensor"]["far_clip"] = far
    compare(scene, name, 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_bdpt_has_the_image_of_volpath_in_spectral_fog(variant: str) -> None:
    compare(fog("area", homogeneous([0.2, 0.5, 0.9])), "bdpt", 0.04)


@pytest.mark.slow
def test_hidden_lamps_do_not_hide_the_fog_behind_them_from_light_paths() -> None:
    lamp = {"type": "sphere", "radius": 0.4, "center": [0, 0, 2.5], "emitter": area(2.0)}
    scene = mi.load_dict(fog("area", lamp=lamp), optimize=False)
    found, expected = (
        batches(scene, make(name, hide_emitters=True), 256, range(seed, seed + 6))
        for name, seed in (("bdpt", 1), ("composed_path", 101))
    )
    assert_same_quarters(found, expected, 0.05)


@pytest.mark.slow
def test_expressions_divide_the_light_of_light_paths_in_fog() -> None:
    """Volume events at the vertices of camera paths and of light paths."""
    aovs = "first:CV.*L, last:C.*VL, both:CV.*VL"
    scene = mi.load_dict(fog("area"), optimize=False)
    parts = []
    for name, seed in (("bdpt", 1), ("composed_path", 2)):
        image = np.array(make(name, aovs=aovs).render(scene, spp=512, seed=seed))
        parts.append(image[..., 3:].reshape(16, 16, 3, 3).mean(axis=(0, 1, 3)))
    np.testing.assert_allclose(*parts, rtol=0.05)


# ---- Merging ----


def merge(radius: float, spp: int, **parameters: Any) -> mi.Integrator:
    """``vcm`` with the same radius on surfaces and in media, in passes of ``spp`` samples."""
    radii = {"radius": radius * spp**0.5, "radius_in_media": radius * spp ** (1 / 3)}
    return make("vcm", 6, radius_decay=1.0, **radii, **parameters)


@pytest.mark.parametrize("merging", some("caustics", of=["caustics", "all"]))
def test_merging_in_media_has_the_image_of_volpath(merging: str) -> None:
    """Without connections of light paths, merging has large weights."""
    scene = mi.load_dict(caustic_in_fog(), optimize=False)
    alone = {"connections": 0, "light_image": False}
    found = batches(scene, merge(0.04, 256, merging=merging, **alone), 256, range(1, 7))
    assert_images_are_sound(found)
    expected = batches(scene, make("volpath", 6), 512, range(101, 107))
    assert_same_quarters(found, expected, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_merging_in_spectral_media_has_the_image_of_volpath(variant: str) -> None:
    scene = mi.load_dict(caustic_in_fog(), optimize=False)
    alone = {"connections": 0, "light_image": False}
    # Photons of a pass have wavelengths of their own
    found = batches(scene, merge(0.06, 1, merging="all", **alone), 256, range(1, 7))
    expected = batches(scene, make("volpath", 6), 1024, range(101, 107))
    assert_same_quarters(found, expected, 0.02)


def test_balls_are_small_in_dense_media() -> None:
    """All light is near the surface, where wide balls are mostly empty."""
    milk = {"type": "sphere", "radius": 0.8, "bsdf": {"type": "dielectric"},
            "interior": homogeneous(100.0, 0.95, 0.0)}  # fmt: skip
    sky = {"type": "constant"}
    scene = mi.load_dict(fog("area", fog=milk, floor=sky))
    bdpt, vcm, sppm = (
        np.array(make(name, 16, hide_emitters=True).render(scene, spp=64)).mean()
        for name in ("bdpt", "vcm", "sppm")
    )
    assert vcm == pytest.approx(bdpt, rel=0.1)
    assert sppm == pytest.approx(bdpt, rel=0.1)


def test_light_does_not_leak_through_the_surface_of_glass() -> None:
    """Two fogs, of which only the outer one is lit; a black film lies between them."""
    black = {"type": "mask", "opacity": 1.0, "bsdf": diffuse(0.0)}
    inner = {"type": "sphere", "radius": 0.7, "bsdf": black, "interior": homogeneous(5.0),
             "exterior": homogeneous(0.5)}  # fmt: skip
    eye = camera()
    eye["medium"] = homogeneous(5.0)
    eye["to_world"] = lookat([0, 0, 0.1], [0, 0, -1], [0, 1, 0])
    scene = mi.load_dict(fog("area", homogeneous(0.5), inner=inner, sensor=eye))
    image = np.array(merge(0.3, 16, merging="all").render(scene, spp=16))
    assert not image.any()


# ---- Limits ----


@pytest.mark.parametrize("name", ["bdpt", "light_tracer", "sppm"])
def test_sky_over_fog_without_end_is_refused(name: str) -> None:
    scene = {k: v for k, v in fog("environment").items() if k != "fog"}
    scene["sensor"] = {**scene["sensor"], "medium": homogeneous(0.1)}
    with pytest.raises(NotImplementedError, match="shines from infinity.*nothing bounds"):
        make(name).render(mi.load_dict(scene), spp=1)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_t", [0.0, 1e4])
def test_any_extinction_gives_a_sound_image(sigma_t: float) -> None:
    scene = mi.load_dict(fog("area", homogeneous(sigma_t, 0.9)), optimize=False)
    images = np.array([np.array(make(name).render(scene, spp=64)) for name in ("bdpt", "volpath")])
    assert_images_are_sound(images)
    # With 1e4, rays start as deep in the medium as light gets
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=0.15)


@pytest.mark.slow
def test_light_paths_find_fog_behind_glass_that_volpath_does_not() -> None:
    """A point light, which connections cannot reach through the glass."""
    ball = {"type": "sphere", "center": [0.5, 2.5, 2.0], "radius": 0.35,
            "bsdf": {"type": "dielectric"}}  # fmt: skip
    scene = mi.load_dict(fog("point", ball=ball), optimize=False)
    found = np.array(make().render(scene, spp=64))
    assert not np.array(make("volpath").render(scene, spp=16)).any()
    assert found[4:12, 4:12].mean() > 0.01


@pytest.mark.parametrize(("name", "parameters"), [
    ("vcm", {"merging": "all"}), ("light_tracer", {})
])  # fmt: skip
def test_media_add_nothing_to_kernels_of_scenes_without_any(name: str, parameters: dict) -> None:
    """Kernels of scenes without media do not call media."""
    scene = mi.load_dict({k: v for k, v in fog("area").items() if k != "fog"})
    integrator = make(name, **parameters)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        integrator.render(scene, spp=4)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert kernels
    text = "".join(kernel["ir"].getvalue() for kernel in kernels if "ir" in kernel)
    assert text and "Medium" not in text and "Phase" not in text
