"""Workers of a long render that lack the scene's files, are late, or die."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import InputError, SceneChanges, load_scene, render_reference
from mitsuba_ext.long_renders import tasks
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer, RenderRequest
from mitsuba_ext.long_renders.bundle import Bundle
from mitsuba_ext.long_renders.dispatch import Dispatch
from mitsuba_ext.long_renders.divided_references import ReferenceWorkers
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import Batch, RenderState
from mitsuba_ext.long_renders.tasks import Missing, render_batch
from mitsuba_ext.long_renders.workers import WorkerKilledError, Workers

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")

LEARNER = "composed_path:max_depth=3,next_event=contribution"


@pytest.fixture(autouse=True)
def no_scene_is_kept():
    yield
    tasks.forget()


def rendered(request: RenderRequest, spp: int = 64, executor: Executor | None = None, workers=2):
    render = LongRender(BatchRenderer(request), RenderState())
    assert render.run(Goal(spp), executor=executor, workers=workers)
    return render.state


class Worker(Executor):
    """Renders in this process, at once.

    Attributes:
        results: What the tasks returned.
        arguments: What they were given.
    """

    def __init__(self) -> None:
        self.results, self.arguments = [], []

    def submit(self, function, *arguments) -> Future:
        future = Future()
        self.arguments.append(arguments)
        try:
            self.results.append(function(*arguments))
            future.set_result(self.results[-1])
        except BaseException as error:
            future.set_exception(error)
        return future


class ForeignWorker(Worker):
    """One that does not have the files of a folder."""

    def __init__(self, folder) -> None:
        super().__init__()
        self._folder = folder

    def submit(self, function, *arguments) -> Future:
        hidden = self._folder.with_name("hidden")
        self._folder.rename(hidden)
        before = os.getcwd()
        os.chdir("/")
        try:
            return super().submit(function, *arguments)
        finally:
            os.chdir(before)
            hidden.rename(self._folder)


# ---- Workers without the scene's files ----


@pytest.fixture
def scattered_scene(tmp_path, make_scene, monkeypatch):
    """A scene that names its files in all ways, and definitions that it needs."""
    folder = tmp_path / "home"
    for name in ("scenes/parts", "textures", "elsewhere"):
        (folder / name).mkdir(parents=True)
    mi.load_dict({"type": "sphere"})
    rng = np.random.default_rng(1)
    for name in ("textures/above.exr", "elsewhere/absolute.exr", "current.exr"):
        mi.Bitmap(rng.random((4, 4, 3), dtype=np.float32)).write(str(folder / name))
    mesh = mi.Mesh("mesh", 3, 1)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-2, -2, 6, 2, -2, 6, 0, 2, 6]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    mesh.write_ply(str(folder / "scenes/parts/triangle.ply"))
    (folder / "scenes/light.spd").write_text("400 0.5\n700 2\n")
    (folder / "scenes/parts/light.xml").write_text(
        '<scene version="3.0.0"><emitter type="point"><point name="position" x="0" y="3" z="2"/>'
        '<spectrum name="intensity" filename="$spectrum.spd"/></emitter></scene>'
    )

    def textured(shape: str, file: str) -> str:
        return (
            f'<shape type="{shape}"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
            f'<string name="filename" value="{file}"/></texture></bsdf>'
        )

    scene = make_scene(body=(
        '<default name="spectrum" value="dark"/><include filename="parts/light.xml"/>'
        + textured("sphere", "../textures/above.exr")
        + '<transform name="to_world"><translate z="5"/></transform></shape>'
        + textured("ply", "$absolute")
        + '<string name="filename" value="parts/triangle.ply"/></shape>'
        + textured("rectangle", "current.exr")
        + '<transform name="to_world"><scale value="9"/><translate z="8"/></transform></shape>'
    ))  # fmt: skip
    scene.rename(folder / "scenes" / "scene.xml")
    monkeypatch.chdir(folder)
    definitions = (("absolute", str(folder / "elsewhere/absolute.exr")), ("spectrum", "light"))
    return RenderRequest("scenes/scene.xml", definitions=definitions)


def test_a_scene_travels_with_all_its_files(scattered_scene, tmp_path):
    here = rendered(scattered_scene, 128)
    worker = ForeignWorker(tmp_path / "home")
    state = rendered(scattered_scene, 128, worker)
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-4, atol=1e-6)
    assert here.images.mean.std() > 0.01, "the scene shows nothing"
    # Those that waited ask for it, and later ones find it there
    bundles = [arguments[-1] for arguments in worker.arguments]
    missing = [isinstance(result, Missing) for result in worker.results]
    assert 1 <= sum(missing) == sum(map(bool, bundles)) <= 4 and len(missing) - sum(missing) == 8
    names = {os.path.basename(path) for bundle in filter(None, bundles) for path in bundle.files}
    assert names == {"scene.xml", "light.xml", "light.spd", "triangle.ply", "above.exr",
                     "absolute.exr", "current.exr"}  # fmt: skip
    assert not list(tmp_path.glob("mitsuba_ext_*"))


def test_a_worker_with_the_same_files_needs_no_others(scattered_scene):
    worker = Worker()
    rendered(scattered_scene, executor=worker)
    assert not any(isinstance(result, Missing) for result in worker.results)
    assert all(arguments[-1] is None for arguments in worker.arguments)


def test_a_worker_with_other_files_of_these_names_gets_the_right_ones(make_scene):
    scene = make_scene()
    request = RenderRequest(str(scene))
    here = rendered(request)
    ours = scene.read_text()

    class Changed(Worker):
        def submit(self, function, *arguments):
            scene.write_text(ours.replace('z="5"', 'z="50"'))
            try:
                return super().submit(function, *arguments)
            finally:
                scene.write_text(ours)

    state = rendered(request, executor=Changed())
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-4)


def test_files_that_cannot_travel_are_named(scattered_scene, tmp_path):
    scene = tmp_path / "home" / "scenes" / "scene.xml"
    ours = scene.read_text()
    worker = ForeignWorker(tmp_path / "home")
    render = LongRender(BatchRenderer(scattered_scene), RenderState())
    scene.write_text(ours + "<!-- changed -->")
    with pytest.raises(InputError, match="its files have changed since the render began"):
        render.run(Goal(16), executor=worker)
    included = str(tmp_path / "home/scenes/parts/light.xml")
    scene.write_text(ours.replace("parts/light.xml", included))
    with pytest.raises(InputError, match='light.xml" is named by its absolute path'):
        rendered(scattered_scene, executor=worker)


def test_a_damaged_bundle_is_refused(make_scene):
    loaded = BatchRenderer(RenderRequest(str(make_scene()))).chosen.loaded
    bundle = Bundle.of(loaded)
    files = {path: content + b" " for path, content in bundle.files.items()}
    with pytest.raises(InputError, match="damaged in transfer"), \
         Bundle(files, bundle.folders, bundle.digest).unpacked():  # fmt: skip
        pass


def test_a_worker_with_another_version_refuses(make_scene, monkeypatch):
    request = RenderRequest(str(make_scene()))
    renderer = BatchRenderer(request)
    description = {**renderer.description(), "versions": {"mitsuba": "4"}}
    monkeypatch.setattr(renderer, "description", lambda: description)
    with pytest.raises(InputError, match='would render another image: "versions" differs'):
        LongRender(renderer, RenderState()).run(Goal(16), executor=Worker())


# ---- What is learned ----


def test_the_learned_state_is_sent_to_workers_that_lack_it(scenes):
    request = RenderRequest(str(scenes / "cornell_box.xml"), (8, 6), (), LEARNER)
    here = rendered(request)

    class Forgetful(Worker):
        def submit(self, function, *arguments):
            if len(self.arguments) in (1, 3):
                tasks.forget()
            return super().submit(function, *arguments)

    worker = Forgetful()
    state = rendered(request, executor=worker)
    missing = [result for result in worker.results if isinstance(result, Missing)]
    assert set(missing) == {Missing(scene=False, learned=True)} and len(missing) >= 2
    learned = [result.learned for result in worker.results if not isinstance(result, Missing)]
    assert learned[0] and learned[1:] == [None] * 3 and state.learned == learned[0]
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-3)
    with pytest.raises(InputError, match="learned state was damaged"):
        render_batch(request, Batch(0, 9, 16), tasks.digest_of(b"a"), b"b")


# ---- Workers that hang or die ----


def test_a_late_batch_is_given_to_another_worker_and_counts_once(make_scene, monkeypatch):
    monkeypatch.setattr(Dispatch, "period", 0.05)
    monkeypatch.setattr(Dispatch, "min_late", 0.4)
    request = RenderRequest(str(make_scene()))
    here = rendered(request, 96)

    class OneHangs(Worker):
        avoided, hanging = [], []

        def submit(self, function, *arguments):
            if arguments[1].index == 2 and not self.hanging:
                self.hanging.append((Future(), function, arguments))
                return self.hanging[0][0]
            return super().submit(function, *arguments)

        def avoid(self, future):
            self.avoided.append(future)
            # It wakes up when its batch has been given to another
            late, function, arguments = self.hanging[0]
            late.set_result(function(*arguments))

    worker = OneHangs()
    state = rendered(request, 96, worker)
    assert worker.avoided == [worker.hanging[0][0]]
    assert sorted(state.done) == here.done
    np.testing.assert_allclose(state.images.mean, here.images.mean, rtol=1e-6)


def _answer(number: int) -> tuple[int, int]:
    if number < 0:
        time.sleep(60)
    return number, os.getpid()


def test_a_dying_process_costs_its_task_and_a_hanging_one_ends_with_the_others():
    workers = Workers(2)
    try:
        process = workers.submit(_answer, 1).result(timeout=60)[1]
        hanging = workers.submit(_answer, -1)
        dying = workers.submit(_answer, -2)
        others = [workers.submit(_answer, number) for number in (3, 4)]
        time.sleep(0.5)
        os.kill(process, signal.SIGKILL)
        found = {future.result(timeout=60)[0] for future in others}
        assert found == {3, 4}
        lost = [future for future in (hanging, dying) if future.done()]
        assert len(lost) == 1 and isinstance(lost[0].exception(), WorkerKilledError)
        assert "SIGKILL" in str(lost[0].exception())
        # A fault of native code is no signal from outside
        with pytest.raises(BrokenProcessPool):
            workers.submit(os.kill, workers.submit(os.getpid).result(60), signal.SIGSEGV).result(60)
    finally:
        begin = time.monotonic()
        workers.shutdown(cancel_futures=True)
        assert time.monotonic() - begin < 30


def test_the_exit_code_of_a_process_may_arrive_after_its_end():
    """The pool's thread may have been told of the end without having stored the code yet."""

    class Ended:
        codes = [None, None, -signal.SIGKILL]
        exitcode = property(lambda process: process.codes.pop(0))

        def join(self, timeout):
            pass

    workers = Workers(1)
    workers._processes[0] = Ended()
    assert "SIGKILL" in str(workers._killed(0))
    workers.shutdown()


