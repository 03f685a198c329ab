"""What ``bdpt`` and ``light_tracer`` get from the one ``render()``: samplers, passes, time budget,
interruption, output variables."""

from __future__ import annotations

import os
import signal
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.clock import PassClock
from tests.support.emitters_and_materials import T, below_the_lamp
from tests.support.stage import area, diffuse, film, lookat, rectangle, rgb, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_same_quarters,
    batches,
    some,
    z_exact,
)
from tests.support.techniques import REFERENCE, TECHNIQUES

pytestmark = pytest.mark.usefixtures("variant")

NAMES = ("bdpt", "light_tracer")

BOTH = pytest.mark.parametrize("name", some("light_tracer", of=NAMES))


def _assert_same_seed(image: np.ndarray, other: np.ndarray) -> None:
    """Splats are added in the order in which threads come to them."""
    np.testing.assert_allclose(image, other, rtol=1e-4, atol=1e-5 * other.mean())


# ---- Samplers ----

#: Samples that each can take: 7² is the square of a prime.
SAMPLERS = {
    "stratified": 64, "multijitter": 64, "orthogonal": 49, "ldsampler": 64, "sobol_owen": 64,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_structured_samples_over_several_passes_keep_the_mean(sampler: str, name: str) -> None:
    """Neighbouring seeds would share strata: the seeds are far from each other."""
    spp, seeds = SAMPLERS[sampler], [7919 * i for i in range(1, MANY_SEEDS + 1)]
    scene = mi.load_dict(stage(camera=below_the_lamp(sampler=sampler)), optimize=False)
    integrator = TECHNIQUES[name].make(4)
    integrator.samples_per_pass = 16
    images = batches(scene, integrator, spp, seeds)
    assert integrator.statistics.spp == spp and integrator.statistics.passes >= 4
    _assert_same_seed(batches(scene, integrator, spp, seeds[-1:])[0], images[-1])
    reference = mi.load_dict(stage(camera=below_the_lamp()), optimize=False)
    expected = batches(reference, REFERENCE.make(4), 256, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.01)


# ---- Interruption, time budget ----


@BOTH
def test_cancelling_returns_the_image_of_the_finished_passes(name: str) -> None:
    scene, integrator = mi.load_dict(stage()), TECHNIQUES[name].make(4)
    integrator.samples_per_pass = 4
    (whole,) = batches(scene, integrator, 8, [5])
    integrator.progress = lambda fraction: integrator.cancel() if fraction >= 0.5 else None
    (image,) = batches(scene, integrator, 16, [5])
    assert integrator.statistics.interrupted and integrator.statistics.spp == 8
    _assert_same_seed(image, whole)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_ctrl_c_leaves_the_finished_passes_in_the_film(name: str) -> None:
    scene, integrator = mi.load_dict(stage()), TECHNIQUES[name].make(4)
    integrator.samples_per_pass = 4
    (whole,) = batches(scene, integrator, 4, [5])
    integrator.progress = lambda fraction: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, seed=5, spp=16)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 4
    _assert_same_seed(np.array(scene.sensors()[0].film().bitmap()), whole)


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["independent", "stratified"])
@pytest.mark.parametrize("name", NAMES)
def test_the_timeout_is_kept(monkeypatch: pytest.MonkeyPatch, name: str, sampler: str) -> None:
    """The mean of the samples that fit is right."""
    scene = mi.load_dict(stage(camera=below_the_lamp(sampler=sampler)))
    integrator = TECHNIQUES[name].make(3)
    (whole,) = batches(scene, integrator, 144, [5])
    timed = TECHNIQUES[name].make(3, timeout=8.0)
    timed.samples_per_pass = 12
    clock = PassClock(monkeypatch)
    image = timed.render(scene, seed=6, spp=144).numpy()
    assert timed.statistics.spp == round(clock.now / 0.1)
    assert 8.0 * 0.85 <= clock.now <= 8.0 * 1.15
    assert image.mean() == pytest.approx(whole.mean(), rel=0.05)


