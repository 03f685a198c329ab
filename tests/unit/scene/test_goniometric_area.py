"""``goniometric_area`` has the radiance of its profile, however a path finds the light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.luminaires.ies import read_ies
from tests.support.stage import diffuse, film, rgb, sensor, stage
from tests.support.statistical import assert_same_quarters, batches

pytestmark = pytest.mark.usefixtures("variant")

NAME = "goniometric_area"

#: Intensities of a quarter, at 0°, 45° and 90° about the axis.
QUARTER = """IESNA:LM-63-2002
[TEST] none
TILT=NONE
1 1000 2 5 3 1 2 .1 .1 0
1 1 10
0 22.5 45 67.5 90
0 45 90
100 90 70 30 0
100 80 40 10 0
100 60 10 0 0
"""

#: Without a horizontal angle, with the numbers of a tilted lamp, and backwards too.
ROUND = """IESNA91
TILT=INCLUDE
1 2 0 90 1.0 0.9
1,1000,1,3,1,1,2,0,0,0
1 1 10 0 60 180
0
50 25 100
"""


@pytest.fixture
def ies(tmp_path: Path):
    def write(text: str) -> Path:
        file = tmp_path / "lamp.ies"
        file.write_text(text)
        return file

    return write


def light(shape: str = "rectangle", **parameters: Any) -> mi.Scene:
    """A scene of one light, which must be kept: an emitter does not keep its shape."""
    emitter = {"type": NAME, "radiance": rgb(2.0), **parameters}
    return mi.load_dict({"type": "scene", "light": {"type": shape, "emitter": emitter}})


def radiance(scene: mi.Scene, vertical: list[float], horizontal: list[float]) -> np.ndarray:
    """That of a light in the plane z = 0, in the directions of these angles, in degrees."""
    θ, φ = np.radians(vertical), np.radians(horizontal)
    d = mi.Vector3f(np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), np.cos(θ)])
                    .astype(np.float32))  # fmt: skip
    ray = mi.Ray3f(mi.Point3f(0.1, 0.1, 0) + 5 * d, -d)
    si = scene.ray_intersect(ray)
    value = np.array(si.emitter(scene).eval(si)[0])
    ds = mi.DirectionSample3f(scene, si, _at(ray.o))
    np.testing.assert_allclose(np.array(ds.emitter.eval_direction(_at(ray.o), ds)[0]), value,
                               rtol=1e-3, atol=1e-5)  # fmt: skip
    return value


def _at(p: mi.Point3f) -> mi.Interaction3f:
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    return it


# ---- Profiles ----


def test_radiance_follows_the_power_of_the_cosine() -> None:
    vertical = [0.0, 30.0, 60.0, 85.0]
    value = radiance(light(exponent=3.0), vertical, [10.0] * 4)
    np.testing.assert_allclose(value, 2 * np.cos(np.radians(vertical)) ** 3, rtol=1e-4)


def test_radiance_is_intensity_over_the_area_that_is_seen(ies) -> None:
    scene = light(filename=str(ies(QUARTER)))
    vertical = [0.0, 45.0, 45.0, 45.0, 56.25, 45.0]
    horizontal = [5.0, 0.0, 45.0, 90.0, 135.0, 270.0]
    intensity = np.array([1.0, 0.7, 0.4, 0.1, 0.25, 0.1])
    value = radiance(scene, vertical, horizontal)
    np.testing.assert_allclose(value, 2 * intensity / np.cos(np.radians(vertical)), rtol=2e-3)


def test_at_grazing_angles_a_tenth_of_the_area_is_seen(ies) -> None:
    scene = light(filename=str(ies(ROUND)))
    # 50 and 25 to 100 between 60 and 180 degrees, over the largest one ahead
    value = radiance(scene, [89.0], [0.0])
    intensity = (25 + 75 * 29 / 120) / 50
    np.testing.assert_allclose(value, 2 * intensity / 0.1, rtol=2e-2)


def test_photometric_files_are_read(ies) -> None:
    table = read_ies(ies(QUARTER)).values
    assert table.max() == 1 and table.shape[0] > 1
    np.testing.assert_allclose(table[0], table[-1])
    assert read_ies(ies(ROUND)).values.shape[0] == 1


@pytest.mark.parametrize("text, message", [
    ("nothing", "no line TILT="),
    ("TILT=NONE\n1 1000 1 two", "cannot be read"),
    ("TILT=NONE\n1 1000 1 9 9 1 2 0 0 0\n1 1 1\n0 90\n0\n1 1", "cannot be read"),
    (QUARTER.replace("5 3 1 2", "5 3 2 2"), "type 2"),
    (ROUND.replace("50 25 100", "0 0 0"), "does not shine"),
    (QUARTER.replace("0 22.5 45", "0 45 22.5"), "must increase"),
])  # fmt: skip
def test_files_that_are_not_photometric_are_refused(ies, text: str, message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        light(filename=str(ies(text)))


def test_wrong_parameters_are_refused(ies) -> None:
    for parameters, message in (
        ({"exponent": -1.0}, "at least 0"),
        ({"exponent": 1.0, "filename": str(ies(ROUND))}, "not both"),
        ({"filename": "missing.ies"}, "there is no file"),
    ):
        with pytest.raises(RuntimeError, match=message):
            light(**parameters)


def test_a_sphere_has_no_horizontal_angle(ies) -> None:
    scene = light("sphere", filename=str(ies(QUARTER)))
    with pytest.raises(RuntimeError, match="horizontal angle"):
        scene.emitters()[0].sample_direction(_at(mi.Point3f(3, 0, 0)), mi.Point2f(0.5))


def test_rays_that_leave_have_equal_weights_by_an_exponent() -> None:
    scene = light(exponent=7.0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1000)
    ray, weight = scene.emitters()[0].sample_ray(0, 0.5, sampler.next_2d(), sampler.next_2d())
    np.testing.assert_allclose(np.array(weight), 2 * 4 * 2 * np.pi / 9, rtol=1e-4)
    assert np.array(ray.d)[2].min() > 0


# ---- Images ----


def lit(shape: str, **parameters: Any) -> mi.Scene:
    T = mi.ScalarTransform4f
    turn = T().translate([0.2, 0.1, 1.3]).rotate([1, 0, 0], 165).rotate([0, 0, 1], 30)
    lamp = {"type": shape, "to_world": turn.scale([0.4, 0.4, 0.4]), "bsdf": diffuse(0.0),
            "emitter": {"type": NAME, "radiance": rgb(5, 4, 3), **parameters}}  # fmt: skip
    return mi.load_dict(stage(light=lamp, camera=sensor(film=film(8, 8))), optimize=False)


def assert_two_ways_agree(scene: mi.Scene, first: dict, second: dict) -> None:
    images = [
        batches(scene, mi.load_dict({**way, "hide_emitters": True}), 256, range(seed, seed + 6))
        for way, seed in ((first, 1), (second, 1001))
    ]
    assert_same_quarters(*images, precision=0.05)


BY_CONNECTIONS = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
BY_HITS = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 4}


def test_connections_and_hits_find_the_same_light(ies) -> None:
    assert_two_ways_agree(lit("rectangle", filename=str(ies(QUARTER))), BY_CONNECTIONS, BY_HITS)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["rectangle", "disk", "sphere", "cube"])
def test_connections_and_hits_find_the_same_light_on_each_shape(shape: str) -> None:
    assert_two_ways_agree(lit(shape, exponent=4.0), BY_CONNECTIONS, BY_HITS)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["ptracer", "light_tracer", "bdpt", "neepp"])
def test_paths_that_start_from_the_light_find_the_same(ies, integrator: str) -> None:
    assert_two_ways_agree(
        lit("disk", filename=str(ies(QUARTER))),
        {"type": integrator, "max_depth": 2}, {"type": "path", "max_depth": 2},
    )  # fmt: skip