@pytest.mark.parametrize(("error", "deaths"), [
    (WorkerKilledError("killed"), 10), (BrokenProcessPool("died"), 3)
])  # fmt: skip
def test_a_batch_ends_the_render_sooner_if_it_is_at_fault(make_scene, error, deaths):
    """Three deaths of innocent workers do not."""
    left = [deaths - 1]

    class Dies(Worker):
        def submit(self, function, *arguments):
            if arguments[1].index == 2 and left[0] > 0:
                left[0] -= 1
                future = Future()
                future.set_exception(error)
                return future
            return super().submit(function, *arguments)

    request = RenderRequest(str(make_scene()))
    assert rendered(request, 64, Dies()).spp == 64
    left[0] = deaths
    with pytest.raises(InputError, match=f"a batch failed {deaths} times: (killed|died)"):
        rendered(request, 64, Dies())


# ---- References of comparisons ----


def test_references_of_several_processes_agree_with_one_process(make_scene, tmp_path):
    class Backwards(Worker):
        """Results come two at a time, and the later one first."""

        waiting = []

        def submit(self, function, *arguments):
            future = Future()
            self.waiting.append((future, super().submit(function, *arguments)))
            if len(self.waiting) == 2:
                for outer, inner in reversed(self.waiting):
                    outer.set_result(inner.result())
                self.waiting.clear()
            return future

    changes = SceneChanges((5, 4, 2, 1), "tent", 2)
    scene = load_scene(make_scene(), keep_integrator=False, changes=changes)
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    here = render_reference(scene, 64, tmp_path / "here")
    workers = ReferenceWorkers(Backwards(), 2)
    there = render_reference(scene, 64, tmp_path / "there", workers=workers)
    np.testing.assert_allclose(there.mean, here.mean, rtol=1e-5)
    np.testing.assert_allclose(there.variance, here.variance, rtol=1e-3, atol=1e-9)
    with pytest.raises(InputError, match="cannot be sent to others"):
        render_reference(scene, 128, tmp_path / "there", {"type": "path"}, workers=workers)


@pytest.mark.slow
def test_compare_renders_references_in_processes(run, make_scene, tmp_path):
    command = ("compare", make_scene(), "path", "--spp", 4, "--seeds", 1, "--out", tmp_path / "out")
    assert run(*command, "--workers", 2)[0] == 0
    assert list((tmp_path / "out").glob("*references/*.exr"))
    code, _, err = run(*command, "--workers", 2, "--dask", "tcp://127.0.0.1:1")
    assert code == 2 and "cannot be combined" in err
