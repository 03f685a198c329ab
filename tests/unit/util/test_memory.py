"""How much memory a process may use."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import pytest

from mitsuba_ext.util.memory import Memory, gpu_memory, machine_memory

GiB = 1 << 30


def _write(root: Path, files: dict[str, object]) -> Path:
    meminfo = f"MemTotal: {16 << 20} kB\nMemFree: 1 kB\nMemAvailable: {12 << 20} kB\n"
    for name, text in {"proc/meminfo": meminfo, **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(str(text))
    return root


def test_the_whole_machine_is_there_without_groups(tmp_path: Path) -> None:
    assert machine_memory(_write(tmp_path, {})) == Memory(16 * GiB, 12 * GiB)


@pytest.mark.parametrize("path", ["/job", "/job/step", "/folder_of_the_host/job"])
def test_a_group_of_version_2_limits_its_members(tmp_path: Path, path: str) -> None:
    """The group may be named by a path of the host, and an outer group has the limit of an inner
    one. Cached files are no memory in use."""
    groups = "sys/fs/cgroup"
    folder = f"{groups}/job" if path.startswith("/job") else groups
    memory = machine_memory(_write(tmp_path, {
        "proc/self/cgroup": f"0::{path}\n",
        f"{groups}/job/step/memory.max": "max\n",
        f"{folder}/memory.max": 4 * GiB,
        f"{folder}/memory.current": 3 * GiB,
        f"{folder}/memory.stat": f"anon 7\ninactive_file {GiB}\n",
    }))  # fmt: skip
    assert memory == Memory(4 * GiB, 2 * GiB)


def test_a_group_of_version_1_limits_its_members(tmp_path: Path) -> None:
    groups = "sys/fs/cgroup/memory"
    memory = machine_memory(_write(tmp_path, {
        "proc/self/cgroup": "4:cpu,memory:/docker/12ab\n3:pids:/\n0::/\n",
        f"{groups}/memory.limit_in_bytes": 2 * GiB,
        f"{groups}/memory.usage_in_bytes": GiB,
        f"{groups}/memory.stat": f"inactive_file 7\ntotal_inactive_file {GiB // 2}\n",
    }))  # fmt: skip
    assert memory == Memory(2 * GiB, 3 * GiB // 2)


def test_a_group_without_a_limit_changes_nothing(tmp_path: Path) -> None:
    groups = "sys/fs/cgroup/memory"
    memory = machine_memory(_write(tmp_path, {
        "proc/self/cgroup": "4:memory:/\n",
        f"{groups}/memory.limit_in_bytes": 0x7FFFFFFFFFFFF000,
        f"{groups}/memory.usage_in_bytes": GiB,
    }))  # fmt: skip
    assert memory == Memory(16 * GiB, 12 * GiB)


@pytest.mark.skipif(sys.platform == "win32", reason="no ulimit")
def test_a_limit_of_the_address_space_counts(tmp_path: Path, monkeypatch) -> None:
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda kind: (8 * GiB, 8 * GiB))
    root = _write(tmp_path, {"proc/self/statm": f"{3 * GiB // resource.getpagesize()} 5 5"})
    assert machine_memory(root) == Memory(8 * GiB, 5 * GiB)


class _Driver:
    """A driver of a GPU with 80 GiB, whose functions record their order."""

    def __init__(self, **results: int) -> None:
        self.results, self.calls = results, []

    def __getattr__(self, name: str):
        def call(*arguments) -> int:
            self.calls.append(name)
            if name == "cuMemGetInfo_v2":
                for pointer, value in zip(arguments, (60 * GiB, 80 * GiB)):
                    ctypes.cast(pointer, ctypes.POINTER(ctypes.c_size_t))[0] = value
            return self.results.get(name, 0)

        return call


def test_the_driver_tells_the_memory_of_a_gpu() -> None:
    driver = _Driver()
    assert gpu_memory(driver) == Memory(80 * GiB, 60 * GiB)
    assert driver.calls == [
        "cuDevicePrimaryCtxRetain", "cuCtxPushCurrent_v2", "cuMemGetInfo_v2", "cuCtxPopCurrent_v2",
        "cuDevicePrimaryCtxRelease_v2",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "name", ["cuDevicePrimaryCtxRetain", "cuCtxPushCurrent_v2", "cuMemGetInfo_v2"]
)
def test_a_driver_that_fails_tells_nothing_and_is_left_as_it_was(name: str) -> None:
    driver = _Driver(**{name: 3})
    assert gpu_memory(driver) is None
    begun = "cuDevicePrimaryCtxRetain" != name
    assert ("cuDevicePrimaryCtxRelease_v2" in driver.calls) == begun
    assert ("cuCtxPopCurrent_v2" in driver.calls) == (name == "cuMemGetInfo_v2")
    assert gpu_memory(object()) is None, "a library without these functions"
