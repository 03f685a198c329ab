"""How renders are cut into passes, on machines of any memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.estimators.light_paths.path_memory import bytes_of_both_paths
from mitsuba_ext.rendering import device as devices
from mitsuba_ext.rendering.device import Device, device_of, look_again
from mitsuba_ext.rendering.plan import RenderPlan, plan_render, whole_warps
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.util.memory import Memory
from tests.support.paths import ROOT
from tests.support.stage import stage

pytestmark = pytest.mark.usefixtures("variant")

GiB, MiB = 1 << 30, 1 << 20


def _device(is_gpu: bool, total: float, free: float | None = None) -> Device:
    free = total if free is None else free
    return Device.with_memory(is_gpu, Memory(int(total * GiB), int(free * GiB)))


H100, CPU = _device(True, 79.2), _device(False, 23.4)


def _plan(device: Device, name: str, size: tuple[int, int], spp: int, **parts: Any) -> RenderPlan:
    sensor = mi.load_dict({
        "type": "perspective", "sampler": {"type": parts.pop("sampler", "independent")},
        "film": {"type": "hdrfilm", "width": size[0], "height": size[1]},
    })  # fmt: skip
    integrator = mi.load_dict({"type": name, **{"max_depth": 8, **parts}})
    request = Request(mi.load_dict(stage()), sensor, 0, spp, timeout=-1)
    return plan_render(integrator, request, sensor.sampler(), device)


def _runs(plan: RenderPlan, samples: int) -> int:
    """The number of times that an estimator is run for the last stage."""
    return plan.parts * -(-samples // plan.pass_length(samples))


@pytest.mark.parametrize("total", [15.3, 16, 23.4, 24])
def test_machines_of_16_to_24_gib_have_passes_of_512_mib(total: float) -> None:
    assert _device(False, total).pass_bytes == 512 * MiB


@pytest.mark.parametrize(
    ("total", "expected"), [(0.5, 16), (1, 32), (3.8, 128), (8, 256), (31.3, 1024), (252, 2048)]
)
def test_passes_on_a_cpu_follow_its_memory(total: float, expected: int) -> None:
    """Up to 2 GiB."""
    assert _device(False, total).pass_bytes == expected * MiB


@pytest.mark.parametrize(
    ("total", "expected"),
    [(3.9, 1.25), (7.7, 2.5), (11.6, 3.5), (23.5, 7), (39.4, 12), (79.2, 24), (140, 28)],
)
def test_passes_on_a_gpu_take_nearly_a_third_of_its_memory(total: float, expected: int) -> None:
    assert _device(True, total).pass_bytes == expected * GiB


@pytest.mark.parametrize("is_gpu, total, free, expected", [
    (False, 16, 1.25, 512 * MiB), (False, 16, 1.24, 256 * MiB), (False, 16, 0.4, 128 * MiB),
    (False, 16, 0.0, 16 * MiB), (True, 79.2, 60, 24 * GiB), (True, 79.2, 20, 6 * GiB),
])  # fmt: skip
def test_passes_fit_into_the_memory_that_is_free(is_gpu, total, free, expected) -> None:
    """Dr.Jit's arrays take more than their size."""
    assert _device(is_gpu, total, free).pass_bytes == expected


def test_a_device_of_unknown_memory_has_passes_that_fit_nearly_everywhere() -> None:
    assert Device.with_memory(False, None).pass_bytes == 512 * MiB
    assert Device.with_memory(True, None).pass_bytes == 2 * GiB


@pytest.fixture
def looks_again() -> Iterator[None]:
    """The device is looked at in this test, and in the next one."""
    look_again()
    yield
    look_again()


