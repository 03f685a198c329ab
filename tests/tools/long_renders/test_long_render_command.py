"""``mitsuba-ext render --checkpoint`` and ``merge``: signals, full disks, processes that die."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import load_reference, read_exr
from mitsuba_ext.images import image_files
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer
from mitsuba_ext.long_renders.folder import CheckpointFolder
from mitsuba_ext.long_renders.intervals import Interval
from mitsuba_ext.util.errors import InputError
from tests.support.command_line import PATH, in_subprocess

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")


def test_more_samples_later_and_merged(run, make_scene, tmp_path):
    scene = make_scene()
    for seed in (1, 2):
        command = ("render", scene, "-o", tmp_path / f"{seed}.exr", "--seed", seed,
                   "--checkpoint", tmp_path / str(seed))  # fmt: skip
        assert "32 spp" in run(*command, "--spp", 32)[1]
        assert "48 spp" in run(*command, "--add", 16)[1]
        assert "48 spp" in run(*command, "--spp", 48)[1]  # nothing is left to do
    code, out, _ = run("merge", tmp_path / "1", tmp_path / "2", "-o", tmp_path / "both")
    assert code == 0 and "96 spp in 6 batches" in out
    command = ("render", scene, "-o", tmp_path / "both.exr", "--seed", 1,
               "--checkpoint", tmp_path / "both")  # fmt: skip
    assert run(*command, "--spp", 96)[0] == 0
    images = {name: read_exr(tmp_path / f"{name}.exr")[0] for name in ("1", "2", "both")}
    mean = (images["1"]["R"] + images["2"]["R"]) / 2
    np.testing.assert_allclose(images["both"]["R"], mean, rtol=1e-5)
    metadata = read_exr(tmp_path / "both.exr")[1]
    assert json.loads(metadata["seeds"]) == [1, 2]
    assert json.loads(metadata["statistics"])["rays"] == {"camera": 48 * 96}
    state = CheckpointFolder(tmp_path / "both").load()
    np.testing.assert_allclose(images["both"]["variance.R"], state.images.variance[..., 0])
    reference = load_reference(tmp_path / "both.exr")
    assert reference.spp == 96 and 0 < reference.noise < 1
    # New samples have seeds of their own
    assert run(*command, "--add", 16)[0] == 0
    kept = CheckpointFolder(tmp_path / "both").load().done
    assert len(set(b[:2] for b in kept)) == len(kept) == 7

    assert "both have samples of seed 1" in run(
        "merge", tmp_path / "1", tmp_path / "both", "-o", tmp_path / "c")[2]  # fmt: skip
    assert "exists already" in run("merge", tmp_path / "1", tmp_path / "2", "-o", tmp_path)[2]
    assert "no render is kept here" in run(
        "merge", tmp_path / "1", tmp_path, "-o", tmp_path / "c")[2]  # fmt: skip
    make_scene(integrator=PATH.replace("3", "2"))
    other = ("--seed", 3, "--spp", 16, "--checkpoint", tmp_path / "3")
    assert run("render", scene, "-o", tmp_path / "3.exr", *other)[0] == 0
    assert '"scene files" differs' in run(
        "merge", tmp_path / "1", tmp_path / "3", "-o", tmp_path / "c")[2]  # fmt: skip


def test_a_render_says_what_its_folder_holds(run, make_scene, tmp_path):
    kept = tmp_path / "kept"
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--checkpoint", kept, "--spp")
    assert "continued" not in run(*command, 16)[2]
    assert f"{kept}: continued from 16 samples per pixel\n" == run(*command, 32)[2]
    assert "holds all 32 samples" in run(*command, 32)[2]
    code, out, err = run(*command, 8)
    assert code == 0 and "warning" in err and "already holds 32 samples per pixel" in err
    assert "32 spp" in out
    *_, warning, end = map(json.loads, run(*command, 8, "--json")[1].splitlines())
    assert "not 8" in warning["text"] and end["spp"] == 32


def test_a_merged_folder_is_whole_or_not_there(run, make_scene, tmp_path, monkeypatch):
    scene, kept = make_scene(), [tmp_path / "a", tmp_path / "b"]
    for seed, folder in enumerate(kept):
        assert run("render", scene, "-o", tmp_path / "a.exr", "--checkpoint", folder,
                   "--seed", seed)[0] == 0  # fmt: skip

    def full(self, state):
        raise OSError(errno.ENOSPC, "No space left on device")

    before = sorted(tmp_path.iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(CheckpointFolder, "save", full)
        code, _, err = run("merge", *kept, "-o", tmp_path / "c")
    assert code == 2 and "c: cannot be written (No space left on device)" in err
    assert sorted(tmp_path.iterdir()) == before
    assert run("merge", *kept, "-o", tmp_path / "new" / "c")[0] == 0
    assert sorted(f.name for f in (tmp_path / "new").rglob("*")) == [
        "c", "render.json", "state.npz"]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), [
    (("--add", 3), "--add needs --checkpoint"),
    (("--checkpoint", "a", "--add", 3, "--spp", 4), "--add and --spp cannot be combined"),
    (("--checkpoint", "a", "--every", "5"), "expected something like 60s"),
    (("--until", 0), "0"),
])  # fmt: skip
def test_wrong_options_are_named(run, make_scene, tmp_path, arguments, words):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", *arguments)
    assert code == 2 and words in err


def test_intervals():
    assert Interval.parse("1.5m") == Interval(seconds=90) and Interval.parse("2h").seconds == 7200
    assert Interval.parse("100spp") == Interval(spp=100)
    for text in ("", "0s", "5", "1.5spp", "-3s", "s"):
        with pytest.raises(ValueError, match="expected something like"):
            Interval.parse(text)


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
    """And nothing is left there."""
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
    """As when a scheduler is gone, or three workers have died of the same batch."""
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


@pytest.mark.parametrize("specification", ["neepp:timeout=9", "variance:in=[neepp:timeout=9]"])
def test_a_time_limit_of_batches_is_refused(run, make_scene, tmp_path, specification):
    """Their numbers of samples would be wrong."""
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", specification)
    code, _, err = run(*command, "--until", "1")
    assert code == 2 and '"timeout" would cut short each of the batches' in err
    assert "limit the whole render by --time" in err and not (tmp_path / "a.exr").exists()


def test_variants_without_batches_are_named(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--until", 0.1,
                       "--variant", "scalar_rgb")  # fmt: skip
    assert code == 2 and 'a variant such as "llvm_ad_rgb"' in err


def test_a_signal_keeps_the_render_and_goes_on(run, make_scene, tmp_path, monkeypatch):
    render, seen = BatchRenderer.render, []

    def signalled(self, batch, learned):
        if batch.index == 1:
            os.kill(os.getpid(), signal.SIGUSR1)
        if batch.index == 2:
            seen.append((CheckpointFolder(tmp_path / "kept").load().spp,
                         read_exr(tmp_path / "a.exr")[1]["spp"]))  # fmt: skip
        return render(self, batch, learned)

    # It may come at any time, and would end the process by default
    describe, write = CheckpointFolder.describe, image_files.write_film

    def before(*arguments):
        os.kill(os.getpid(), signal.SIGUSR1)
        describe(*arguments)

    def after(*arguments, **options):
        os.kill(os.getpid(), signal.SIGUSR1)
        write(*arguments, **options)

    monkeypatch.setattr(CheckpointFolder, "describe", before)
    monkeypatch.setattr(image_files, "write_film", after)
    monkeypatch.setattr(BatchRenderer, "render", signalled)
    code, out, _ = run("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 64,
                       "--checkpoint", tmp_path / "kept")  # fmt: skip
    assert code == 0 and "64 spp" in out and seen == [(32, 32)]


@pytest.mark.parametrize("is_kept", [True, False])
def test_a_preview_shows_the_render_while_it_grows(
    run, make_scene, tmp_path, monkeypatch, is_kept
):
    render, seen = BatchRenderer.render, []
    output, preview = tmp_path / "a.exr", tmp_path / "look.png"

    def watched(self, batch, *rest):
        shown = preview.read_bytes() if preview.exists() else None
        seen.append((read_exr(output)[1]["spp"] if output.exists() else 0, shown))
        return render(self, batch, *rest)

    monkeypatch.setattr(BatchRenderer, "render", watched)
    kept = ("--checkpoint", tmp_path / "kept") if is_kept else ()
    command = ("render", make_scene(), "-o", output, "--spp", 64, "--every", "32spp", *kept)
    assert run(*command, "--preview", preview)[0] == 0
    # After the first batch, then after 32 more; at the end
    assert [spp for spp, _ in seen] == ([0, 16, 16, 48] if is_kept else [0] * 4)
    looks = [shown for _, shown in seen]
    assert looks[0] is None and looks[1] == looks[2] != looks[3]
    # It has the sRGB curve, without exposure, dithered
    image, linear = np.array(mi.Bitmap(str(preview))), read_exr(output)[0]["G"].astype(float)
    curve = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(image[..., 1] - 255 * np.clip(curve, 0, 1)).max() <= 1.01
    code, _, err = run(*command, "--preview", output)
    assert code == 2 and "--preview must differ" in err


@pytest.mark.parametrize("integrator", ["path", "composed_path"])
def test_ctrl_c_keeps_the_render_and_ends(run, make_scene, tmp_path, monkeypatch, integrator):
    render = BatchRenderer.render

    def signalled(self, batch, learned):
        if batch.index == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return render(self, batch, learned)

    monkeypatch.setattr(BatchRenderer, "render", signalled)
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", integrator,
               "--checkpoint", tmp_path / "kept")  # fmt: skip
    code, _, err = run(*command, "--spp", 64)
    spp = CheckpointFolder(tmp_path / "kept").load().spp
    assert code == 143 and f"interrupted after {spp} of 64 spp" in err and 32 <= spp <= 48
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == spp
    monkeypatch.setattr(BatchRenderer, "render", render)
    assert run(*command, "--spp", 64)[0] == 0


def test_another_render_is_refused(run, make_scene, tmp_path):
    scene, kept = make_scene(), tmp_path / "kept"
    command = ("render", scene, "-o", tmp_path / "a.exr", "--spp", 16, "--checkpoint", kept)
    assert run(*command)[0] == 0
    for change, words in (
        (("--seed", 1), '"seed" differs (0 there, 1 here)'),
        (("--integrator", "path:max_depth=2"), '"parameters" differs'),
        (("--integrator", "neepp"), '"integrator" differs (path there, neepp here)'),
        (("--size", "4x4"), '"size" differs (8x6 there, 4x4 here)'),
    ):
        code, _, err = run(*command, *change)
        assert code == 2 and words in err, err
    make_scene(integrator=PATH.replace("3", "4"))
    assert '"scene files" differs (scene.xml has changed)' in run(*command)[2]
    # The same file by another name
    make_scene()
    assert run("render", os.path.relpath(scene), *command[2:])[0] == 0


def test_a_changed_file_is_named(run, make_scene, tmp_path):
    """Of a scene with an included file, a mesh and a texture."""
    (tmp_path / "parts.xml").write_text(
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="mesh.ply"/>'
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        '<string name="filename" value="wood.png"/></texture></bsdf></shape></scene>'
    )
    rectangle = mi.load_dict({"type": "rectangle"})
    mesh = mi.Mesh("", 4, 2, has_vertex_texcoords=True)
    values = mi.traverse(mesh)
    values["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]
    values["vertex_texcoords"] = [0, 0, 1, 0, 1, 1, 0, 1]
    values["faces"] = [0, 1, 2, 2, 3, 0]
    values.update()
    assert rectangle.bbox() == mesh.bbox()
    mesh.write_ply(str(tmp_path / "mesh.ply"))
    mi.Bitmap(np.full((2, 2, 3), 100, np.uint8)).write(str(tmp_path / "wood.png"))
    body = '<default name="file" value="parts.xml"/><include filename="$file"/>'
    command = ("render", make_scene(body=body), "-o", tmp_path / "a.exr", "--spp", 1,
               "--checkpoint", tmp_path / "kept")  # fmt: skip
    assert run(*command)[0] == 0

    def refused(name: str, content: bytes) -> None:
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content)
        code, _, err = run(*command)
        assert code == 2 and f'"scene files" differs ({name} has changed)' in err, err
        (tmp_path / name).write_bytes(whole)

    refused("parts.xml", (tmp_path / "parts.xml").read_bytes() + b" ")
    values["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 2, 0]
    values.update()
    mesh.write_ply(str(tmp_path / "other.ply"))
    refused("mesh.ply", (tmp_path / "other.ply").read_bytes())
    mi.Bitmap(np.full((2, 2, 3), 101, np.uint8)).write(str(tmp_path / "other.png"))
    refused("wood.png", (tmp_path / "other.png").read_bytes())
    err = run(*command, "-D", "file=./parts.xml")[2]
    assert '"scene parameters" differs (file: None there, ./parts.xml here)' in err
    assert run(*command)[0] == 0


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