# ---- Output variables, integrators around them ----


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_output_variables_come_from_the_camera_rays(name: str) -> None:
    """Alpha too. The image is that without them."""
    aovs = "depth:depth,normal:sh_normal"
    camera = sensor(film=film(pixel_format="rgba", rfilter={"type": "gaussian"}))
    scene = mi.load_dict(stage(camera=camera, wall=None))
    with_aovs, without, path = (
        batches(scene, TECHNIQUES[n].make(4, **more), 16, [5])[0]
        for n, more in ((name, {"aovs": aovs}), (name, {}), ("composed_path", {"aovs": aovs}))
    )
    assert with_aovs.shape[-1] == 4 + 1 + 3 and 0 < path[..., 3].mean() < 1
    _assert_same_seed(with_aovs[..., :4], without)
    np.testing.assert_allclose(with_aovs[..., 3:], path[..., 3:], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("outer", ["moment", "aov"])
@pytest.mark.parametrize("name", NAMES)
def test_it_cannot_be_nested_where_single_samples_are_asked_for(name: str, outer: str) -> None:
    more = {"aovs": "depth:depth"} if outer == "aov" else {}
    nesting = mi.load_dict({"type": outer, "image": {"type": name, "max_depth": 2}, **more})
    with pytest.raises((NotImplementedError, RuntimeError), match=f'"{name}": light paths'):
        nesting.render(mi.load_dict(stage()), spp=1)


# ---- Motion ----


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_moving_shapes_are_blurred_as_by_the_path_tracer(name: str) -> None:
    cube = {"type": "cube", "to_world": T().translate([0.5, 0, 0.4]).scale([0.3, 0.3, 0.4]),
            "bsdf": diffuse(0.3, 0.6, 0.3)}  # fmt: skip
    block = {"type": "moving", "axis": [1.0, 2.0, 0.5], "angle": 200.0,
             "translate": [0.3, 0.0, 0.1], "child": cube}  # fmt: skip
    camera = below_the_lamp("thinlens", aperture_radius=0.1, focus_distance=4.0,
                            shutter_open=0.25, shutter_close=0.75)  # fmt: skip
    scene = mi.load_dict(stage(camera=camera, block=block), optimize=False)
    images = batches(scene, TECHNIQUES[name].make(4), 256, SEEDS[:MANY_SEEDS])
    path = TECHNIQUES["composed_path"].make(4)
    expected = batches(scene, path, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.005)


# ---- Storage ----


def _white_room(albedo: float) -> dict[str, Any]:
    """Its walls emit what they absorb: the radiance is 1 everywhere."""
    view = lookat([0, 0, 0.9], [0, 0, 0], [0, 1, 0])
    walls = {"type": "cube", "flip_normals": True, "bsdf": diffuse(albedo),
             "emitter": area(1 - albedo)}  # fmt: skip
    return {"type": "scene", "sensor": sensor(to_world=view), "walls": walls}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_paths_of_any_length_in_a_white_room_add_up(name: str) -> None:
    """Paths have dozens of vertices; roulette alone ends them."""
    scene = mi.load_dict(_white_room(0.9))
    images = batches(scene, TECHNIQUES[name].make(-1), 16, range(1, MANY_SEEDS + 1))
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0)
    assert abs(z) < THRESHOLD and error < 0.02, (z, error)


@pytest.mark.parametrize("name", some("bdpt", of=NAMES))
def test_light_paths_that_meet_nothing_are_no_error(name: str) -> None:
    """There are no vertices to connect to, or to see."""
    away = {"type": "spot", "to_world": lookat([0, 0, 3], [0, 0, 4], [0, 1, 0]),
            "intensity": rgb(1.0)}  # fmt: skip
    scene = mi.load_dict(stage(light=away), optimize=False)
    assert not batches(scene, TECHNIQUES[name].make(4), 4, [1]).any()
    panel = rectangle(T().translate([0, 0, 2]), emitter=area(1.0))
    camera = sensor(to_world=lookat([0, 0, 4], [0, 0, 2], [0, 1, 0]))
    scene = mi.load_dict(stage(light=panel, camera=camera, floor=None, wall=None, block=None))
    (image,) = batches(scene, TECHNIQUES[name].make(4), 4, [1])
    assert np.allclose(image[4:12, 4:12], 1.0)
