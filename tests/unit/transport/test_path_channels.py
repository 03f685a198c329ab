"""Channels of light path expressions: what they hold, and that they leave the image alone."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.device import device_of
from mitsuba_ext.transport.path_channels import PathChannels

pytestmark = pytest.mark.usefixtures("variant")

#: A partition of all paths, and what it adds up to.
PARTITION = "em:emission,di:diffuse,gl:glossy,tr:transmission,vo:volume"

_CREAM = {"type": "rgb", "value": [0.9, 0.5, 0.1]}


def _box(specular: float = 1.0, clear: bool = True, **more) -> mi.Scene:
    """A box with a floor whose BSDF has a diffuse and a glossy lobe."""
    scene = mi.cornell_box()
    film = {"width": 12, "height": 12, "rfilter": {"type": "box"}}
    scene["sensor"]["film"].update(film)
    metal = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": specular}
    diffuse = {"type": "diffuse", "reflectance": _CREAM}
    both = {"type": "blendbsdf", "weight": 0.5, "a": diffuse, "b": metal}
    for name in ("floor", "back", "large-box"):
        scene[name]["bsdf"] = both
    scene["small-box"]["bsdf"] = {"type": "dielectric"} if clear else both
    return mi.load_dict({**scene, **more})


def _render(scene: mi.Scene, aovs: str, name: str = "composed_path", spp: int = 64, **more):
    """The image, and the channels by name."""
    integrator = mi.load_dict(
        {"type": name, "max_depth": 5, **({"aovs": aovs} if aovs else {}), **more}
    )
    image = np.array(integrator.render(scene, spp=spp, seed=5))
    names = integrator.aov_names()
    first = image.shape[2] - len(names)
    channels: dict[str, list[np.ndarray]] = {}
    for index, channel in enumerate(names):
        channels.setdefault(channel.rpartition(".")[0], []).append(image[..., first + index])
    return image[..., :3], {key: np.stack(value, axis=2) for key, value in channels.items()}


def test_a_partition_adds_up_to_the_image_which_is_the_same_as_without_channels() -> None:
    scene = _box()
    plain, _ = _render(scene, "")
    image, channels = _render(scene, PARTITION + ",ts:C<TS>.*L")
    np.testing.assert_allclose(image, plain, atol=2e-5)
    np.testing.assert_array_equal(channels.pop("ts"), channels["tr"])
    np.testing.assert_allclose(sum(channels.values()), image, atol=2e-5)
    assert all(channels[name].mean() > 1e-3 for name in ("em", "di", "gl", "tr"))
    assert not channels["vo"].any()


def test_a_partition_adds_up_where_memory_suffices_for_a_part_of_the_film_only(monkeypatch) -> None:
    half = device_of(mi.Float).pass_bytes // (12 * 12 // 2)
    monkeypatch.setattr(PathChannels, "sample_bytes", half)
    image, channels = _render(_box(), PARTITION, spp=4)
    np.testing.assert_allclose(sum(channels.values()), image, atol=2e-5)
    assert (image.sum(axis=2) > 0).any(axis=1).all()


def test_a_channel_without_a_lobe_is_the_image_of_a_scene_without_it() -> None:
    diffuse = _render(_box(clear=False), "x:C<RD>*L", spp=256)[1]["x"]
    expected = _render(_box(0.0, clear=False), "", spp=256)[0]
    # The noise is mostly common
    np.testing.assert_allclose(diffuse.mean((0, 1)), expected.mean((0, 1)), rtol=0.015)


def test_both_ways_to_find_a_light_agree_on_the_channel() -> None:
    camera = mi.ScalarTransform4f().look_at([0, -3, 3], [0, 0, 0], [0, 0, 1])
    lamp = mi.ScalarTransform4f().look_at([1.5, 0, 2], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {
            "type": "perspective", "to_world": camera,
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "bsdf": {"type": "roughplastic", "alpha": 0.6, "diffuse_reflectance": _CREAM},
        },
        "lamp": {
            "type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 5.0},
        },
        "sky": {"type": "constant", "radiance": 0.5},
    })  # fmt: skip
    channels = {
        mis: _render(scene, "di:C<RD>L,gl:C<RG>L", spp=4096, mis=mis)[1]
        for mis in ("power", "light", "bsdf")
    }
    for name in ("di", "gl"):
        expected = channels["power"][name].mean((0, 1))
        for mis in ("light", "bsdf"):
            found = channels[mis][name].mean((0, 1))
            np.testing.assert_allclose(found, expected, rtol=0.04, err_msg=f"{mis} {name}")


@pytest.mark.parametrize("name", ["vcm", pytest.param("bdpt", marks=pytest.mark.slow)])
def test_light_paths_fill_the_same_channels_as_camera_paths(name: str) -> None:
    scene = _box()
    aovs = f"{PARTITION},ca:C.*D[GS]+L"
    _, expected = _render(scene, aovs, spp=1024)
    image, channels = _render(scene, aovs, name, spp=64 if name == "vcm" else 1024)
    np.testing.assert_allclose(
        sum(channels[key] for key in ("em", "di", "gl", "tr", "vo")), image, atol=2e-5
    )
    for key, least in (("di", 0.03), ("gl", 0.05), ("tr", 0.12), ("ca", 0.1)):
        np.testing.assert_allclose(
            channels[key].mean((0, 1)), expected[key].mean((0, 1)), rtol=least
        )


def test_labels_are_names_of_lights_shapes_and_bsdfs() -> None:
    lamp = {
        "type": "sphere", "center": [0, -0.5, 0.5], "radius": 0.1, "id": "lamp.001",
        "emitter": {"type": "area", "radiance": 3.0},
    }  # fmt: skip
    scene = _box(lamp=lamp)
    image, channels = _render(
        scene,
        "g:light_groups,f:C<R.'green-wall'>.*L,n:C[^'green-wall'].*L,e:CL,lamp:C.*'lamp.001'",
    )
    assert {"g.lamp", "g.light"} < channels.keys()
    np.testing.assert_allclose(channels["g.lamp"] + channels["g.light"], image, atol=2e-5)
    np.testing.assert_array_equal(channels["lamp"], channels["g.lamp"])
    np.testing.assert_allclose(
        channels["f"] + channels["n"] + channels["e"], image, atol=2e-5
    )
    # The wall is on the right
    assert channels["f"][:, -2:].mean() > 0.01 and not channels["f"][:, :4].any()
    with pytest.raises(ValueError, match='did you mean "lamp'):
        _render(scene, "x:C.*<L.'lamq'>", spp=1)


def test_straight_events_are_passed_over_unless_an_expression_names_them() -> None:
    veil = {
        "type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 1.5]),
        "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
    }  # fmt: skip
    _, channels = _render(_box(veil=veil), "em:CL,no:C<Ts>L,all:C(<Ts>)*L,twice:C<Ts>{2}L")
    np.testing.assert_allclose(channels["em"], channels["all"])
    np.testing.assert_allclose(channels["em"], channels["no"])
    assert not channels["twice"].any() and channels["em"].any()


def test_media_scatter_with_v() -> None:
    cube = {
        "type": "cube", "bsdf": {"type": "null"},
        "to_world": mi.ScalarTransform4f().scale(0.5),
        "interior": {"type": "homogeneous", "albedo": 0.8, "sigma_t": 2.0},
    }  # fmt: skip
    scene = _box(cube=cube)
    image, channels = _render(scene, PARTITION + ",one:CVL")
    np.testing.assert_allclose(
        sum(channels[key] for key in ("em", "di", "gl", "tr", "vo")), image, atol=2e-5
    )
    assert channels["vo"].mean() > channels["one"].mean() > 1e-3


@pytest.mark.parametrize(
    ("variant", "name"),
    [("llvm_ad_spectral", "bdpt"), ("llvm_ad_mono", "composed_path")],
    indirect=["variant"],
)
def test_other_variants(name: str) -> None:
    image, channels = _render(_box(), PARTITION, name, spp=4)
    image = image[..., : len(mi.Color3f() if mi.is_spectral else mi.Spectrum())]
    np.testing.assert_allclose(sum(channels.values()), image, atol=1e-4)
    assert channels["gl"].any() and channels["di"].any()


@pytest.mark.parametrize("name", ["mlt", "pssmlt", "photon_map", "irradiance_cache"])
def test_integrators_that_do_not_know_the_events_refuse_expressions(name: str) -> None:
    with pytest.raises(RuntimeError, match=f'"{name}": the parameter "aovs".*because'):
        mi.load_dict({"type": name, "aovs": "c:caustics"})


def test_light_that_would_not_be_in_the_channels_is_refused() -> None:
    with pytest.raises(RuntimeError, match="leave one of them out"):
        mi.load_dict({"type": "composed_path", "aovs": "c:caustics", "clamp_indirect": 1.0})


def test_light_groups_need_to_be_named_where_the_scene_is_not_known() -> None:
    with pytest.raises(ValueError, match="write a channel for each group"):
        mi.load_dict({"type": "composed_path", "aovs": "g:light_groups"}).aov_names()


def test_wrappers_pass_the_channels_on() -> None:
    scene = _box()
    aovs = {"type": "composed_path", "max_depth": 3, "aovs": "di:diffuse,em:emission"}
    for wrapper in ("adaptive", "moment"):
        integrator = mi.load_dict({"type": wrapper, "nested": aovs})
        image = np.array(integrator.render(scene, spp=16))
        names = list(integrator.aov_names())
        found = next(index for index, name in enumerate(names) if name.endswith("di.R"))
        first = image.shape[2] - len(names)
        assert image[..., first + found].mean() > 0.01


def test_without_expressions_kernels_know_nothing_of_them() -> None:
    scene = _box()
    sizes = []
    for aovs in ("", "", "x:C.*L"):
        integrator = mi.load_dict(
            {"type": "composed_path", **({"aovs": aovs} if aovs else {})}
        )
        integrator.render(scene, spp=1)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            integrator.render(scene, spp=1)
            history = dr.kernel_history([dr.KernelType.JIT])
        sizes.append([kernel["hash"] for kernel in history])
    assert sizes[0] == sizes[1] and not set(sizes[0]) >= set(sizes[2])
