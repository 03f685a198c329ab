"""Renders that are watched: the image stays the same, and snapshots are right."""

from __future__ import annotations

import importlib
import json
import re
import threading
import types
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import read_exr
from mitsuba_ext.live import viewer as viewers
from mitsuba_ext.live.increments import Increments
from mitsuba_ext.live.kept_folder import KeptFolder
from mitsuba_ext.live.snapshot import Snapshot
from mitsuba_ext.live.viewer import Viewer
from mitsuba_ext.long_renders.announced_error import announced_error
from mitsuba_ext.rendering import device, plan, seed_passes
from mitsuba_ext.util.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")


class Shown:
    """A receiver that keeps all snapshots."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.names: list[str] = []
        self.figures: dict = {}
        self.phase = ""

    def receive(self, name: str, snapshot: Snapshot) -> None:
        self.names.append(name)
        self.snapshots.append(snapshot)

    def begin(self) -> None:
        pass

    def describe(self, facts: dict[str, str]) -> None:
        self.facts = facts

    def tell(self, figures: dict) -> None:
        self.figures.update(figures)

    def close(self, phase: str) -> None:
        self.phase = phase


@pytest.fixture
def short_passes(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Passes of 4 samples of each pixel of the scene, and a snapshot after each of them."""
    samples = 4 * 8 * 6
    monkeypatch.setitem(seed_passes._PASS_SAMPLES, dr.backend_v(mi.Float), samples)
    monkeypatch.setattr(device, "_CPU_SAMPLES", samples)
    monkeypatch.setattr(plan, "_PASS_SPP", 1)
    monkeypatch.setattr(seed_passes, "_PASS_SPP", 1)
    monkeypatch.setattr(Viewer, "is_due", lambda viewer: True)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, short_passes: None) -> Iterator[Shown]:
    """What ``--tev`` shows: every snapshot, in order, because the render waits for it."""
    shown = Shown()

    def open_viewer(tev, port, has_control, warn, phase=viewers.RENDERING):
        viewer = Viewer([shown], pytest.fail, phase)
        viewer._prepared.put = viewer._hand_on
        for box in viewer._boxes:
            box.put = shown.receive
        return viewer, ""

    monkeypatch.setattr(viewers, "open_viewer", open_viewer)
    return shown


#: Light that reaches the camera directly and indirectly, with shadows.
SPHERES = """<shape type="sphere">
    <transform name="to_world"><translate z="5"/></transform>
    <bsdf type="diffuse"/>
  </shape>
  <shape type="sphere">
    <transform name="to_world"><scale value="40"/><translate y="-41" z="5"/></transform>
    <bsdf type="diffuse"/>
  </shape>
  <emitter type="point"><point name="position" x="2" y="3" z="1"/>
    <rgb name="intensity" value="20"/></emitter>"""


@pytest.mark.parametrize(
    "integrator",
    [
        "path", "composed_path", "bdpt:max_depth=3", "light_tracer:max_depth=3", "pssmlt",
        "adaptive:nested=[composed_path],count_samples=true", "variance:nested=[path],batches=4",
        "composed_path:aovs=d:depth",
    ],
)  # fmt: skip
def test_the_last_snapshot_is_the_image_and_watching_changes_no_image(
    run, make_scene, tmp_path, shown, integrator
):
    arguments = ("render", make_scene(body=SPHERES), "--integrator", integrator, "--spp", 16)
    images = []
    for name, options in (("a.exr", []), ("b.exr", ["--tev"])):
        assert run(*arguments, "-o", tmp_path / name, *options)[0] == 0
        images.append(read_exr(tmp_path / name)[0])
    plain, watched = images
    last = shown.snapshots[-1].planes()
    for name, plane in plain.items():
        np.testing.assert_allclose(watched[name], plane, rtol=1e-4, atol=1e-6, err_msg=name)
        np.testing.assert_array_equal(last[name], watched[name], err_msg=name)
    assert shown.names[0] == "scene" and shown.phase == "finished"
    before = shown.snapshots[:-1]
    assert len(before) >= (1 if integrator == "pssmlt" else 3)
    for snapshot in before:  # a darker one would lack samples
        mean = np.nanmean(snapshot.image[..., :3])
        assert mean == pytest.approx(plain["R"].mean(), rel=0.25), snapshot.spp
    assert before[0].spp < 16 or integrator == "pssmlt"


def test_nobody_who_watches_costs_nothing(run, make_scene, tmp_path, monkeypatch):
    """No snapshot is taken, and no module of the viewer is needed."""
    monkeypatch.setattr(viewers, "Viewer", None)
    assert run("render", make_scene(), "-o", tmp_path / "a.exr")[0] == 0
    integrator = mi.load_dict({"type": "composed_path"})
    assert integrator.watch is None


def test_a_watched_render_runs_the_same_kernels(make_scene, short_passes):
    scene = mi.load_file(str(make_scene(body=SPHERES)))
    kernels = []
    for watch in (None, None, Viewer([])):
        integrator = mi.load_dict({"type": "composed_path"})
        integrator.watch = watch
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            integrator.render(scene, spp=12, seed=1)
            kernels.append({k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])})
    # Those of the film are needed at the end, too
    assert kernels[1] <= kernels[2] and len(kernels[2] - kernels[1]) <= 2


