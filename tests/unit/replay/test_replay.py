"""Replays take the samples of the render, and tell where each part of their light comes from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import replay
from mitsuba_ext.images.reading import read_image
from mitsuba_ext.inputs.scene_changes import SceneChanges
from mitsuba_ext.inputs.scenes import load_scene
from mitsuba_ext.rendering import seed_passes
from mitsuba_ext.rendering.seed_passes import SeedPasses
from mitsuba_ext.replay import render_again
from mitsuba_ext.replay.drawing import Projection
from mitsuba_ext.util.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 16, 9
PIXELS = [(8, 5), (4, 8), (9, 0)]


def load(
    scenes, name="cornell_box", size=(WIDTH, HEIGHT), crop=None
) -> tuple[mi.Scene, mi.Sensor]:
    loaded = load_scene(
        scenes / f"{name}.xml", size, keep_integrator=False,
        changes=SceneChanges(crop=crop, rfilter="box"),
    )  # fmt: skip
    return loaded.scene, loaded.scene.sensors()[0]


def place_of(sensor: mi.Sensor) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(np.array(sensor.world_transform().matrix).reshape(4, 4))


def path(name: str, **parameters) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 4, **parameters})


def pixel_of(image: mi.TensorXf, pixel: tuple[int, int]) -> np.ndarray:
    return np.array(image)[pixel[1], pixel[0], :3]


def assert_accounted(sample: replay.SamplePath) -> None:
    """All light of the sample was found at a vertex, or belongs to none by its nature."""
    lights = [*sample.lights, *(light for vertex in sample.vertices for light in vertex.lights)]
    assert "other" not in {light.technique for light in lights}
    total = np.sum([light.radiance for light in lights], axis=0) if lights else np.zeros(3)
    np.testing.assert_allclose(total, sample.radiance, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "scene", "spp"),
    [
        ("composed_path", "cornell_box", 20),
        ("neepp", "cornell_box", 64),  # with pilots
        ("bdpt", "cornell_box", 20),
        pytest.param("vcm", "caustic", 20, marks=pytest.mark.slow),
        pytest.param("auto", "door_ajar", 256, marks=pytest.mark.slow),
        pytest.param("two_stage", "door_ajar", 64, marks=pytest.mark.slow),
        pytest.param("pss_guided", "fan", 64, marks=pytest.mark.slow),
        pytest.param("light_tracer", "caustic", 16, marks=pytest.mark.slow),
        pytest.param("sppm", "fog", 16, marks=pytest.mark.slow),
        pytest.param("composed_path", "fog", 16, marks=pytest.mark.slow),
    ],
)
def test_the_samples_of_a_pixel_add_up_to_its_value(scenes, name, scene, spp) -> None:
    scene, sensor = load(scenes, scene)
    integrator = path(name)
    image = integrator.render(scene, sensor, seed=7, spp=spp)
    found = replay.paths_of_pixels(scene, PIXELS, integrator, sensor, seed=7, spp=spp, top=spp)
    assert [pixel.pixel for pixel in found] == PIXELS
    for pixel in found:
        np.testing.assert_allclose(pixel.value, pixel_of(image, pixel.pixel), rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(pixel.contributions.sum(axis=0), pixel.value, rtol=1e-9)
        listed = [sample.contribution for sample in pixel.paths]
        np.testing.assert_allclose(listed, pixel.contributions[: len(listed)])
        for sample in pixel.paths:
            assert_accounted(sample)
    assert max(sum(pixel.value) for pixel in found) > 0


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_colours_of_wavelengths_add_up_too(scenes) -> None:
    scene, sensor = load(scenes, "prism")
    image = path("composed_path").render(scene, sensor, seed=7, spp=16)
    for pixel in replay.paths_of_pixels(scene, PIXELS, path("composed_path"), sensor, 7, 16):
        np.testing.assert_allclose(pixel.value, pixel_of(image, pixel.pixel), rtol=1e-4, atol=1e-6)
        assert all(len(sample.wavelengths) == 4 for sample in pixel.paths)
        for sample in pixel.paths:
            assert_accounted(sample)


def test_path_of_mitsuba_is_replayed_in_one_pass_and_in_several(scenes, monkeypatch) -> None:
    monkeypatch.setitem(
        seed_passes._PASS_SAMPLES, dr.backend_v(mi.Float), 16 * WIDTH * HEIGHT
    )
    scene, sensor = load(scenes)
    image = path("path").render(scene, sensor, seed=3, spp=40)
    found = replay.paths_of_pixels(scene, PIXELS, path("path"), sensor, seed=3, spp=40)
    for pixel in found:
        np.testing.assert_allclose(pixel.value, pixel_of(image, pixel.pixel), rtol=1e-5)
    passes = SeedPasses(path("path"), scene, sensor, 3)
    passes.run(40)
    assert passes.passes == 3
    image = sensor.film().develop()
    for pixel in replay.paths_of_pixels(
        scene, PIXELS, path("path"), sensor, seed=3, spp=40, in_passes=True
    ):
        np.testing.assert_allclose(pixel.value, pixel_of(image, pixel.pixel), rtol=1e-5)


def test_structured_samples_are_replayed(scenes) -> None:
    scene, sensor = load(scenes)
    sensor = mi.load_dict({
        "type": "perspective", "film": sensor.film(), "to_world": place_of(sensor),
        "sampler": {"type": "multijitter", "sample_count": 16},
    })  # fmt: skip
    image = path("composed_path").render(scene, sensor, seed=3)
    (pixel,) = replay.paths_of_pixels(scene, PIXELS[:1], path("composed_path"), sensor, seed=3)
    np.testing.assert_allclose(pixel.value, pixel_of(image, PIXELS[0]), rtol=1e-5)


def test_the_brightest_pixels_are_those_that_one_sample_brightens_most(scenes) -> None:
    scene, sensor = load(scenes, size=(8, 6))
    pixels = [(x, y) for y in range(6) for x in range(8)]
    found, image = replay.bright_pixels(scene, 48, path("composed_path"), sensor, seed=5, spp=6)
    weights = np.array([0.212671, 0.715160, 0.072169])
    excess = {}
    for pixel in replay.paths_of_pixels(scene, pixels, path("composed_path"), sensor, 5, 6):
        brightness = 6 * pixel.contributions @ weights
        excess[pixel.pixel] = brightness.mean() - brightness[1:].mean()
        np.testing.assert_allclose(image[pixel.pixel[1], pixel.pixel[0]], pixel.value, rtol=1e-5)
    listed = [excess[pixel] for pixel in found]
    np.testing.assert_allclose(listed, sorted(listed, reverse=True), rtol=1e-4)
    assert {pixel for pixel in pixels if excess[pixel] > 1e-6} <= set(found)


@pytest.mark.parametrize("has_border", [False, True], ids=["crop", "border"])
def test_the_first_vertex_is_seen_in_the_pixel(scenes, has_border) -> None:
    scene, sensor = load(scenes, crop=(7, 5, 6, 2))
    if has_border:
        sensor = mi.load_dict({
            "type": "perspective", "to_world": place_of(sensor), "fov": 15,
            "film": {
                "type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "sample_border": True,
                "rfilter": {"type": "gaussian"},
            },
        })  # fmt: skip
    width, height = sensor.film().crop_size()
    pixels = [(0, 0), (3, 2), (int(width) - 1, int(height) - 1)]
    projection = Projection(sensor)
    for pixel in replay.paths_of_pixels(scene, pixels, path("composed_path"), sensor, 1, 4):
        assert pixel.spp == 4
        for sample in pixel.paths:
            seen = projection.line(*[sample.vertices[0].position] * 2)[0]
            assert np.all(np.abs(seen - np.array(pixel.pixel) - 0.5) <= 0.5 + 1e-3)


def test_a_path_names_what_it_meets() -> None:
    scene = mi.load_dict({
        "type": "scene",
        "sky": {"type": "constant", "radiance": 2.0},
        "mirror": {
            "type": "rectangle", "flip_normals": True,
            "to_world": mi.ScalarTransform4f().translate([0, 0, 4]),
            "silver": {"type": "conductor"},
        },
    })  # fmt: skip
    sensor = mi.load_dict({
        "type": "perspective", "fov": 10, "sampler": {"type": "independent"},
        "film": {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}},
    })  # fmt: skip
    (pixel,) = replay.paths_of_pixels(scene, [(1, 0)], path("composed_path"), sensor, spp=1)
    (sample,) = pixel.paths
    first, last = sample.vertices
    assert (first.kind, first.shape, first.event) == ("surface", "mirror", "delta reflection")
    assert first.bsdf.endswith("silver") and first.position[2] == pytest.approx(4)
    assert first.lights == () and first.pdf == 1
    assert (last.kind, last.event, last.shape) == ("environment", "end", "")
    assert last.position[2] < -0.9
    (light,) = last.lights
    assert (light.technique, light.light, light.mis) == ("emission", "sky", 1)
    assert light.is_infinite and light.radiance == sample.radiance == sample.contribution
    assert sample.share == pytest.approx(1)


def test_the_probability_of_roulette_is_shown(scenes) -> None:
    scene, sensor = load(scenes)
    (pixel,) = replay.paths_of_pixels(
        scene, PIXELS[:1], path("composed_path", rr_depth=1), sensor, 7, 20, top=20
    )
    pairs = [pair for sample in pixel.paths for pair in zip(sample.vertices, sample.vertices[1:])]
    assert len(pairs) > 5 and {vertex.event for vertex, _next in pairs} == {"diffuse reflection"}
    for vertex, after in pairs:
        # Roulette has divided the throughput by the probability, which is the throughput before
        before = max(after.throughput) * vertex.survival
        assert vertex.survival == pytest.approx(min(before, 0.95), rel=1e-5)


def test_what_a_clamp_cuts_off_is_shown(scenes) -> None:
    scene, sensor = load(scenes)
    clamped = path("composed_path", clamp_indirect=0.01)
    image = clamped.render(scene, sensor, seed=7, spp=20)
    (pixel,) = replay.paths_of_pixels(scene, PIXELS[:1], clamped, sensor, 7, 20)
    np.testing.assert_allclose(pixel.value, pixel_of(image, PIXELS[0]), rtol=1e-5)
    (rest,) = pixel.paths[0].lights
    assert rest.technique == "other" and max(rest.radiance) < 0


def test_a_log_that_is_too_short_is_made_longer(scenes, monkeypatch) -> None:
    scene, sensor = load(scenes)
    arguments = scene, PIXELS[:1], path("composed_path"), sensor, 7, 20
    (whole,) = replay.paths_of_pixels(*arguments)
    monkeypatch.setattr(render_again, "_CAPACITY", 8)
    (again,) = replay.paths_of_pixels(*arguments)
    assert again.as_dict() == whole.as_dict()


def test_what_cannot_be_replayed_is_refused(scenes) -> None:
    scene, sensor = load(scenes)
    nested = {"nested": {"type": "path"}}
    for integrator, message in (
        (path("mlt"), "not the mean of camera samples"),
        (mi.load_dict({"type": "ptracer"}), 'only "path"'),
        (mi.load_dict({"type": "variance", **nested}), "must not be nested"),
        (mi.load_dict({"type": "adaptive", **nested}), "distributes its samples itself"),
    ):
        with pytest.raises(NotImplementedError, match=message):
            replay.paths_of_pixels(scene, PIXELS, integrator, sensor, spp=4)
    for parameter in ({"timeout": 3}, {"checkpoint": "kept"}):
        with pytest.raises(ValueError, match=f'a render with "{next(iter(parameter))}"'):
            replay.paths_of_pixels(scene, PIXELS, path("bdpt", **parameter), sensor, spp=4)
    for pixel in ((WIDTH, 0), (0, HEIGHT), (-1, 0)):
        with pytest.raises(ValueError, match="columns 0 to 15, rows 0 to 8"):
            replay.paths_of_pixels(scene, [pixel], path("path"), sensor, spp=4)
    fog, sensor = load(scenes, "fog")
    with pytest.raises(NotImplementedError, match="participating media"):
        replay.paths_of_pixels(fog, PIXELS, mi.load_dict({"type": "volpath"}), sensor, spp=4)


def test_paths_are_drawn_over_the_image(scenes, tmp_path) -> None:
    scene, sensor = load(scenes)
    found = replay.paths_of_pixels(scene, PIXELS[:1], path("composed_path"), sensor, 7, 20, top=1)
    file, image = tmp_path / "paths.png", np.zeros((HEIGHT, WIDTH, 3))
    replay.draw_paths(file, image, scene, sensor, found)
    drawn = read_image(file)[0]
    assert drawn.shape[1] == 1000
    scale = 1000 / WIDTH
    first, second = (vertex.position for vertex in found[0].paths[0].vertices[:2])
    (x0, y0), (x1, y1) = scale * Projection(sensor).line(first, second)
    for share in (0.3, 0.5, 0.7):
        x, y = int(x0 + share * (x1 - x0)), int(y0 + share * (y1 - y0))
        yellow = drawn[y - 1 : y + 2, x - 1 : x + 2].max(axis=(0, 1))
        assert yellow[0] > 0.9 and yellow[2] < 0.2
    with pytest.raises(InputError, match="the image has 4x4 pixels"):
        replay.draw_paths(file, np.zeros((4, 4, 3)), scene, sensor, found)
    with pytest.raises(InputError, match=".png, .jpg"):
        replay.draw_paths(tmp_path / "paths.exr", image, scene, sensor, found)


def test_a_line_ends_where_the_camera_begins(scenes) -> None:
    scene, sensor = load(scenes)
    projection, to_world = Projection(sensor), place_of(sensor)
    ahead, behind, beside = (list(to_world @ mi.ScalarPoint3f(*p)) for p in (
        (0, 0, 5), (0, 0, -5), (1, 0, -5)
    ))  # fmt: skip
    line = projection.line(ahead, behind)
    np.testing.assert_allclose(line, [[WIDTH / 2, HEIGHT / 2]] * 2, atol=1e-3)
    assert projection.line(behind, beside) is None
