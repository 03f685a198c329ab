"""``mitsuba-ext render --checkpoint`` on full disks, and with processes that die."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext.compare import read_exr
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer
from mitsuba_ext.long_renders.folder import CheckpointFolder
from mitsuba_ext.util.errors import InputError
from tests.support.command_line import in_subprocess

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")


def test_a_full_disk_costs_an_interval_at_most(run, make_scene, tmp_path, monkeypatch):
    """The render goes on, and what was kept before is still there."""
    savez, calls = np.savez, []

    def full(*arguments, **arrays):
        calls.append(1)
        if len(calls) in (2, 3, 5):
            raise OSError(28, "No space left on device")
        savez(*arguments, **arrays)

    monkeypatch.setattr(np, "savez", full)
    kept, spps = tmp_path / "kept", []
    save = CheckpointFolder.save

    def watched(self, state):
        try:
            save(self, state)
        finally:
            spps.append(self.load().spp)

    monkeypatch.setattr(CheckpointFolder, "save", watched)
    code, out, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 64,
                         "--checkpoint", kept, "--every", "16spp")  # fmt: skip
    assert code == 2 and err.count("No space left") == 3 and "64 spp" in out
    assert spps == [16, 16, 16, 64, 64] and not list(kept.glob(".state*"))
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == 64


def test_a_full_file_system_keeps_the_state_before(run, make_scene, tmp_path):
    """One that holds a state, but not a second one beside it."""
    full = tmp_path / "full"
    full.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(full)]
    try:
        if subprocess.run(mount, capture_output=True).returncode:
            pytest.skip("no file system can be made here")
    except FileNotFoundError:
        pytest.skip("there is no mount")
    try:
        kept = CheckpointFolder(full / "kept")
        command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--size", "64x48",
                   "--checkpoint", kept.path, "--spp")  # fmt: skip
        assert run(*command, 16)[0] == 0 and kept.load().spp == 16
        code, _, err = run(*command, 32)
        assert code == 2 and "could not be saved: [Errno 28] No space left on device: " in err
        assert str(kept.path / "state.npz") in err
        assert read_exr(tmp_path / "a.exr")[1]["spp"] == 32 and kept.load().spp == 16
        subprocess.run(["mount", "-o", "remount,size=5m", str(full)], check=True)
        assert run(*command, 32)[0] == 0 and kept.load().spp == 32
    finally:
        subprocess.run(["umount", str(full)], check=True)


@pytest.mark.parametrize("arguments", [
    ("-o", "full/a.exr"), ("-o", "full/a.png"), ("-o", "a.exr", "--checkpoint", "full/kept"),
], ids=str)  # fmt: skip
def test_a_full_disk_is_named_before_the_render(run, make_scene, tmp_path, arguments, monkeypatch):
    """No file is left there."""
    full = tmp_path / "full"
    full.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(full)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no file system can be made here")
    try:
        with contextlib.suppress(OSError):
            (full / "data").write_bytes(bytes(1 << 16))
        monkeypatch.chdir(tmp_path)
        code, _, err = run("render", make_scene(), *arguments)
        name = arguments[-1] if "kept" not in arguments[-1] else "full/kept/.lock"
        assert code == 2 and f"{name}: cannot be written (No space left on device)" in err
        assert sorted(f.name for f in full.rglob("*") if f.is_file()) == ["data"]
    finally:
        subprocess.run(["umount", str(full)], check=True)


def test_a_folder_that_is_deleted_costs_the_folder_only(run, make_scene, tmp_path, monkeypatch):
    render, kept = BatchRenderer.render, tmp_path / "kept"

    def deleted(self, batch, learned):
        if batch.index == 2:
            shutil.rmtree(kept)
        return render(self, batch, learned)

    monkeypatch.setattr(BatchRenderer, "render", deleted)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 64,
                       "--checkpoint", kept, "--every", "16spp")  # fmt: skip
    assert code == 2 and "the render could not be saved: [Errno 2] No such file" in err
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == 64 and not kept.exists()


@pytest.mark.parametrize("is_kept", [True, False])
def test_a_failure_keeps_the_image_so_far(run, make_scene, tmp_path, monkeypatch, is_kept):
    """Such failures are a lost scheduler, or a batch of which three workers have died."""
    render, kept = BatchRenderer.render, tmp_path / "kept"

    def fails(self, batch, learned):
        if batch.index == 2:
            raise InputError("the cluster is gone")
        return render(self, batch, learned)

    monkeypatch.setattr(BatchRenderer, "render", fails)
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 64, "--preview",
               tmp_path / "b.png", *(("--checkpoint", kept) if is_kept else ()))  # fmt: skip
    code, _, err = run(*command)
    assert code == 2 and "interrupted after 32 of 64 spp" in err
    assert err.endswith("mitsuba-ext: the cluster is gone\n")
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == 32
    assert not is_kept or CheckpointFolder(kept).load().spp == 32


# ---- Processes ----


@pytest.mark.slow
def test_processes_divide_a_render_and_one_of_them_is_killed(make_scene, tmp_path):
    scene = make_scene()
    command = ["render", scene, "--spp", 4096, "--size", "32x32"]
    assert in_subprocess(*command, "-o", tmp_path / "one.exr", "--until", "1e-9").returncode == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "mitsuba_ext", *map(str, command), "-o", tmp_path / "two.exr",
         "--workers", "2"], stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    killed = False
    while process.poll() is None:
        workers = _children(process.pid)
        if not killed and len(workers) >= 2:
            time.sleep(1)
            os.kill(workers[-1], signal.SIGKILL)
            killed = True
        time.sleep(0.1)
    assert killed and process.returncode == 0, process.stderr.read()
    one, two = (read_exr(tmp_path / f"{name}.exr") for name in ("one", "two"))
    assert one[1]["spp"] == two[1]["spp"] == 4096
    np.testing.assert_allclose(one[0]["R"], two[0]["R"], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_render_that_is_killed_many_times_loses_no_interval(make_scene, tmp_path):
    scene, kept = make_scene(), CheckpointFolder(tmp_path / "kept")
    command = [sys.executable, "-m", "mitsuba_ext", *map(str, (
        "render", scene, "-o", tmp_path / "a.exr", "--spp", 1 << 20, "--size", "64x64",
        "--checkpoint", kept.path, "--every", "16spp",
    ))]  # fmt: skip
    before, rng = 0, random.Random(1)
    for _ in range(20):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while kept.load().spp <= before and time.monotonic() < deadline:
            time.sleep(rng.random() * 0.3)
        process.kill()
        process.wait()
        assert kept.load().spp > before
        before = kept.load().spp
    state = kept.load()
    assert sum(b.spp for b in state.done) == state.spp
    assert [b.index for b in state.done] == list(range(len(state.done)))
    other = tmp_path / "b.exr"
    assert in_subprocess("render", scene, "-o", other, "--spp", state.spp, "--size", "64x64",
                         "--seed", 5).returncode == 0  # fmt: skip
    assert abs(read_exr(other)[0]["R"].mean() / state.images.mean[..., 0].mean() - 1) < 0.01


def _children(process: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == process and b"spawn_main" in (path.parent / "cmdline").read_bytes():
            found.append(int(path.parent.name))
    return found