@pytest.mark.usefixtures("looks_again")
def test_memory_that_former_renders_hold_is_given_back_where_little_is_free(monkeypatch) -> None:
    flushed: list[int] = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: flushed.append(1))
    for read in ("gpu_memory", "machine_memory"):
        monkeypatch.setattr(
            devices, read, lambda: Memory(16 * GiB, GiB // 8 + 3 * GiB * len(flushed))
        )
    for _ in range(2):
        is_gpu = device_of(mi.Float).is_gpu
        assert device_of(mi.Float).pass_bytes == (5 * GiB // 4 if is_gpu else 512 * MiB)
    assert len(flushed) == 1, "once in a render"


@pytest.mark.parametrize(("total", "length"), [(23.4, 16), (3.8, 4), (1, 1)])
def test_passes_of_a_large_film_fit_into_a_quarter_of_the_memory(total: float, length: int) -> None:
    """A sample stores 24 bytes. At 3840x2160, passes of 16 samples would take 3 GiB."""
    plan = _plan(_device(False, total), "composed_path", (3840, 2160), 64)
    assert plan.pass_length(64) == length


def test_bidirectional_passes_on_a_large_gpu_are_few() -> None:
    """They were 384 runs, of 300 000 lanes each."""
    plan = _plan(H100, "bdpt", (1280, 720), 128)
    assert plan.parts == 1 and _runs(plan, 128) <= 8
    assert plan.pass_length(128) == 16


@pytest.mark.parametrize(
    ("device", "parts"), [(_device(False, 3.8), 9), (CPU, 3), (_device(False, 252), 1)]
)
def test_bidirectional_passes_on_a_cpu_follow_its_memory(device: Device, parts: int) -> None:
    plan = _plan(device, "bdpt", (1280, 720), 128)
    assert plan.parts == parts and plan.pass_length(128) == 1


def test_passes_on_a_cpu_have_these_lengths() -> None:
    assert _plan(CPU, "bdpt", (320, 180), 128).pass_length(128) == 7
    assert _plan(CPU, "sppm", (320, 180), 128).pass_length(128) == 8
    assert _plan(CPU, "light_tracer", (320, 180), 128).pass_length(128) == 8
    assert _plan(CPU, "composed_path", (320, 180), 128).pass_length(128) == 32
    assert _plan(CPU, "composed_path", (320, 180), 100).pass_length(100) == 34
    assert _plan(CPU, "composed_path", (1920, 1080), 40).pass_length(40) == 14


@pytest.mark.parametrize("light_paths, at_most", [(1, 8), (4, 32)])
def test_stages_with_many_light_paths_have_shorter_passes(light_paths: int, at_most: int) -> None:
    plan = _plan(H100, "composed_path", (1280, 720), 128)
    most = H100.lanes(bytes_of_both_paths(light_paths, 8))
    length = plan.pass_length(128, most)
    assert -(-128 // length) <= at_most and length * 1280 * 720 <= most


@pytest.mark.parametrize("name", ["bdpt", "vcm", "sppm"])
@pytest.mark.parametrize("max_depth, length", [(4, 16), (8, 16), (16, 4), (-1, 2)])
def test_passes_on_a_gpu_have_room_for_long_paths(name: str, max_depth: int, length: int) -> None:
    """The vertices of all light paths are in one array, which has less than 2^32 words."""
    plan = _plan(H100, name, (1280, 720), 128, max_depth=max_depth)
    assert plan.pass_length(128) == length
    vertices = 31 if max_depth < 0 else max_depth - 1
    assert 1280 * 720 * length * vertices * 40 < 1 << 32


def test_passes_on_a_cpu_do_not_depend_on_the_length_of_paths() -> None:
    """A CPU has much more memory than a pass takes."""
    lengths = [
        _plan(CPU, "bdpt", (320, 180), 128, max_depth=depth).pass_length(128)
        for depth in (4, 16, -1)
    ]
    assert lengths == [7, 7, 7]


@pytest.mark.parametrize("spp", [1, 5, 31, 32, 40, 64, 100, 128, 1000])
@pytest.mark.parametrize("size", [(320, 180), (1280, 720), (1920, 1080), (7680, 4320)])
@pytest.mark.parametrize("name", ["composed_path", "bdpt", "light_tracer"])
def test_warps_of_a_gpu_have_samples_of_one_pixel(name: str, size, spp: int) -> None:
    """Where a pass has that many samples, and memory allows."""
    plan = _plan(H100, name, size, spp)
    length = plan.pass_length(spp)
    assert length % 32 == 0 or 32 % length == 0
    assert length <= plan.limit and length < 2 * spp + 31
    lanes = -(-size[0] * size[1] // plan.parts) * length
    assert lanes <= plan.most_lanes and lanes <= 1 << 26


def test_paths_on_a_gpu_need_few_passes() -> None:
    assert _runs(_plan(H100, "composed_path", (1280, 720), 128), 128) == 2
    small = _plan(_device(True, 7.7), "composed_path", (1280, 720), 128)
    assert small.pass_length(128) == 16


def test_passes_of_a_structured_sampler_on_a_gpu_have_equal_lengths() -> None:
    plan = _plan(H100, "composed_path", (1280, 720), 96, sampler="stratified")
    assert plan.spp % plan.pass_length(plan.spp) == 0 and _runs(plan, plan.spp) <= 3


@pytest.mark.usefixtures("looks_again")
@pytest.mark.parametrize("total, size, tries", [
    (3.8, (640, 480), True), (3.8, (1280, 720), False), (15.3, (1920, 1080), True),
    (15.3, (2048, 1536), False), (252, (3840, 2160), True),
])  # fmt: skip
def test_auto_tries_light_paths_where_memory_has_room_for_all_pixels(
    total: float, size: tuple[int, int], tries: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Memory(int(total * GiB), int(total * GiB))
    for read in ("gpu_memory", "machine_memory"):
        monkeypatch.setattr(devices, read, lambda: memory)
    if device_of(mi.Float).is_gpu:
        pytest.skip("numbers of a CPU")
    scene = mi.load_file(str(ROOT / "scenes" / "rooms.xml"), width=size[0], height=size[1])
    learning = mi.load_dict({"type": "auto", "max_depth": 8}).plan_learning(
        Request(scene, scene.sensors()[0], 0, 256), 256
    )
    assert (learning.trial is not None) == tries


@pytest.mark.parametrize(
    ("samples", "warp", "length"),
    [(100, 32, 96), (32, 32, 32), (31, 32, 16), (1, 32, 1), (0, 32, 0), (7, 1, 7), (0, 1, 0)],
)
def test_warps_are_not_split_between_pixels(samples: int, warp: int, length: int) -> None:
    assert whole_warps(samples, warp) == length


@pytest.mark.parametrize(
    ("aovs", "parts", "length"),
    [("", 1, 16), ("a:depth", 1, 16), ("a:caustics", 1, 5), ("a:direct,b:indirect", 1, 2)],
)
def test_the_channels_of_expressions_count_in_the_memory_of_a_pass(aovs, parts, length) -> None:
    """Eight of them took 4 GiB at 1280x720, where all 16 samples were in one pass."""
    film = {"type": "hdrfilm", "width": 3840, "height": 2160}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    integrator = mi.load_dict({"type": "composed_path", "aovs": aovs})
    scene = mi.load_dict(stage())
    integrator.look_at(scene)
    plan = plan_render(integrator, Request(scene, sensor, 0, 64, timeout=-1), sensor.sampler(), CPU)
    assert (plan.parts, plan.pass_length(64)) == (parts, length)
