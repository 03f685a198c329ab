"""``mitsuba-ext render --checkpoint``: renders that are kept, continued, merged and divided."""

from __future__ import annotations

import os
from concurrent.futures import Executor, Future
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import InputError
from mitsuba_ext.long_renders import dispatch
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.folder import CheckpointFolder
from mitsuba_ext.long_renders.state import Batch, RenderState
from mitsuba_ext.rendering import batches
from mitsuba_ext.rendering.batches import Batches
from tests.support.long_renders import LEARNER, image, rendered

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")


# ---- Sums ----


def test_batches_count_by_their_samples():
    """Mean and variance do not depend on how the samples are divided into batches."""
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
def test_a_continued_render_equals_a_render_that_was_not_stopped(
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


def test_the_image_is_the_mean_of_all_samples(request_of):
    """With a filter that is wider than a pixel, too: as one film of all batches would have it."""
    request = request_of("path:max_depth=3")
    file = Path(request.scene)
    file.write_text(file.read_text().replace('<rfilter type="box"/>', '<rfilter type="gaussian"/>'))
    state = rendered(request)
    scene, path = mi.load_file(request.scene), mi.load_dict({"type": "path", "max_depth": 3})
    film, total = scene.sensors()[0].film(), 0.0
    for seed in batches.batch_seeds(0, 4):
        path.render(scene, seed=seed, spp=16)
        total = total + np.array(film.develop(raw=True), dtype=np.float64)
    state.fill(film)
    expected = total[..., :3] / total[..., 3:4]
    np.testing.assert_allclose(np.array(film.develop()), expected, rtol=1e-4)
    assert not np.allclose(expected, state.images.mean, rtol=1e-4), "the weights do not matter"


@pytest.mark.parametrize("specification", [
    "path", "ptracer", "light_tracer", "bdpt", "adaptive:in=[path]",
    "variance:nested=[path],batches=2",
    "pssmlt:chains=64,luminance_samples=1000,bidirectional=false",
])  # fmt: skip
def test_batches_count_by_their_samples_in_the_image_too(specification, request_of):
    """This includes films whose weights are not numbers of samples."""
    request = request_of(specification)
    state = rendered(request, spp=34)
    assert [batch.spp for batch in state.done] == [16, 16, 2]
    film = BatchRenderer(request).sensor.film()
    state.fill(film)
    ours = np.array(film.develop())[..., :3]
    np.testing.assert_allclose(ours, state.images.mean[..., :3], rtol=1e-4)


def test_the_image_does_not_depend_on_the_worker(request_of):
    """Batches that come back late, or fail twice."""
    request = request_of("path")
    here = rendered(request, spp=96)

    class Unreliable(Executor):
        tries: dict[Batch, int] = {}

        def submit(self, function, *arguments):
            batch = arguments[1]
            self.tries[batch] = self.tries.get(batch, 0) + 1
            future = Future()
            if batch.index % 3 == 1 and self.tries[batch] < dispatch._MAX_FAILURES:
                future.set_exception(OSError("the worker has died"))
            else:
                future.set_result(function(*arguments))
            return future

    state = rendered(request, spp=96, executor=Unreliable(), workers=2)
    assert sorted(state.done) == here.done
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-12)

    class Broken(Executor):
        def submit(self, function, *arguments):
            future = Future()
            future.set_exception(OSError("the worker has died"))
            return future

    with pytest.raises(InputError, match="3 times: the worker has died"):
        rendered(request, executor=Broken())


# ---- The folder ----


def test_a_checkpoint_leaves_files_of_the_user_alone(request_of, tmp_path):
    """This includes the targets of links in the folder."""
    kept, mine = tmp_path / "kept", tmp_path / "mine.txt"
    files = [kept / "job" / "my.running", kept / "job" / "my.crashed", kept / ".state.npz"]
    (kept / "job").mkdir(parents=True)
    mine.write_text("my text")
    for file in files[:2]:
        file.write_text("my text")
    files[2].symlink_to(mine)
    (kept / "state.npz").symlink_to(mine)
    folder = CheckpointFolder(kept)
    with folder.in_use():
        folder.save(rendered(request_of("path"), spp=16))
    assert folder.load().spp == 16
    assert [file.read_text() for file in (*files, mine)] == ["my text"] * 4


def test_a_state_of_another_film_is_damaged(request_of, tmp_path):
    folder, request = CheckpointFolder(tmp_path / "kept"), request_of("path")
    with folder.in_use():
        folder.save(rendered(request, spp=16))
    film = BatchRenderer(request).sensor.film()
    assert folder.load(film).spp == 16
    for other in ({"width": 7}, {"pixel_format": "luminance"}):
        size = dict(zip(("width", "height"), film.size()))
        with pytest.raises(InputError, match="is damaged, or"):
            folder.load(mi.load_dict({"type": "hdrfilm", **size, **other}))


