"""Masks: numbers and Cryptomatte of objects and materials."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.images import cryptomatte, image_files
from mitsuba_ext.images.coverage import Coverage
from mitsuba_ext.inputs.scenes import load_scene
from mitsuba_ext.long_renders.integrator_batches import IntegratorBatches
from mitsuba_ext.rendering import mask_samples
from mitsuba_ext.rendering.pixel_weights import ONE, PixelWeights
from mitsuba_ext.scene.surface_names import SurfaceNames, surface_names
from mitsuba_ext.util.stored_arrays import DamagedError, StoredArrays

Scene = dict[str, Any]

#: Both levels, and numbers between variables of Mitsuba.
AOVS = "s:shape_index,o:cryptomatte_object,m:cryptomatte_material,i:object_id,d:depth"


@pytest.fixture(autouse=True)
def quiet(variant: str) -> None:
    mi.set_log_level(mi.LogLevel.Error)


def _ball(x: float, **others: Any) -> Scene:
    return {"type": "sphere", "center": [x, 0, 0], "radius": 0.5, **others}


def _scene(rfilter: str = "gaussian", **objects: Scene) -> Scene:
    """A moving ball between objects, seen out of focus in a crop window."""
    film = {
        "type": "hdrfilm", "width": 24, "height": 16, "crop_offset_x": 3, "crop_offset_y": 2,
        "crop_width": 17, "crop_height": 11, "rfilter": {"type": rfilter},
    }  # fmt: skip
    sensor = {
        "type": "thinlens", "aperture_radius": 0.2, "focus_distance": 3.0, "fov": 50,
        "shutter_close": 1.0, "film": film,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    }  # fmt: skip
    turn = mi.ScalarTransform4f().translate([0, -0.5, -1]).rotate([1, 0, 0], -70).scale(2)
    things = objects or {
        "mover": {"type": "moving", "translate": [0, 0.6, 0], "flying": _ball(0)},
        "left": _ball(-1, bsdf={"type": "diffuse", "id": "red"}),
        "floor": {"type": "rectangle", "to_world": turn},
        "group": {"type": "shapegroup", "part": _ball(0, mat={"type": "plastic", "id": "shiny"})},
        "copy": {
            "type": "instance", "shapes": {"type": "ref", "id": "group"},
            "to_world": mi.ScalarTransform4f().translate([1, 0, 0.3]),
        },
    }  # fmt: skip
    return {"type": "scene", "sensor": sensor, **things}


def _load(scene: Scene) -> mi.Scene:
    return mi.load_dict(scene, optimize=False)


def _integrator(aovs: str = AOVS, **others: Any) -> mi.Integrator:
    return mi.load_dict({"type": "composed_path", "max_depth": 1, "aovs": aovs, **others})


def _matte(channels: dict[str, np.ndarray], layer: str, name: str) -> np.ndarray:
    """The coverage of a name, as a compositing program finds it."""
    number, found = cryptomatte.name_as_float(name), 0.0
    names = cryptomatte.channel_names(layer)
    for key, value in zip(names[::2], names[1::2]):
        found = found + np.where(channels[key] == number, channels[value], 0)
    return found


def _mattes(scene: mi.Scene, spp: int = 16, seed: int = 5, **others: Any) -> dict[str, np.ndarray]:
    integrator = _integrator(**others)
    mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    return integrator.coverage.channels(integrator.masks)


# ---- Sums by pixel and label ----


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "lanczos"])
def test_weights_are_those_of_the_film(rfilter: str) -> None:
    film = mi.load_dict(_scene(rfilter)["sensor"]["film"])
    rng, count, labels = np.random.default_rng(1), 3000, 19
    position = mi.Point2f(mi.Float(rng.uniform(0, 24, count)), mi.Float(rng.uniform(0, 16, count)))
    label = mi.UInt32(rng.integers(0, labels, count).astype(np.uint32))
    weight = mi.Float(rng.uniform(0.5, 2, count))
    weights = PixelWeights(film, labels)
    weights.put(position, weight, label)
    weights.put(position, weight, label)
    pixel, found, total = weights.arrays()
    table = np.zeros((17 * 11, labels))
    table[pixel, found] = total / ONE
    block = mi.ImageBlock(
        film.crop_size(), film.crop_offset(), labels, film.rfilter(), border=False
    )
    block.put(position, [dr.select(label == n, weight, 0) for n in range(labels)])
    expected = 2 * np.array(block.tensor()).reshape(-1, labels)
    np.testing.assert_allclose(table, expected, atol=1e-4)
    # Far more labels in a pixel than there are slots for it at the start: the table has grown
    assert (table != 0).sum(axis=1).max() > labels / 2


def test_many_labels_need_long_keys() -> None:
    film = mi.load_dict({"type": "hdrfilm", "width": 3, "height": 2, "rfilter": {"type": "box"}})
    weights = PixelWeights(film, 2**31)
    label = mi.UInt32([5, 2**31 - 1, 5])
    weights.put(mi.Point2f([2.5, 2.5, 2.5], [1.5, 1.5, 1.5]), mi.Float([1, 2, 4]), label)
    pixel, found, total = weights.arrays()
    assert (pixel.tolist(), found.tolist()) == ([5, 5], [5, 2**31 - 1])
    np.testing.assert_allclose(total / ONE, [5, 2])


# ---- Mattes ----


@pytest.mark.parametrize("name", ["flying", "left", "copy"])
def test_a_matte_is_the_image_of_the_object_alone_in_white(name: str) -> None:
    """With filter, motion, depth of field and a crop window: the same seed takes the same rays."""
    scene = _scene()
    found = _matte(_mattes(_load(scene)), "o", name)
    floor = scene["floor"]
    floor["black"] = {"type": "diffuse", "reflectance": 0.0}
    white = {"type": "area", "radiance": 1.0}
    if name == "copy":  # an instance cannot shine: all else does
        for each in (floor, scene["left"], scene["mover"]["flying"]):
            each["light"] = white
        scene["mover"]["flying"].pop("id", None)
        scene["sky"] = {"type": "constant", "radiance": 1.0}
    else:
        (scene["mover"]["flying"] if name == "flying" else scene["left"])["light"] = white
    image = np.array(mi.render(_load(scene), integrator=_integrator(""), spp=16, seed=5))[..., 0]
    expected = 1 - image if name == "copy" else image
    assert expected.max() > 0.5
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_the_same_seed_gives_the_same_masks_exactly() -> None:
    scene = _load(_scene())
    first, again, other = (_mattes(scene, seed=seed, samples_per_pass=4) for seed in (5, 5, 6))
    assert all(np.array_equal(first[key], again[key]) for key in first)
    assert not np.array_equal(first["o00.g"], other["o00.g"])


def test_ranks_are_sorted_and_whole_pixels_are_covered() -> None:
    channels = _mattes(_load(_scene(fill=_ball(0, radius=9), ball=_ball(0.3, center=[0, 0, 9.3]))))
    coverage = np.stack([channels[key] for key in cryptomatte.channel_names("o")[1::2]])
    assert (np.diff(coverage, axis=0) <= 0).all()
    np.testing.assert_allclose(coverage.sum(axis=0), 1, atol=1e-6)


def test_the_image_ends_with_the_masks() -> None:
    scene = _load(_scene())
    integrator, plain = _integrator(), _integrator("")
    image = np.array(mi.render(scene, integrator=integrator, spp=4, seed=5))
    names = [*integrator.aov_names(), *integrator.mask_names()]
    assert names[:3] == ["s.I", "d.T", "o00.r"] and names[-1] == "i.I"
    found = dict(zip(names[::-1], np.moveaxis(image, 2, 0)[::-1]))
    for key, plane in integrator.coverage.channels(integrator.masks).items():
        assert np.array_equal(found[key], plane), key
    # The image is the same as without masks
    expected = np.array(mi.render(scene, integrator=plain, spp=4, seed=5))
    np.testing.assert_allclose(image[..., : expected.shape[2]], expected, atol=1e-5)


def test_numbers_are_of_the_object_that_covers_most() -> None:
    scene = _load(_scene("box"))
    integrator = _integrator()
    image = np.array(mi.render(scene, integrator=integrator, spp=16, seed=5))
    names = surface_names(scene).objects
    assert names == ("copy", "floor", "flying", "left")
    number = image[..., -1]
    assert set(np.unique(number)) == {0, 1, 2, 3, 4}
    channels = integrator.coverage.channels(integrator.masks)
    for index, name in enumerate(names):
        matte = _matte(channels, "o", name)
        assert (number[matte > 0.5] == index + 1).all()
        # Mitsuba's index is the mean over the samples of a pixel
        np.testing.assert_allclose(image[..., 3][matte == 1], index + 1, atol=1e-4)


def test_masks_see_through_opacity_masks_but_not_through_panes() -> None:
    half = {"type": "mask", "opacity": 0.25, "nested": {"type": "diffuse"}}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale(9)}
    behind = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(9)}
    for bsdf, expected in ((half, 0.25), ({"type": "thindielectric"}, 1), ({"type": "null"}, 0)):
        channels = _mattes(_load(_scene("box", wall={**wall, "b": bsdf}, back=behind)), spp=64)
        wall_matte, back_matte = (_matte(channels, "o", name) for name in ("wall", "back"))
        assert abs(wall_matte.mean() - expected) < 0.02  # 6 standard errors
        np.testing.assert_allclose(wall_matte + back_matte, 1, atol=1e-6)


def test_hidden_lights_are_not_in_masks() -> None:
    lamp = _ball(0, light={"type": "area"})
    scene = _load(_scene(lamp=lamp, back=_ball(0, center=[0, 0, -6], radius=3)))
    shown = _matte(_mattes(scene), "o", "lamp")
    hidden = _mattes(scene, hide_emitters=True)
    assert shown.max() == 1 and _matte(hidden, "o", "lamp").max() == 0
    assert _matte(hidden, "o", "back")[shown == 1].min() == 1
    with_masks, without = (
        np.array(_integrator(aovs, hide_emitters=True).render(scene, spp=4, seed=5))[..., :3]
        for aovs in ("o:object_id", "")
    )
    np.testing.assert_allclose(with_masks, without, atol=1e-5)


def test_an_empty_scene_has_empty_masks() -> None:
    scene = _load(_scene(sky={"type": "constant"}))
    channels = _mattes(scene)
    assert not any(plane.any() for plane in channels.values())


@pytest.mark.parametrize("name", ["bdpt", "adaptive"])
def test_integrators_have_masks(name: str) -> None:
    scene = _load(_scene(left=_ball(-1), lamp=_ball(1, light={"type": "area"})))
    parameters = {"max_depth": 3, "aovs": "o:cryptomatte_object"}
    description = {"type": name, **parameters}
    if name == "adaptive":
        description = {"type": name, "nested": {"type": "composed_path", **parameters}}
    integrator = mi.load_dict(description)
    image = np.array(mi.render(scene, integrator=integrator, spp=32, seed=1))
    expected = _matte(_mattes(scene, spp=128), "o", "left")
    planes = dict(zip(integrator.mask_names(), np.moveaxis(image[..., -12:], 2, 0)))
    assert np.abs(_matte(planes, "o", "left") - expected).mean() < 0.03


# ---- Names ----


def test_names_do_not_depend_on_the_order_of_shapes() -> None:
    balls = [mi.load_dict(_ball(x)) for x in (3.0, 1.0, 2.0)]
    boxes = [mi.load_dict({"type": "cube"}), mi.load_dict(_ball(7, id="sphere_1"))]
    for each in (*balls, boxes[0]):
        each.set_id("")

    def scene(shapes: list[mi.Shape]) -> Scene:
        made = {"type": "scene"}
        for index, shape in enumerate(shapes):
            made[f"_arg_{index}"] = shape
        return made

    names = []
    for shapes in ([*balls, *boxes], [*boxes[::-1], *balls[::-1]]):
        loaded = mi.load_dict(scene(shapes), optimize=False)
        for shape in loaded.shapes():
            shape.set_id("sphere_1" if shape is boxes[1] else "")
        names.append(_by_center(loaded))
    assert names[0] == names[1]
    assert names[0] == {1: "sphere_2", 2: "sphere_3", 3: "sphere_4", 0: "cube", 7: "sphere_1"}


def _by_center(scene: mi.Scene) -> dict[int, str]:
    names = surface_names(scene)
    numbers, pointers = names.object_numbers.numpy(), scene.shapes_dr()
    pointers = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    centers = [round(float(shape.bbox().center().x)) for shape in scene.shapes()]
    return dict(zip(centers, (names.objects[numbers[each] - 1] for each in pointers)))


def _names(**objects: Scene) -> SurfaceNames:
    return surface_names(_load(_scene(**objects)))


def test_materials_have_the_names_of_the_file() -> None:
    nested = {"type": "twosided", "id": "", "inside": {"type": "diffuse", "id": "paint"}}
    names = _names(
        a=_ball(0, bsdf={"type": "diffuse"}), b=_ball(1, bsdf={"type": "plastic"}),
        c=_ball(2, any={**nested}), d=_ball(3, any={"type": "diffuse", "id": "own"}),
    )  # fmt: skip
    assert names.objects == ("a", "b", "c", "d")
    # The key "bsdf" does not tell the first two apart
    assert names.materials[:2] == ("a.bsdf", "b.bsdf") and "own" in names.materials


def test_merged_meshes_are_refused() -> None:
    turn = mi.ScalarTransform4f().translate
    cubes = {
        name: {"type": "cube", "to_world": turn([x, 0, 0]), "grey": {"type": "diffuse"}}
        for name, x in (("one", 0), ("two", 3))
    }
    scene = mi.load_dict(_scene(**cubes))
    with pytest.raises(ValueError, match=r'"composed_path": Mitsuba has merged .* optimize=False'):
        _integrator().render(scene, spp=1)
    # Materials, and an index of the merged mesh, are known
    image = _integrator("m:material_id,s:shape_index").render(scene, spp=1)
    assert np.array(image)[..., -1].max() == 1
    assert load_scene(_scene(**cubes), keep_names=True).scene.shapes()[0].id() == "one"


# ---- Refusals ----


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mi.load_dict({"type": "neepp", "aovs": "a:object"}), 'not "a:object"'),
        (lambda: _integrator("a:object_id,a:depth"), 'two items of "aovs" have the name "a"'),
        (
            lambda: mi.load_dict({"type": "variance", "nested": _integrator("a:object_id")}),
            "have no variance",
        ),
        (
            lambda: mi.load_dict({"type": "composed_prb", "aovs": "a:object_id"}),
            'no parameter "aovs"',
        ),
    ],
)
def test_wrong_lists_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(RuntimeError, match=message):  # by which Mitsuba replaces other errors
        make()


def test_single_samples_have_no_masks() -> None:
    nested = mi.load_dict({"type": "moment", "nested": _integrator("a:object_id")})
    with pytest.raises((NotImplementedError, RuntimeError), match="all samples of a pixel"):
        nested.render(_load(_scene()), spp=1)


def test_without_masks_nothing_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mask_samples.Labels, "of", None)
    monkeypatch.setattr(mask_samples, "surface_names", None)
    integrator = _integrator("d:depth")
    integrator.render(_load(_scene()), spp=1)
    assert integrator.coverage is None and integrator.mask_names() == []


# ---- Sums over renders, and files ----


def test_coverage_adds_up_and_is_stored() -> None:
    scene = _load(_scene())
    integrator, parts = _integrator(), []
    for seed in (1, 2, 3):
        integrator.render(scene, spp=2, seed=seed)
        parts.append(integrator.coverage)
    first, second = parts[0].plus(parts[1]).plus(parts[2]), parts[2].plus(parts[0].plus(parts[1]))
    arrays = first.arrays()
    stored = Coverage.from_arrays(StoredArrays.of(arrays), 1 << 20)
    for key in ("pixel", "label", "weight"):
        assert np.array_equal(getattr(first, key), getattr(second, key))
        assert np.array_equal(getattr(first, key), getattr(stored, key))
    assert first.weight.sum() == sum(part.weight.sum() for part in parts)
    assert (stored.objects, stored.size) == (first.objects, (17, 11))
    for key, value in (("objects", np.array("[1]")), ("label", arrays["label"] + 999)):
        with pytest.raises(DamagedError):
            Coverage.from_arrays(StoredArrays.of({**arrays, key: value}), 1 << 20)


def test_a_checkpoint_keeps_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IntegratorBatches, "length", lambda _self, spp, teaches: min(8, spp))
    scene = _load(_scene())
    shared = {"checkpoint": str(tmp_path / "kept")}
    _integrator(**shared).render(scene, spp=8, seed=1)
    continued, once = _integrator(**shared), _integrator(checkpoint=str(tmp_path / "once"))
    image = np.array(continued.render(scene, spp=24, seed=1))
    once.render(scene, spp=24, seed=1)
    assert np.array_equal(continued.coverage.weight, once.coverage.weight)
    expected = once.coverage.channels(once.masks)
    assert np.array_equal(image[..., -1], expected["i.I"])


def test_names_are_hashed_as_specified() -> None:
    known = {b"": 0, b"hello": 0x248BFA47, b"hello, world": 0x149BBB7F}
    assert {text: cryptomatte.murmur3(text) for text in known} == known
    assert cryptomatte.murmur3(b"The quick brown fox jumps over the lazy dog") == 0x2E4FF723
    numbers = np.array([cryptomatte.name_as_float(f"name {n}") for n in range(2000)])
    assert np.isfinite(numbers).all() and (np.abs(numbers) >= np.finfo(np.float32).tiny).all()


def test_a_reader_of_cryptomatte_finds_the_mattes(tmp_path: Path) -> None:
    reader = pytest.importorskip("cryptomatte_api")
    scene = _load(_scene())
    integrator = _integrator()
    mi.render(scene, integrator=integrator, spp=16, seed=5)
    coverage, masks = integrator.coverage, integrator.masks
    channels, about = coverage.channels(masks), coverage.metadata(masks)
    for number, is_compressed in enumerate((True, False)):
        file = tmp_path / f"{number}.exr"
        film = scene.sensors()[0].film()
        image_files.write_film(file, film, about, channels, is_compressed)
        found = reader.Cryptomatte.load(str(file))
        mattes = {name: matte for each in found for name, matte in each.masks().items()}
        expected = {
            name: _matte(channels, layer, name)
            for layer, names in (("o", coverage.objects), ("m", coverage.materials))
            for name in names
        }
        assert set(mattes) == set(expected) >= {"flying", "copy", "red", "shiny"}
        for name, matte in mattes.items():
            np.testing.assert_allclose(matte, expected[name], atol=1e-6)
