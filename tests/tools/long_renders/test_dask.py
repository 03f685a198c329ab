"""``mitsuba-ext render --dask``: the workers of a cluster, here processes of this machine."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext.compare import InputError, read_exr
from mitsuba_ext.long_renders import dask_cluster
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.dispatch import Dispatch
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import RenderState
from tests.support.command_line import in_subprocess
from tests.support.paths import ROOT

pytestmark = pytest.mark.usefixtures("variant")


def test_without_dask_one_sentence_says_what_to_install(run, make_scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = run(
        "render", make_scene(), "-o", tmp_path / "a.exr", "--dask", "tcp://127.0.0.1:1")
    assert code == 2 and "pip install 'mitsuba_ext[dask]'" in err and err.count("\n") == 1


def test_workers_and_dask_exclude_each_other(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr",
                       "--dask", "tcp://127.0.0.1:1", "--workers", 2)  # fmt: skip
    assert code == 2 and "--workers and --dask cannot be combined" in err


# ---- A cluster ----


class Processes(list):
    """The processes of the workers, and the process of their scheduler."""

    def __init__(self, workers: list[subprocess.Popen], scheduler: subprocess.Popen) -> None:
        super().__init__(workers)
        self.scheduler = scheduler


@contextlib.contextmanager
def _cluster(folder: Path, count: int) -> Iterator[tuple[str, Processes]]:
    """A scheduler and workers of one thread; its address, and the processes of the workers."""
    import json

    pytest.importorskip("distributed")
    file, processes = folder / "scheduler.json", []

    def start(kind: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard",
                   "--scheduler-file", str(file), *options]  # fmt: skip
        # Not this folder: files must be found from anywhere
        root = str(ROOT)
        environment = {**os.environ, "PYTHONPATH": root}
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stderr=subprocess.DEVNULL)
        processes.append(process)
        return process

    try:
        scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0")
        workers = [start("worker", "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1")
                   for _ in range(count)]  # fmt: skip
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], Processes(workers, scheduler)
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_cluster_divides_a_render_and_one_of_its_workers_is_killed(make_scene, tmp_path):
    distributed = pytest.importorskip("distributed")
    scene = make_scene()
    command = ["render", scene, "--spp", 4096, "--size", "64x64"]
    assert in_subprocess(*command, "-o", tmp_path / "one.exr", "--until", "1e-9").returncode == 0
    with _cluster(tmp_path, 2) as (address, workers):
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            process = subprocess.Popen(
                [sys.executable, "-m", "mitsuba_ext", *map(str, command),
                 "-o", str(tmp_path / "two.exr"), "--dask", address],
                stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
            # Each of them has begun
            while process.poll() is None and not all(client.processing().values()):
                time.sleep(0.05)
            time.sleep(0.5)
            assert process.poll() is None and all(client.processing().values())
            workers[0].kill()
            _, err = process.communicate(timeout=120)
            assert process.returncode == 0, err
            assert len(client.scheduler_info()["workers"]) == 1
    one, two = (read_exr(tmp_path / f"{name}.exr") for name in ("one", "two"))
    assert one[1]["spp"] == two[1]["spp"] == 4096
    np.testing.assert_allclose(one[0]["R"], two[0]["R"], rtol=1e-4)


def _rendered(request: RenderRequest, spp: int, address: str = "", progress=lambda render: None):
    render = LongRender(BatchRenderer(request), RenderState(), progress)
    if not address:
        assert render.run(Goal(spp))
        return render.state
    with dask_cluster.dask_cluster(address) as (executor, check):

        def is_stopped() -> bool:
            check()
            return False

        assert render.run(Goal(spp), is_stopped, executor, executor.count)
    return render.state


@pytest.mark.slow
@pytest.mark.parametrize("specification", ["neepp", "pss_guided"])
def test_workers_without_the_files_render_with_the_state_learned_once(
    specification, scenes, tmp_path, monkeypatch
):
    """The scene is named by a path that is another one in each process."""
    home, foreign = tmp_path / "home", tmp_path / "foreign"
    for folder in (home, foreign):
        folder.mkdir()
    (home / "box.xml").write_text((scenes / "cornell_box.xml").read_text())
    (home / "scene.xml").write_text('<scene version="3.0.0"><include filename="box.xml"/></scene>')
    monkeypatch.chdir(home)
    request = RenderRequest("/proc/self/cwd/scene.xml", (64, 48), (), specification)
    with _cluster(foreign, 2) as (address, _):
        learned = []
        state = _rendered(
            request, 4096, address, lambda render: learned.append(render.state.learned))
    assert learned[0] and set(learned) == {learned[0]}
    here = _rendered(request, 4096)
    assert sorted(state.done) == here.done and len(here.done) >= 3
    ours, its = (each.images.mean[..., :3].mean() for each in (state, here))
    # Which path is sampled may depend on the last bit of what was learned
    error = (state.images.variance[..., :3].sum() ** 0.5) / state.images.mean[..., :3].size
    assert abs(ours - its) < 4 * error
    assert not list(foreign.rglob("*.xml"))


@pytest.mark.slow
def test_a_worker_that_hangs_costs_its_batches_only(make_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Dispatch, "min_late", 5.0)
    request = RenderRequest(str(make_scene()), (64, 64))
    hanging = []
    with _cluster(tmp_path, 2) as (address, workers):

        def hang(render) -> None:
            if len(render.state.done) == 3:
                hanging.append(workers[0].pid)
                os.kill(workers[0].pid, signal.SIGSTOP)

        try:
            state = _rendered(request, 4096, address, hang)
        finally:
            os.kill(workers[0].pid, signal.SIGCONT)
    here = _rendered(request, 4096)
    assert hanging and sorted(state.done) == here.done
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_scheduler_that_ends_is_named_in_a_sentence(make_scene, tmp_path, number):
    """Without tracebacks of Dask; the image so far is written."""
    preview = tmp_path / "a.png"
    with _cluster(tmp_path, 1) as (address, workers):
        process = subprocess.Popen(
            [sys.executable, "-m", "mitsuba_ext", "render", str(make_scene()), "--spp", "1000000",
             "-o", str(tmp_path / "a.exr"), "--preview", str(preview), "--dask", address],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        while process.poll() is None and not preview.exists():
            time.sleep(0.05)
        workers.scheduler.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "Traceback" not in err and "distributed" not in err, err
    assert err.endswith(f"mitsuba-ext: {address}: the Dask scheduler is gone\n")
    assert (tmp_path / "a.exr").exists()


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_named():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        with dask_cluster.dask_cluster("tcp://127.0.0.1:1", timeout=1):
            pass