def test_a_batch_of_another_shape_is_refused(request_of):
    """A worker with another version could return one."""
    renderer = BatchRenderer(request_of("path"))
    result = renderer.render(Batch(0, 0, 16))
    other = result._replace(image=result.image[:3], contents=result.contents[:3])
    state = RenderState()
    with pytest.raises(InputError, match="a worker returned an image of shape"):
        renderer.check(other)
    renderer.check(result)
    state.add(result)
    with pytest.raises(InputError, match="a batch has an image of shape"):
        state.add(other)


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
    with pytest.raises(InputError, match="is damaged, or"):
        folder.load()


def test_the_state_before_a_damaged_one_is_kept_until_there_is_a_newer(
    run, make_scene, tmp_path, monkeypatch
):
    kept = tmp_path / "kept"
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--checkpoint", kept, "--spp")
    assert run(*command, 16)[0] == run(*command, 32)[0] == 0
    (kept / "state.npz").write_bytes(b"?")
    replace, names = os.replace, []

    def dies(source, target):
        names.append(Path(target).name)
        raise KeyboardInterrupt  # killed

    folder = CheckpointFolder(kept)
    state = folder.load()
    assert state.spp == 16 and folder.damaged == kept / "state.npz"
    monkeypatch.setattr(os, "replace", dies)
    with pytest.raises(KeyboardInterrupt):
        folder.save(state)
    monkeypatch.setattr(os, "replace", replace)
    assert names == ["state.npz"] and CheckpointFolder(kept).load().spp == 16
    code, _, err = run("merge", kept, kept, "-o", tmp_path / "all")
    assert code == 2 and err.count("state.npz: is damaged: the previous state is merged") == 2
    code, _, err = run(*command, 48)
    assert code == 0 and "state.npz: is damaged: continuing from the previous state" in err
    assert folder.load().spp == 48 and folder.damaged is None
    (kept / "state.npz").unlink()
    assert folder.load().spp == 16


def test_a_folder_without_a_description_is_refused(run, make_scene, tmp_path):
    kept = tmp_path / "kept"
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--checkpoint", kept, "--spp")
    assert run(*command, 16)[0] == run(*command, 32)[0] == 0
    (kept / "render.json").unlink()
    for name in ("state.npz", "state.before.npz"):
        code, _, err = run(*command, 32)
        assert code == 2 and "render.json: is missing: the folder can no longer be used" in err
        (kept / name).unlink()
    assert run(*command, 32)[0] == 0


def test_two_processes_cannot_use_a_folder(request_of, tmp_path):
    folder = CheckpointFolder(tmp_path / "kept")
    with folder.in_use(), pytest.raises(InputError, match="another process uses this folder"):
        with folder.in_use():
            pass


def test_batches_learn_once(run, scenes, tmp_path, monkeypatch):
    scene, kept = scenes / "cornell_box.xml", tmp_path / "kept"
    command = ("render", scene, "-o", tmp_path / "a.exr", "--size", "8x6",
               "--integrator", LEARNER, "--checkpoint", kept)  # fmt: skip
    seen = []
    render = BatchRenderer._rendered

    def watched(self, batch, **wishes):
        seen.append(("save_learned" in wishes, "load_learned" in wishes))
        return render(self, batch, **wishes)

    monkeypatch.setattr(BatchRenderer, "_rendered", watched)
    assert run(*command, "--spp", 48)[0] == 0
    assert run(*command, "--add", 16)[0] == 0
    assert seen == [(True, False)] + [(False, True)] * 3
    # Killed before the first batch was kept: what it has learned depends on its numbers
    for name in ("state.npz", "state.before.npz"):
        (kept / name).unlink(missing_ok=True)
    assert run(*command, "--spp", 16)[0] == 0
    assert seen[4:] == [(True, False)]


def test_an_interrupted_batch_leaves_no_learned_state(scenes, monkeypatch):
    """A second try has the same numbers, on which what was learned depends."""
    scene = str(scenes / "cornell_box.xml")
    renderer = BatchRenderer(RenderRequest(scene, (8, 6), (), LEARNER))

    def dies(*_arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(batches, "_complete", dies)
    with pytest.raises(KeyboardInterrupt):
        renderer.render(Batch(0, 0, 64))
    integrator = renderer.chosen.named.integrator
    assert not integrator.learned_state.has_file
    monkeypatch.undo()
    assert renderer.render(Batch(0, 0, 64)).learned
