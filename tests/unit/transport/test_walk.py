"""The random walk: its decisions can be replaced, and kernels hold no code that a scene does not
need."""

from __future__ import annotations

import gc
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.path_decisions import (
    DirectionSamples,
    EmitterSampling,
    Roulette,
    SceneQuery,
    ShadowTest,
)
from mitsuba_ext.transport.walk import Walk

BOUNCES = 4

#: Some of them connect to the lamp at each bounce.
LANES = 64


class _Recorder:
    """A table of what a decision saw: one row of numbers for each bounce."""

    def __init__(self) -> None:
        self.table = dr.zeros(mi.Float, BOUNCES)

    def write(self, bounce: mi.UInt32, number: mi.Float, active: mi.Bool) -> None:
        dr.scatter(self.table, number, bounce, active & (bounce < BOUNCES))


class _RecordingDirections(DirectionSamples):
    def __init__(self, recorder: _Recorder) -> None:
        self.recorder = recorder

    def begin(self, sampler, ray, pixel):
        return mi.UInt32(0)

    def draw(self, state, sampler, vertex, active):
        sample_1, sample_2, weight, _ = super().draw((), sampler, vertex, active)
        self.recorder.write(state, sample_2.x, active)
        return sample_1, sample_2, weight, state + 1


class _RecordingNextEvent(EmitterSampling):
    def __init__(self, recorder: _Recorder) -> None:
        self.recorder = recorder

    def begin(self, sampler, ray, pixel):
        return mi.UInt32(0)

    def visit(self, state, scene, si, active):
        return state + 1

    def sample(self, place, scene, numbers, si, active):
        ds, weight, _ = super().sample((), scene, numbers, si, active)
        self.recorder.write(place - 1, ds.uv.x, active)
        return ds, weight, place


class _RecordingShadowTest(ShadowTest):
    def __init__(self, recorder: _Recorder) -> None:
        self.recorder = recorder

    def begin(self, sampler, ray):
        return mi.UInt32(0)

    def probability(self, state, choice, si, ds, active):
        self.recorder.write(state, ds.dist, active)
        return mi.Float(1), state + 1


class _RecordingRoulette(Roulette):
    def __init__(self, recorder: _Recorder) -> None:
        self.recorder = recorder

    def begin(self, sampler, ray, pixel):
        return mi.UInt32(0)

    def survival(self, state, vertex, path, active):
        self.recorder.write(state, path.β.x * mi.Float(path.depth), active)
        return mi.Float(1), state + 1


class _RecordingQuery(SceneQuery):
    """A decision without state: only its arguments can differ from bounce to bounce."""

    def __init__(self, recorder: _Recorder, occluded: _Recorder) -> None:
        super().__init__()
        self.recorder, self.shadow = recorder, occluded

    def closest(self, scene, ray, coherent, active):
        self.recorder.write(mi.UInt32(0 if coherent else 1), ray.o.x, active)
        return super().closest(scene, ray, coherent, active)

    def occluded(self, scene, si, ds, active):
        self.shadow.write(mi.UInt32(0), ds.p.x, active)
        return super().occluded(scene, si, ds, active)


@pytest.fixture
def box(variant: str) -> mi.Scene:
    """A closed, lit, diffuse box: no path ends before the last bounce."""
    return mi.load_dict(
        {
            "type": "scene",
            "box": {
                "type": "cube",
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.9}},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 0.9]).scale(0.3).rotate(
                    [1, 0, 0], 180
                ),
                "emitter": {"type": "area", "radiance": 1.0},
            },
        }
    )


def _trace(scene: mi.Scene, rr_depth: int = 100, **decisions):
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, LANES)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
    ray.time = dr.zeros(mi.Float, LANES)
    walk = Walk(BOUNCES + 1, rr_depth, **decisions)
    sample = walk(scene, sampler, CameraRays(ray), mi.Bool(True))
    dr.eval(sample.L)
    return sample


@pytest.mark.parametrize(
    "decision, recording",
    [
        ("directions", _RecordingDirections),
        ("next_event", _RecordingNextEvent),
        ("shadow_test", _RecordingShadowTest),
        ("roulette", _RecordingRoulette),
    ],
)
def test_each_bounce_sees_another_number_and_another_state(box, decision, recording):
    recorder = _Recorder()
    _trace(box, 1 if decision == "roulette" else 100, **{decision: recording(recorder)})
    numbers = recorder.table.numpy()
    assert len(set(numbers)) == BOUNCES, numbers
    assert (numbers != 0).all(), "the state did not advance"