@pytest.mark.parametrize("integrator", ["path", "composed_path"])
def test_the_variance_of_a_snapshot_is_the_variance_of_the_image(
    run, make_scene, tmp_path, shown, integrator
):
    scene = make_scene(body=SPHERES)
    images, variances = [], []
    for seed in range(8):
        arguments = ("--integrator", integrator, "--spp", 32, "--seed", seed, "--tev")
        assert run("render", scene, "-o", tmp_path / "a.exr", *arguments)[0] == 0
        images.append(shown.snapshots[-1].image)
        variances.append(shown.snapshots[-1].variance)
    assert np.mean(variances) == pytest.approx(np.var(images, axis=0, ddof=1).mean(), rel=0.4)
    last = shown.snapshots[-1]
    assert last.error == announced_error(last.image, last.variance)
    assert shown.snapshots[1].error is None, "a few parts tell nothing"


def test_the_variance_of_parts_is_the_variance_of_their_mean():
    rng = np.random.default_rng(1)
    increments, total, weight = Increments(), np.zeros((40, 50, 3)), np.zeros((40, 50, 1))
    for spp in (2, 2, 4, 1, 8, 3):
        for _ in range(spp):  # weights differ, as with a filter
            weights = rng.uniform(0.5, 1.5, (40, 50, 1))
            total += weights * rng.normal(1, 0.5, (40, 50, 3))
            weight += weights
        contents = np.concatenate([total, weight], axis=2).astype(np.float32)
        increments.add(contents, 3, (increments.spp or 0) + spp)
    expected = 0.25 / 20 * (1 + 1 / 12)
    assert increments.variance().mean() == pytest.approx(expected, rel=0.05)
    # Samples were discarded, or another film began: it begins again
    increments.add(contents, 3, 20)
    assert increments.count == 6, "nothing is new"
    increments.add(contents, 3, 5)
    assert increments.count == 1 and increments.variance() is None


def test_stop_acts_as_ctrl_c_and_pause_holds_the_render(
    run, make_scene, tmp_path, monkeypatch, shown
):
    """A page pauses the render after its third pass; when it stops it, that ends the pause."""
    output, phases = tmp_path / "a.exr", []
    tell = Viewer.tell

    def told(viewer: Viewer, **figures) -> None:
        if figures.get("spp") == 12:
            viewer.pause()
            threading.Timer(0.5, lambda: (phases.append(viewer.phase), viewer.stop())).start()
        tell(viewer, **figures)

    monkeypatch.setattr(Viewer, "tell", told)
    code, _, err = run(
        "render", make_scene(), "-o", output, "--integrator", "path", "--spp", 4000, "--tev"
    )
    assert (code, phases) == (130, ["paused"])
    spp = int(re.search(r"interrupted after (\d+) of 4000 spp", err)[1])
    assert read_exr(output)[1]["spp"] == spp == shown.snapshots[-1].spp
    assert 12 <= spp < 100, "it went on while it was paused"
    assert shown.phase == "interrupted"


def test_a_film_that_cannot_be_shown_does_not_end_the_render(
    run, make_scene, tmp_path, monkeypatch, short_passes
):
    def fails(*_):
        raise RuntimeError("no such channel")

    monkeypatch.setattr(Viewer, "_taken", fails)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--serve", 0)
    assert code == 0 and "the unfinished image cannot be shown: no such channel" in err


@pytest.mark.parametrize("broken", ["show", "present"])
def test_what_cannot_be_shown_is_said_once(broken):
    said: list[str] = []

    class Broken(Shown):
        def receive(self, name, snapshot):
            raise MemoryError("too large")

    def make() -> Snapshot:
        if broken == "present":
            raise InputError("too large")
        return Snapshot(np.zeros((1, 1, 3)), ("R", "G", "B"), 3, 1)

    viewer = Viewer([Broken()], said.append)
    for name in "abc":
        viewer.present(make, name)
    viewer.close()
    assert said == ["the unfinished image cannot be shown: too large"]


def test_frames_and_crop_windows_are_shown_one_after_the_other(run, make_scene, tmp_path, shown):
    code, _, _ = run(
        "render", make_scene(), "-o", tmp_path / "f.##.exr", "--frames", "1:2", "--tev",
        "--crop", "3x2+4+1",
    )  # fmt: skip
    assert code == 0 and shown.facts["title"] == "f.02.exr" and shown.facts["Frame"] == "2"
    assert {snapshot.image.shape for snapshot in shown.snapshots} == {(2, 3, 3)}


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_special_films_show_all_channels(run, make_scene, tmp_path, shown, variant):
    scene = make_scene()
    film = """<film type="specfilm"><integer name="width" value="8"/>
      <integer name="height" value="6"/>
      <spectrum name="a" value="400:1, 500:1"/><spectrum name="b" value="500:1, 600:1"/></film>"""
    scene.write_text(re.sub("<film.*</film>", film, scene.read_text(), flags=re.DOTALL))
    arguments = ("--integrator", "path", "--spp", 12, "--variant", variant, "--tev")
    assert run("render", scene, "-o", tmp_path / "a.exr", *arguments)[0] == 0
    last = shown.snapshots[-1]
    assert last.image.shape == (6, 8, 2) and last.variance is None
    assert last.rgb().shape == (6, 8, 3)


