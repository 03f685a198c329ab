"""``mitsuba-ext render --checkpoint``: renders that are kept, gone on with, merged and divided."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import PATH, in_subprocess

from mitsuba_ext.cli.common import Interval
from mitsuba_ext.compare import InputError, load_reference, metrics, read_exr
from mitsuba_ext.long_renders import batch_renderer, long_render
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.folder import CheckpointFolder
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import Batch, RenderState
from mitsuba_ext.rendering import batches, seed_passes
from mitsuba_ext.rendering.batches import Batches

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(autouse=True)
def batches_of_sixteen_samples(variant, monkeypatch):
    """Per pixel of the scene of these tests."""
    for table in (seed_passes._PASS_SAMPLES, batch_renderer._SAMPLES):
        monkeypatch.setitem(table, dr.JitBackend.LLVM, 48 * 16)


@pytest.fixture
def request_of(make_scene):
    def make(specification: str | None = None, **options) -> RenderRequest:
        return RenderRequest(str(make_scene()), specification=specification, **options)

    return make


def rendered(request: RenderRequest, state: RenderState | None = None, spp: int = 64, **options):
    renderer = BatchRenderer(request)
    render = LongRender(renderer, request, state or RenderState())
    render.run(Goal(spp), **options)
    return render.state


def image(state: RenderState) -> np.ndarray:
    contents = state.film.contents
    return contents[..., :3] / (contents[..., 3:4] if state.film.has_weights else state.spp)


# ---- Sums ----


def test_batches_count_by_their_samples():
    """Mean and variance are those of all samples, however they are divided into batches."""
    rng = np.random.default_rng(1)
    sizes = [1, 4, 2, 9, 3, 1, 7, 5]
    found = []
    for _ in range(500):
        batches, parts = Batches(["Y"], 1), [Batches(["Y"], 1), Batches(["Y"], 1)]
        for number, size in enumerate(sizes):
            value = np.full((1, 1, 1), rng.normal(3, 2, size).mean())
            batches.add(value, size)
            parts[number % 2].add(value, size)
        both = parts[0].plus(parts[1])
        np.testing.assert_allclose(both.mean, batches.mean)
        np.testing.assert_allclose(both.variance, batches.variance)
        found.append((batches.mean.item(), batches.variance.item()))
    means, variances = np.transpose(found)
    assert abs(means.mean() - 3) < 5 * means.std() / 500**0.5
    assert abs(variances.mean() - 4 / sum(sizes)) < 5 * variances.std() / 500**0.5


@pytest.mark.parametrize("specification", ["path", "neepp", "ptracer", "composed_path"])
def test_a_render_that_goes_on_is_the_one_that_was_not_stopped(
    specification, request_of, tmp_path
):
    request = request_of(specification)
    whole = rendered(request)
    folder = CheckpointFolder(tmp_path / "kept")
    for most in (1, 3, 9):
        state = folder.load()

        def is_stopped(state=state, most=most) -> bool:
            return len(state.done) >= most

        rendered(request, state, is_stopped=is_stopped)
        with folder.in_use():
            folder.save(state)
    state = folder.load()
    assert state.done == whole.done == [Batch(0, index, 16) for index in range(4)]
    for ours, its in ((image(state), image(whole)), (state.images.mean, whole.images.mean),
                      (state.images.variance, whole.images.variance)):  # fmt: skip
        np.testing.assert_allclose(ours, its, rtol=1e-4, atol=1e-7)


def test_the_image_is_that_of_all_samples(request_of):
    """Also with a filter that is wider than a pixel, as one film of all batches would have it."""
    state = rendered(request_of("path"))
    film = mi.load_dict({"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}})
    state.fill(film)
    np.testing.assert_allclose(np.array(film.develop()), state.images.mean, rtol=1e-5)


def test_who_renders_does_not_matter(request_of):
    """Batches that come back late, or fail twice."""
    request = request_of("path")
    here = rendered(request, spp=96)

    class Unreliable(Executor):
        tries: dict[Batch, int] = {}

        def submit(self, function, *arguments):
            batch = arguments[1]
            self.tries[batch] = self.tries.get(batch, 0) + 1
            future = Future()
            if batch.index % 3 == 1 and self.tries[batch] < long_render._TRIES:
                future.set_exception(OSError("the worker has died"))
            else:
                future.set_result(function(*arguments))
            return future

    state = rendered(request, spp=96, executor=Unreliable(), workers=2)
    assert state.done == here.done
    np.testing.assert_array_equal(state.images.mean, here.images.mean)

    class Broken(Executor):
        def submit(self, function, *arguments):
            future = Future()
            future.set_exception(OSError("the worker has died"))
            return future

    with pytest.raises(InputError, match="3 times: the worker has died"):
        rendered(request, executor=Broken())


def test_it_ends_when_the_error_is_small_enough(request_of):
    """The error that batches announce is that of the image."""
    request = request_of("path")
    render = LongRender(BatchRenderer(request), request, RenderState())
    assert render.run(Goal(error=4e-3))
    assert 8 * 16 <= render.state.spp < 1 << 12 and render.error <= 4e-3
    truth = rendered(request_of("path", seed=7), spp=1 << 13)
    squares = [
        metrics.relative_mse(
            image(rendered(request_of("path", seed=seed), spp=render.state.spp)), image(truth)
        )
        for seed in range(10, 18)
    ]
    assert 0.7 < np.mean(squares) / render.error < 1.4
    assert not render.run(Goal(error=1e-9), is_stopped=lambda: True)
    assert render.run(Goal(spp=render.state.spp, error=1e-9))


def test_the_first_batches_tell_how_many_fit_into_the_time(request_of, monkeypatch):
    class Clock:
        now = 0.0

        def perf_counter(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(long_render, "time", clock)

    batch, request = BatchRenderer.render, request_of("path")

    def timed(self, which):
        # The first one compiles, and those after the fifth are slow
        clock.now += 5 if which.index == 0 else 1 if which.index < 5 else 3
        return batch(self, which)

    monkeypatch.setattr(BatchRenderer, "render", timed)
    render = LongRender(BatchRenderer(request), request, RenderState())
    assert render.run(Goal(seconds=15))
    assert len(render.state.done) == 11


# ---- The folder ----


def test_a_damaged_state_is_replaced_by_the_one_before(request_of, tmp_path):
    folder = CheckpointFolder(tmp_path / "kept")
    request = request_of("path")
    with folder.in_use():
        folder.save(rendered(request, spp=16))
        folder.save(rendered(request, spp=32))
    newest = tmp_path / "kept" / "state.npz"
    whole = newest.read_bytes()
    for damage in (whole[: len(whole) // 2], whole[:5000] + b"?" + whole[5001:], b""):
        newest.write_bytes(damage)
        assert folder.load().spp == 16
    newest.unlink()  # killed between the two steps
    assert folder.load().spp == 16
    (tmp_path / "kept" / "state.before.npz").write_bytes(b"?")
    with pytest.raises(InputError, match="is damaged: delete"):
        folder.load()


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
    assert '"scene files" differs (its files or code have changed)' in run(*command)[2]
    # The same file by another name
    make_scene()
    assert run("render", os.path.relpath(scene), *command[2:])[0] == 0


def test_two_processes_cannot_use_a_folder(request_of, tmp_path):
    folder = CheckpointFolder(tmp_path / "kept")
    with folder.in_use(), pytest.raises(InputError, match="another process uses this folder"):
        with folder.in_use():
            pass


def test_what_is_learned_is_learned_once(run, make_scene, scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(batch_renderer, "_LEARNING_SPP", 16)
    scene, kept = scenes / "cornell_box.xml", tmp_path / "kept"
    learner = "composed_path:max_depth=3,next_event=contribution"
    command = ("render", scene, "-o", tmp_path / "a.exr", "--size", "8x6",
               "--integrator", learner, "--checkpoint", kept)  # fmt: skip
    seen = []
    render = BatchRenderer.render

    def watched(self, batch):
        integrator = self.chosen.named.integrator
        result = render(self, batch)
        seen.append((bool(integrator.save_learned), bool(integrator.load_learned)))
        return result

    monkeypatch.setattr(BatchRenderer, "render", watched)
    assert run(*command, "--spp", 48)[0] == 0
    assert run(*command, "--add", 16)[0] == 0
    assert seen == [(True, False)] + [(False, True)] * 3
    assert not list(kept.glob("*.part"))
    # Killed before the first batch was kept: what it has learned depends on its numbers
    for name in ("state.npz", "state.before.npz"):
        (kept / name).unlink(missing_ok=True)
    assert run(*command, "--spp", 16)[0] == 0
    assert seen[4:] == [(True, False)]


def test_a_batch_that_was_interrupted_has_taught_nothing(request_of, scenes, tmp_path, monkeypatch):
    """A second try has the same numbers, on which what was learned depends."""
    learner = "composed_path:max_depth=3,next_event=contribution"
    learned = tmp_path / "learned.npz"
    scene = str(scenes / "cornell_box.xml")
    renderer = BatchRenderer(RenderRequest(scene, (8, 6), (), learner, learned=str(learned)))

    def dies(*_arguments):
        assert list(tmp_path.glob("*.part")), "nothing was learned"
        raise KeyboardInterrupt

    monkeypatch.setattr(batches, "_complete", dies)
    with pytest.raises(KeyboardInterrupt):
        renderer.render(Batch(0, 0, 64))
    assert renderer.must_learn
    monkeypatch.undo()
    assert renderer.render(Batch(0, 0, 64)).has_taught and not renderer.must_learn


# ---- The command ----


def test_more_samples_later_and_merged(run, make_scene, tmp_path):
    scene = make_scene()
    for seed in (1, 2):
        command = ("render", scene, "-o", tmp_path / f"{seed}.exr", "--seed", seed,
                   "--checkpoint", tmp_path / str(seed))  # fmt: skip
        assert "32 spp" in run(*command, "--spp", 32)[1]
        assert "48 spp" in run(*command, "--add", 16)[1]
        assert "48 spp in 0.0 s" in run(*command, "--spp", 48)[1]
    code, out, _ = run("merge", tmp_path / "1", tmp_path / "2", "-o", tmp_path / "both")
    assert code == 0 and "96 spp in 6 batches" in out
    command = ("render", scene, "-o", tmp_path / "both.exr", "--seed", 1,
               "--checkpoint", tmp_path / "both")  # fmt: skip
    assert run(*command, "--spp", 96)[0] == 0
    images = {name: read_exr(tmp_path / f"{name}.exr")[0] for name in ("1", "2", "both")}
    mean = (images["1"]["R"] + images["2"]["R"]) / 2
    np.testing.assert_allclose(images["both"]["R"], mean, rtol=1e-5)
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


@pytest.mark.parametrize(("arguments", "words"), [
    (("--add", 3), "--add needs --checkpoint"),
    (("--checkpoint", "a", "--add", 3, "--spp", 4), "--add and --spp exclude each other"),
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
    assert code == 0 and err.count("No space left") == 3 and "64 spp" in out
    assert spps == [16, 16, 16, 64, 64] and not list(kept.glob(".state*"))
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == 64


def test_variants_without_batches_are_named(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--until", 0.1,
                       "--variant", "scalar_rgb")  # fmt: skip
    assert code == 2 and 'a variant such as "llvm_ad_rgb"' in err


def test_a_signal_keeps_the_render_and_goes_on(run, make_scene, tmp_path, monkeypatch):
    render, seen = BatchRenderer.render, []

    def signalled(self, batch):
        if batch.index == 1:
            os.kill(os.getpid(), signal.SIGUSR1)
        if batch.index == 2:
            seen.append((CheckpointFolder(tmp_path / "kept").load().spp,
                         read_exr(tmp_path / "a.exr")[1]["spp"]))  # fmt: skip
        return render(self, batch)

    monkeypatch.setattr(BatchRenderer, "render", signalled)
    code, out, _ = run("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 64,
                       "--checkpoint", tmp_path / "kept")  # fmt: skip
    assert code == 0 and "64 spp" in out and seen == [(32, 32)]


@pytest.mark.parametrize("integrator", ["path", "composed_path"])
def test_ctrl_c_keeps_the_render_and_ends(run, make_scene, tmp_path, monkeypatch, integrator):
    render = BatchRenderer.render

    def signalled(self, batch):
        if batch.index == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return render(self, batch)

    monkeypatch.setattr(BatchRenderer, "render", signalled)
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", integrator,
               "--checkpoint", tmp_path / "kept")  # fmt: skip
    code, _, err = run(*command, "--spp", 64)
    spp = CheckpointFolder(tmp_path / "kept").load().spp
    assert code == 143 and f"interrupted after {spp} of 64 spp" in err and 32 <= spp <= 48
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == spp
    monkeypatch.setattr(BatchRenderer, "render", render)
    assert run(*command, "--spp", 64)[0] == 0


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
def test_a_render_that_is_killed_again_and_again_loses_no_interval(make_scene, tmp_path):
    scene, kept = make_scene(), CheckpointFolder(tmp_path / "kept")
    command = [sys.executable, "-m", "mitsuba_ext", *map(str, (
        "render", scene, "-o", tmp_path / "a.exr", "--spp", 1 << 20, "--size", "64x64",
        "--checkpoint", kept.path, "--every", "16spp",
    ))]  # fmt: skip
    before, rng = 0, random.Random(1)
    for _ in range(8):
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
    truth = json.loads(json.dumps(state.images.mean.mean()))
    whole = rendered(RenderRequest(str(scene), (64, 64)), spp=state.spp)
    assert abs(whole.images.mean.mean() / truth - 1) < 0.01


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
