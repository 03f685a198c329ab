"""Fixtures for tests that render: the variant, the folder of scenes, and a clean-up per module."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tests.support.quick_kernels  # noqa: F401  isort: skip  (before drjit)

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before drjit and mitsuba)
from mitsuba_ext import cli
from mitsuba_ext.cli import image_render
from mitsuba_ext.compare import timing
from mitsuba_ext.transport.frozen import forget_recordings
from tests.support.clock import Clock
from tests.support.command_line import PATH, SCENE, SPHERE
from tests.support.paths import ROOT

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

DEFAULT_VARIANT = "llvm_ad_rgb"

#: ``MITSUBA_EXT_TEST_BACKEND=cuda`` runs the tests on a GPU.
BACKEND = os.environ.get("MITSUBA_EXT_TEST_BACKEND", "llvm")

# Background jobs of a shell ignore SIGINT, and jobs of ``nohup`` ignore SIGHUP: so would the
# processes that the tests interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def share_of_the_cores() -> None:
    """Several workers share the machine."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    # With one thread, Mitsuba 3.9.1 hangs when it reads or writes an EXR file
    dr.set_thread_count(max(2, cores // workers))
    if workers >= cores and sys.platform == "linux":
        _let_main_threads_go_first()


def _let_main_threads_go_first() -> None:
    """Threads of Dr.Jit that wait for work do so in a loop, at the cost of other processes."""
    for task in Path("/proc/self/task").iterdir():
        if (task / "comm").read_text().startswith("nt ["):
            os.setpriority(os.PRIO_PROCESS, int(task.name), 19)


@pytest.fixture(scope="session", autouse=True)
def what_is_imported_is_no_garbage() -> None:
    """Without it, the collector of garbage takes a seventh of the time."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def variant(request: pytest.FixtureRequest) -> Iterator[str]:
    """Selects a variant, ``llvm_ad_rgb`` unless the test is parametrised (``indirect=True``).

    Modules that render name it once: ``pytestmark = pytest.mark.usefixtures("variant")``.
    """
    name = getattr(request, "param", DEFAULT_VARIANT).replace("llvm", BACKEND)
    if mi.variant() not in (None, name):
        _clean_up()
    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Warn)
    yield name


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of our scene files."""
    return ROOT / "scenes"


@pytest.fixture(scope="module", autouse=True)
def clean_up_after_module() -> Iterator[None]:
    """Frees kernels and memory, so that a long run stays as small as a short one."""
    yield
    if mi.variant() is not None:
        _clean_up()


def _clean_up() -> None:
    gc.collect()
    dr.sync_thread()
    # Recordings hold kernels
    forget_recordings()
    dr.flush_kernel_cache()
    dr.flush_malloc_cache()


@pytest.fixture
def batches_of_sixteen_samples(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Per pixel of the scenes of :func:`make_scene`, in long renders, also where they learn."""
    from mitsuba_ext.long_renders.integrator_batches import IntegratorBatches
    from mitsuba_ext.rendering import seed_passes

    for table in (seed_passes._PASS_SAMPLES, IntegratorBatches.batch_samples):
        monkeypatch.setitem(table, dr.backend_v(mi.Float), 48 * 16)
    monkeypatch.setattr(IntegratorBatches, "learning_spp", 16)


# ---- Comparisons ----


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """A clock that only the integrators under test move."""
    clock = Clock()
    monkeypatch.setattr(timing, "time", clock)
    return clock


# ---- The command line ----


@pytest.fixture
def make_scene(tmp_path):
    def make(name="scene.xml", integrator=PATH, film="", body=SPHERE) -> Path:
        path = tmp_path / name
        path.write_text(SCENE.format(integrator=integrator, film=film, body=body))
        return path

    return make


@pytest.fixture
def run(capsys):
    """Runs the command in this process; returns the exit code, stdout and stderr."""

    def command(*arguments) -> tuple[int, str, str]:
        code = cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return command


@pytest.fixture(autouse=True)
def kernels_are_cached(monkeypatch):
    """Makes ``render`` print nothing about compiled kernels, which depend on earlier tests."""
    monkeypatch.setattr(image_render, "kernels_compiled", lambda: 0)


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparisons write no HTML report, which takes longer than a small comparison."""
    monkeypatch.setattr("mitsuba_ext.compare.comparison.write_report", lambda _folder: None)