# ---- Batches ----


@pytest.mark.usefixtures("batches_of_sixteen_samples")
def test_a_render_in_batches_shows_its_variance_and_error(run, make_scene, tmp_path, shown):
    code, _, _ = run(
        "render", make_scene(body=SPHERES), "-o", tmp_path / "a.exr", "--spp", 160,
        "--checkpoint", tmp_path / "kept", "--tev",
    )  # fmt: skip
    assert code == 0
    channels, _ = read_exr(tmp_path / "a.exr")
    last = shown.snapshots[-1]
    for name, plane in last.planes().items():
        np.testing.assert_allclose(plane, channels[name], rtol=1e-4, err_msg=name)
    assert "variance.B" in last.planes() and last.error > 0
    assert shown.figures["relmse"] == pytest.approx(last.error)


@pytest.mark.usefixtures("batches_of_sixteen_samples")
def test_a_folder_is_shown_whenever_it_is_saved(run, make_scene, tmp_path):
    kept = tmp_path / "kept"
    with pytest.raises(InputError, match="no render is kept here"):
        KeptFolder(kept)
    arguments = ("render", make_scene(), "-o", tmp_path / "a.exr", "--checkpoint", kept)
    assert run(*arguments, "--spp", 128)[0] == 0
    folder = KeptFolder(kept)
    before = {path.name: path.stat().st_mtime_ns for path in kept.iterdir()}
    facts, figures, snapshot = folder.news()
    assert (facts["title"], figures["spp"], snapshot.spp) == ("kept", 128, 128)
    assert snapshot.error > 0
    image = read_exr(tmp_path / "a.exr")[0]
    np.testing.assert_allclose(snapshot.planes()["G"], image["G"], rtol=1e-5)
    assert folder.news() is None
    assert before == {path.name: path.stat().st_mtime_ns for path in kept.iterdir()}
    assert run(*arguments, "--add", 16)[0] == 0
    assert folder.news()[2].spp == 144
    # A folder of several frames shows the one that was saved last
    (tmp_path / "frames").mkdir()
    kept.rename(tmp_path / "frames" / "0007")
    facts, _, snapshot = KeptFolder(tmp_path / "frames").news()
    assert (facts["title"], snapshot.spp) == (str(Path("frames") / "0007"), 144)


# ---- compare ----


@pytest.mark.usefixtures("without_report")
def test_compare_shows_the_mean_of_the_runs_of_each_integrator(run, make_scene, tmp_path, shown):
    code, _, err = run(
        "compare", make_scene(body=SPHERES), "path", "composed_path", "--sweep", "4,8",
        "--seeds", 2, "--reference-spp", 64, "--out", tmp_path / "out", "--tev",
    )  # fmt: skip
    assert code == 0, err
    assert set(shown.names) == {"path", "composed_path"} and len(shown.names) == 8
    assert shown.facts["Budget"] == "--sweep 4,8"
    results = json.loads((tmp_path / "out/results.json").read_text())
    for one in results["scenes"][0]["integrators"]:
        for level in (4, 8):
            last = [
                snapshot for name, snapshot in zip(shown.names, shown.snapshots)
                if name == one["label"] and snapshot.spp == level
            ][-1]
            errors = [run["relmse"] for run in one["runs"] if run["level"] == level]
            assert last.error == pytest.approx(np.mean(errors)) and last.is_error_measured
            assert last.variance.shape == (6, 8, 3)


# ---- The command ``view`` ----


@pytest.mark.usefixtures("batches_of_sixteen_samples")
def test_the_command_view_serves_a_folder_until_ctrl_c(run, make_scene, tmp_path, monkeypatch):
    kept, states = tmp_path / "kept", []
    arguments = ("render", make_scene(), "-o", tmp_path / "a.exr", "--checkpoint", kept)
    assert run(*arguments)[0] == 0
    addresses = []

    def open_viewer(*arguments):
        viewer, address = _open(*arguments)
        addresses.append(address)
        return viewer, address

    def look(_seconds: float) -> None:
        while not (state := json.load(urllib.request.urlopen(f"{addresses[0]}state")))["pictures"]:
            pass
        states.append(state)
        raise KeyboardInterrupt

    _open = viewers.open_viewer
    monkeypatch.setattr(viewers, "open_viewer", open_viewer)
    # The package has the command in the place of its module
    module = importlib.import_module("mitsuba_ext.cli.view")
    monkeypatch.setattr(module, "time", types.SimpleNamespace(sleep=look))
    assert run("view", kept)[0] == 130
    (state,) = states
    assert (state["phase"], state["actions"]) == ("following", [])
    assert state["pictures"][0]["spp"] == 4
    code, _, err = run("view", tmp_path)
    assert code == 130 or "no render is kept here" in err
