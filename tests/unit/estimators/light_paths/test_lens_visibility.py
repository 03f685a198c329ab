"""Light paths choose points of the aperture by visibility, and the image agrees with ``path``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.estimators.light_paths.lens_visibility import VisibilityLens, visibility_lens
from mitsuba_ext.estimators.light_paths.sensor import ConnectableSensor, UniformLens, is_occluded
from mitsuba_ext.transport.numbers import hashed_2d
from mitsuba_ext.transport.path_decisions import SceneQuery
from tests.support.emitters_and_materials import T
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_quarters,
    batches,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")

LENSES = ("uniform", "visibility")


def behind_bars(
    world: mi.ScalarTransform4f | None = None, camera: dict[str, Any] | None = None,
    bars: bool = True, **changes: Any,
) -> dict[str, Any]:
    """A stage, seen past bars that are near the lens and out of focus."""
    world = world or T()
    near = {}
    if bars:
        for i in range(4):
            place = T().translate([-0.24 + 0.16 * i, -3, 1]).rotate([1, 0, 0], 90)
            bar = rectangle(world, place, T().scale([0.045, 1, 1]),
                            bsdf={"type": "twosided", "bsdf": diffuse(0.3)})  # fmt: skip
            near[f"bar_{i}"] = bar
    origin, target = (list(world @ mi.ScalarPoint3f(p)) for p in ([0, -4, 1.2], [0, 0, 0.3]))
    scale = np.linalg.norm(np.array(world @ mi.ScalarVector3f(1, 0, 0)))
    lens = {"aperture_radius": 0.15 * scale, "focus_distance": 4.0 * scale,
            "near_clip": 1e-2 * scale, "far_clip": 1e4 * scale}  # fmt: skip
    camera = {"film": film(24, 16), "fov": 35.0, **lens, **(camera or {})}
    camera["to_world"] = lookat(origin, target, [0, 0, 1])
    return stage(world, camera=sensor("thinlens", **camera), **near, **changes)


def lens_of(scene: mi.Scene) -> VisibilityLens:
    lens = visibility_lens(scene, scene.sensors()[0], SceneQuery())
    assert isinstance(lens, VisibilityLens)
    return lens


def with_any_table(lens: VisibilityLens) -> VisibilityLens:
    """A lens whose table has nothing to do with the scene."""
    words = np.random.default_rng(4).integers(1, 256, 4 * len(lens._words), dtype=np.uint8)
    lens._words = mi.UInt32(words.view(np.uint32))
    return lens


def points(scene: mi.Scene, count: int) -> mi.SurfaceInteraction3f:
    """What the sensor sees, and some of what it does not see."""
    numbers = mi.PCG32(size=count)
    u = [mi.Point2f(numbers.next_float32(), numbers.next_float32()) for _ in range(2)]
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, 1.5 * u[0] - 0.25, u[1])
    si = scene.ray_intersect(ray)
    dr.eval(si)
    return si


# ---- The choice of a piece ----


@pytest.mark.parametrize("table", ["learned", "any"])
def test_pieces_are_chosen_with_the_densities_that_weights_say(table: str) -> None:
    scene = mi.load_dict(behind_bars())
    lens = lens_of(scene)
    if table == "any":
        lens = with_any_table(lens)
    p, count = points(scene, 64), 1 << 14
    lane = dr.arange(mi.UInt32, 64 * count)
    si = dr.gather(mi.SurfaceInteraction3f, p, lane // count)
    u = mi.Point2f(np.random.default_rng(1).random((2, 64 * count), dtype=np.float32))
    numbers, weight = lens.sample(u, si, mi.Bool(True))
    numbers, density = np.array(numbers), 1 / np.array(weight)
    assert numbers.min() >= 0 and numbers.max() <= 1
    # By the table: [point, row of pieces, column of pieces]
    likes = np.array(lens._weights(p.p, mi.Bool(True))[0], dtype=np.float64).T
    likes /= likes.sum(axis=1, keepdims=True)
    likes = likes.reshape(64, lens._pieces, lens._pieces)
    column, row = np.minimum((numbers * lens._pieces).astype(int), lens._pieces - 1)
    expected = likes[np.arange(64 * count) // count, row, column] * lens._count
    is_same = np.abs(density / expected - 1) < 1e-4
    # Except for numbers that were rounded to the next piece
    assert is_same.mean() > 0.9999
    # Four bins of each piece, also within it
    bins = 2 * lens._pieces
    x, y = np.minimum((numbers * bins).astype(int), bins - 1)
    found = np.zeros((64, bins * bins))
    np.add.at(found, (np.arange(64 * count) // count, y * bins + x), 1)
    expected = np.repeat(np.repeat(likes, 2, axis=1), 2, axis=2).reshape(64, -1) / 4
    assert expected.max() > 1.5 / bins**2, "uniform"
    chi2 = ((found - count * expected) ** 2 / (count * expected)).sum()
    assert stats.chi2.sf(chi2, 64 * (bins * bins - 1)) > 1e-4


@pytest.mark.parametrize("crop", some(True, of=[False, True]))
def test_more_connections_reach_the_lens(crop: bool) -> None:
    window = {"crop_offset_x": 60, "crop_offset_y": 20, "crop_width": 40, "crop_height": 50}
    size = film(128, 96, **(window if crop else {}))
    scene = mi.load_dict(behind_bars(camera={"film": size}))
    eye, si, lane = scene.sensors()[0], points(scene, 1 << 20), dr.arange(mi.UInt32, 1 << 20)
    u = hashed_2d(lane, mi.UInt32(0))
    reached, light = [], []
    for lens in (UniformLens(), lens_of(scene)):
        target = ConnectableSensor(eye, lens)
        connection, weight = target.connect(si, u, mi.Bool(True))
        free = connection.active & si.is_valid() & (si.t > 2)
        free &= ~is_occluded(SceneQuery(), scene, si, connection, free)
        reached.append(np.array(free).sum())
        light.append(np.array(dr.select(free, weight, 0)).sum())
    assert reached[1] > 1.4 * reached[0]
    np.testing.assert_allclose(*light, rtol=0.02)


def test_a_lens_that_sees_everything_alike_needs_no_table() -> None:
    tiny = mi.load_dict(behind_bars(camera={"aperture_radius": 1e-4}))
    empty = mi.load_dict({"type": "scene", "sensor": sensor("thinlens", aperture_radius=0.1,
                                                            focus_distance=4.0)})  # fmt: skip
    for scene in (tiny, empty):
        lens = visibility_lens(scene, scene.sensors()[0], SceneQuery())
        assert not isinstance(lens, VisibilityLens)


def test_memory_is_bounded() -> None:
    scene = mi.load_dict(behind_bars(camera={"film": film(1920, 1080), "aperture_radius": 1.0}))
    assert lens_of(scene).bytes <= 20 << 20


# ---- Images ----


def light_tracer(**parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "light_tracer", "lens_sampling": "visibility", **parameters})


def assert_image_of_path(
    scene: dict[str, Any], spp: int = 512, precision: float = 0.01, reference: str = "path",
    **parameters: Any,
) -> None:  # fmt: skip
    scene = mi.load_dict(scene, optimize=False)
    common = {"max_depth": 3, **parameters}
    integrator = light_tracer(**common)
    images = batches(scene, integrator, spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, mi.load_dict({"type": reference, **common}), spp,
                       REFERENCE_SEEDS[:MANY_SEEDS])  # fmt: skip
    assert_same_quarters(images, expected, precision)


CROP = {"film": film(40, 30, crop_offset_x=9, crop_offset_y=5, crop_width=20, crop_height=15)}

VIEWS = {
    "plain": lambda: {},
    "cropped": lambda: {"camera": CROP},
    "small": lambda: {"world": T().scale(0.02)},
    "large": lambda: {"world": T().translate([3e3, -2e3, 1e3]).scale(300)},
    "wide": lambda: {"camera": {"aperture_radius": 0.6}},
    "clipped": lambda: {"camera": {"near_clip": 1.2}},
    "shutter": lambda: {"camera": {"shutter_open": 0.0, "shutter_close": 1.0}},
}


@pytest.mark.parametrize("view", some("plain", of=VIEWS))
def test_a_lens_behind_bars_sees_what_it_sees_with_path(view: str) -> None:
    assert_image_of_path(behind_bars(**VIEWS[view]()))


def test_a_table_that_is_wrong_everywhere_changes_no_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    table = VisibilityLens._table

    def garbage(self):
        words = np.random.default_rng(4).integers(1, 256, 4 * len(table(self)), np.uint8)
        return mi.UInt32(words.view(np.uint32))

    monkeypatch.setattr(VisibilityLens, "_table", garbage)
    assert_image_of_path(behind_bars(), 1024)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"], indirect=True)
def test_variants_show_the_image_of_path(variant: str) -> None:
    assert_image_of_path(behind_bars())


@pytest.mark.slow
def test_shapes_move_before_the_lens_as_in_the_path_tracer() -> None:
    plate = rectangle(T().translate([-0.3, -3, 1]).rotate([1, 0, 0], 90).scale([0.1, 1, 1]),
                      bsdf={"type": "twosided", "bsdf": diffuse(0.3)})  # fmt: skip
    moving = {"type": "moving", "translate": [0.6, 0, 0], "plate": plate}
    scene = behind_bars(camera={"shutter_open": 0.0, "shutter_close": 1.0}, bars=False,
                        moving=moving)  # fmt: skip
    assert_image_of_path(scene, reference="composed_path")


@pytest.mark.slow
def test_hidden_emitters_are_looked_through() -> None:
    lamp = rectangle(T().translate([0, -3.2, 1]).rotate([1, 0, 0], -90).scale(0.1),
                     bsdf=diffuse(), emitter=area(30.0))  # fmt: skip
    assert_image_of_path(behind_bars(near_lamp=lamp), hide_emitters=True)


def test_the_same_seed_gives_the_same_image() -> None:
    scene = mi.load_dict(behind_bars())
    first, second = (batches(scene, light_tracer(max_depth=4), 32, [7])[0] for _ in range(2))
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5 * first.mean())


def test_a_pinhole_has_the_image_of_uniform_sampling_and_a_warning(
    capfd: pytest.CaptureFixture,
) -> None:
    scene = mi.load_dict(stage())
    images = [
        batches(scene, mi.load_dict({"type": "light_tracer", "lens_sampling": kind}), 8, [3])
        for kind in LENSES
    ]
    np.testing.assert_allclose(*images, rtol=1e-5, atol=1e-6)
    out = capfd.readouterr()
    assert (out.out + out.err).count("no aperture") == 1


# ---- Errors ----


def test_wrong_values_are_named() -> None:
    with pytest.raises((ValueError, RuntimeError), match='"light_tracer": .*"lens_sampling"'):
        mi.load_dict({"type": "light_tracer", "lens_sampling": "best"})