def test_a_replaced_query_is_asked_for_camera_scattered_and_shadow_rays(box):
    closest, shadow = _Recorder(), _Recorder()
    _trace(box, query=_RecordingQuery(closest, shadow))
    camera, scattered = closest.table.numpy()[:2]
    assert camera == pytest.approx(0.1) and scattered not in (0, camera)
    assert shadow.table.numpy()[0] != 0


def test_a_rejected_connection_traces_no_shadow_ray_and_survivors_weigh_more(box):
    class Half(ShadowTest):
        def probability(self, state, choice, si, ds, active):
            return mi.Float(0.5), state

    def total(walk: Walk) -> tuple[float, float]:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 200_000)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
        ray.time = dr.zeros(mi.Float, 200_000)
        sample = walk(box, sampler, CameraRays(ray), mi.Bool(True))
        return float(dr.mean(sample.L.x)[0]), float(dr.mean(mi.Float(sample.shadow_count))[0])

    L, rays = total(Walk(3, 100))
    L_half, rays_half = total(Walk(3, 100, shadow_test=Half()))
    assert rays_half == pytest.approx(rays / 2, rel=0.02)
    assert L_half == pytest.approx(L, rel=0.02)


def test_survivors_of_roulette_weigh_more(box):
    class Half(Roulette):
        def survival(self, state, vertex, path, active):
            return mi.Float(0.5), state

    def total(walk: Walk) -> tuple[float, float]:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 400_000)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
        ray.time = dr.zeros(mi.Float, 400_000)
        sample = walk(box, sampler, CameraRays(ray), mi.Bool(True))
        return float(dr.mean(sample.L.x)[0]), float(dr.mean(mi.Float(sample.scatter_count))[0])

    L, rays = total(Walk(3, 100))
    L_half, rays_half = total(Walk(3, 1, roulette=Half()))
    # One ray for the first bounce of each path
    assert rays_half == pytest.approx(1 / 2 + (rays - 1) / 4, rel=0.02)
    assert L_half == pytest.approx(L, rel=0.03)


def test_weights_of_guided_samples_do_not_end_paths(box):
    """A high density of guided samples makes the throughput low, although the path is important."""

    class Weighted(DirectionSamples):
        def draw(self, *arguments):
            *sample, _weight, state = super().draw(*arguments)
            return *sample, mi.Float(0.1), state

    def scattered(directions: DirectionSamples) -> float:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 10_000)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
        ray.time = dr.zeros(mi.Float, 10_000)
        walk = Walk(20, rr_depth=1, directions=directions)
        sample = walk(box, sampler, CameraRays(ray), mi.Bool(True))
        return float(dr.mean(mi.Float(sample.scatter_count))[0])

    expected = scattered(DirectionSamples())
    assert 0.5 < expected < 15
    assert scattered(Weighted()) == pytest.approx(expected, rel=1e-2)


KERNEL_SIZE = """
import mitsuba_ext, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
dr.set_flag(dr.JitFlag.KernelHistory, True)

def size(integrator, *emitters):
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sphere": {"type": "sphere"},
        **{f"emitter{i}": emitter for i, emitter in enumerate(emitters)},
    })
    dr.kernel_history_clear()
    mi.render(scene, integrator=mi.load_dict(integrator), spp=1).numpy()
    sizes = [k["operation_count"] for k in dr.kernel_history() if "operation_count" in k]
    return max(n for n in sizes if n)

point = {"type": "point", "position": [0, 0, 3]}
area = {"type": "rectangle", "emitter": {"type": "area"}}
always = {"type": "composed_path"}
print(size(always), size(always, point), size(always, area), size(always, area, area),
      size(always, area, {"type": "constant"}), size({**always, "clamp_direct": 1.0}, area))
"""


def test_kernels_contain_no_features_that_the_scene_lacks():
    """In its own process, because Dr.Jit compiles methods of the objects of all living scenes."""
    output = subprocess.run(
        [sys.executable, "-c", KERNEL_SIZE], capture_output=True, text=True, check=True
    ).stdout
    none, point, area, two_areas, environment, clamped = map(int, output.split()[-6:])
    assert none < point < area, "no lights; lights that cannot be hit; lights that can"
    assert area < two_areas, "the choice between lights"
    assert area < environment, "the environment"
    assert area < clamped, "the limits of a sample's light"


def test_no_scene_is_freed_while_calls_are_traced(box):
    """Dr.Jit calls the methods of all living BSDFs. The process crashes if the garbage collector
    deletes a BSDF in Python between two of these calls."""
    found = []

    class Asking(DirectionSamples):
        def draw(self, *arguments):
            found.append(gc.isenabled())
            return super().draw(*arguments)

    _trace(box, directions=Asking())
    assert found and not any(found) and gc.isenabled()


