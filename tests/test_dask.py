"""``mitsuba-ext render --dask``: the workers of a cluster, here processes of this machine."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import in_subprocess

from mitsuba_ext.compare import InputError, read_exr
from mitsuba_ext.long_renders import dask_cluster

pytestmark = pytest.mark.usefixtures("variant")


def test_without_dask_one_sentence_says_what_to_install(run, make_scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = run(
        "render", make_scene(), "-o", tmp_path / "a.exr", "--dask", "tcp://127.0.0.1:1")
    assert code == 2 and "pip install 'mitsuba_ext[dask]'" in err and err.count("\n") == 1


def test_who_renders_is_said_once(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr",
                       "--dask", "tcp://127.0.0.1:1", "--workers", 2)  # fmt: skip
    assert code == 2 and "--workers and --dask exclude each other" in err


# ---- A cluster ----


@contextlib.contextmanager
def _cluster(folder: Path, count: int) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A scheduler and workers of one thread; its address, and the processes of the workers."""
    import json

    file, processes = folder / "scheduler.json", []

    def start(kind: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard",
                   "--scheduler-file", str(file), *options]  # fmt: skip
        # Not this folder: files must be found from anywhere
        root = str(Path(__file__).parents[1])
        environment = {**os.environ, "PYTHONPATH": root}
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stderr=subprocess.DEVNULL)
        processes.append(process)
        return process

    try:
        start("scheduler", "--host", "127.0.0.1", "--port", "0")
        workers = [start("worker", "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1")
                   for _ in range(count)]  # fmt: skip
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], workers
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


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(dask_cluster, "_PATIENCE", 1)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        with dask_cluster.dask_cluster("tcp://127.0.0.1:1"):
            pass