@pytest.mark.usefixtures("variant")
def test_objects_behind_a_hidden_emitter_are_seen_undistorted():
    """Mitsuba 3.9.1 itself is wrong here: its ``path`` measures the distance to an analytic shape
    behind the emitter from the camera, and renders it black."""
    T = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 20,
            "to_world": T().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8},
        },
        "sphere": {"type": "sphere", "radius": 2},
        "sky": {"type": "point", "position": [5, 5, 20], "intensity": 100.0},
    }
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 2, "hide_emitters": True})
    bare = mi.render(mi.load_dict(scene), integrator=integrator, spp=64).numpy()
    # Two lamps, one behind the other, that fill the view and cast no shadow on the sphere
    for name, z in (("near", 8.9), ("far", 8.8)):
        scene[name] = {
            "type": "rectangle", "to_world": T().translate([0, 0, z]).scale(0.05),
            "emitter": {"type": "area", "radiance": 1e-9},
        }
    behind = mi.render(mi.load_dict(scene), integrator=integrator, spp=64).numpy()
    assert behind[..., :3].mean() == pytest.approx(bare[..., :3].mean(), rel=0.02)


#: The lamp is not in the picture.
LAMP = {"type": "rectangle", "emitter": {"type": "area"}}
SKY = {"type": "constant"}


def _masks(*heights: float, opacity: float = 0.4, light: dict = LAMP, bsdf: dict | None = None):
    """Plates, one below the other, and a light."""
    T = mi.ScalarTransform4f
    masked = {"type": "mask", "opacity": opacity, "bsdf": bsdf or {"type": "roughplastic"}}
    if light is LAMP:
        light = {**LAMP, "to_world": T().translate([0, 0.5, 2]).rotate([1, 0, 0], 180)}
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba"}
    view = {"type": "perspective", "fov": 50, "film": {**film, "rfilter": {"type": "box"}},
            "to_world": T().look_at([0, -1.5, 1.5], [0, 0, 0], [0, 0, 1])}  # fmt: skip
    plates = {f"plate_{i}": {"type": "rectangle", "to_world": T().translate([0, 0, z]),
                             "bsdf": masked} for i, z in enumerate(heights)}  # fmt: skip
    return mi.load_dict({"type": "scene", "sensor": view, "light": light, **plates})


def _image(scene: mi.Scene, **integrator) -> np.ndarray:
    return mi.render(scene, integrator=mi.load_dict(integrator), spp=512, seed=1).numpy()


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "integrator",
    [
        *({"type": "composed_path", "mis": mis} for mis in ("power", "light")),
        {"type": "bdpt"},
        pytest.param({"type": "composed_path", "mis": "bsdf"}, marks=pytest.mark.slow),
        *(pytest.param({"type": name}, marks=pytest.mark.slow)
          for name in ("vcm", "photon_map", "instant_radiosity", "mlt", "pssmlt", "swarm_path")),
    ],
    ids=lambda integrator: "-".join(integrator.values()),
)  # fmt: skip
def test_light_on_a_mask_before_nothing_is_seen_and_alpha_agrees_with_path(integrator) -> None:
    """Mitsuba's ``path`` loses the light of paths that only passed through null surfaces."""
    right = 0.4 * _image(_masks(0, opacity=1.0), type="path", max_depth=2)[..., :3].mean()
    image = _image(_masks(0), **integrator, max_depth=2)
    assert image[..., :3].mean() == pytest.approx(right, rel=0.03)
    alpha = _image(_masks(0), type="path", max_depth=2)[..., 3].mean()
    assert image[..., 3].mean() == pytest.approx(alpha, rel=0.03)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "name", ["composed_path", "mlt", *(
        pytest.param(name, marks=pytest.mark.slow) for name in ("bdpt", "vcm", "photon_map"))],
)  # fmt: skip
def test_with_the_emitters_the_sky_behind_masks_is_hidden_but_not_its_light_on_them(name) -> None:
    method = {"max_depth": 3, "hide_emitters": True}
    black = {"type": "diffuse", "reflectance": 0.0}
    assert not _image(_masks(0, -1, bsdf=black, light=SKY), type=name, **method)[..., :3].any()
    right = 0.4 * _image(_masks(0, opacity=1.0, light=SKY), type="path", **method)[..., :3].mean()
    found = _image(_masks(0, light=SKY), type=name, **method)[..., :3].mean()
    assert found == pytest.approx(right, rel=0.03)
