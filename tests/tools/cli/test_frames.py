"""``mitsuba-ext render --frames`` and ``--sensor`` with several sensors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from mitsuba_ext.cli.common import kernels_compiled
from mitsuba_ext.cli.frames import pictures
from mitsuba_ext.cli.render_job import RenderJob
from mitsuba_ext.compare import InputError, read_exr
from mitsuba_ext.inputs import chosen
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer
from mitsuba_ext.long_renders.folder import CheckpointFolder

pytestmark = pytest.mark.usefixtures("variant")

BODY = """<shape type="sphere">
  <transform name="to_world"><translate x="$x" z="5"/></transform>
  <bsdf type="diffuse"/></shape>"""


def test_a_frame_has_its_file_its_values_and_its_seed():
    found = list(pictures(Path("a/b.###.png"), [("x", "{frame / 2}"), ("y", "v{frame}_{1+1}"),
                          ("z", "plain")], [None], 7, range(9, 11)))  # fmt: skip
    assert [tuple(picture) for picture in found] == [
        (Path("a/b.009.png"), (("x", "4.5"), ("y", "v9_2"), ("z", "plain")), None, 16, 9, "009"),
        (Path("a/b.010.png"), (("x", "5.0"), ("y", "v10_2"), ("z", "plain")), None, 17, 10, "010"),
    ]
    found = list(pictures(Path("a.exr"), [], [0, 2], 0, None))
    assert [picture.output.name for picture in found] == ["a.sensor0.exr", "a.sensor2.exr"]
    assert [picture.name for picture in found] == ["sensor0", "sensor2"]
    (one,) = pictures(Path("a.##.exr"), [], [None], 0, range(3, 4))
    assert one.name == "03" and one.unfinished.name == "a.03.partial.exr"
    assert list(pictures(Path("a.exr"), [], [1], 0, None))[0].name == ""
    with pytest.raises(InputError, match="image.####.exr"):
        list(pictures(Path("a.exr"), [], [None], 0, range(2)))
    with pytest.raises(InputError, match="frame 1: name 'open' is not defined"):
        list(pictures(Path("#.exr"), [("x", "{open}")], [None], 0, range(1, 2)))


def test_frames_are_rendered_once_and_compile_once(run, make_scene, tmp_path, monkeypatch):
    scene = make_scene(body=BODY)
    command = ("render", scene, "-o", tmp_path / "a.##.exr", "-D", "x={0.5 * frame}")
    assert run(*command, "--frames", "0:0")[0] == 0
    compiled = kernels_compiled()
    assert run(*command, "--frames", "0:2")[0] == 0
    assert kernels_compiled() == compiled
    frames = [read_exr(tmp_path / f"a.0{n}.exr") for n in range(3)]
    # The sphere moves
    left = [frame[0]["R"][:, :4].mean() for frame in frames]
    assert left[0] < left[1] < left[2] or left[0] > left[1] > left[2]
    assert [frame[1]["seed"] for frame in frames] == [0, 1, 2]
    single = ("render", scene, "-o", tmp_path / "b.exr", "-D", "x=0.5", "--seed", 1)
    assert run(*single)[0] == 0
    np.testing.assert_array_equal(read_exr(tmp_path / "b.exr")[0]["R"], frames[1][0]["R"])
    # The same command goes on
    (tmp_path / "a.01.exr").unlink()
    code, out, err = run(*command, "--frames", "0:2")
    assert code == 0 and out.count("spp in") == 1 and err.count("exists already") == 2

    # An image that was interrupted is no frame
    (tmp_path / "a.01.exr").unlink()
    render = RenderJob.run

    def run_and_interrupt(self, *arguments):
        render(self, *arguments)
        self.is_interrupted = True

    monkeypatch.setattr(RenderJob, "run", run_and_interrupt)
    assert run(*command, "--frames", "0:2")[0] == 130
    assert not (tmp_path / "a.01.exr").exists() and (tmp_path / "a.01.partial.exr").exists()


def test_all_sensors(run, make_scene, tmp_path):
    scene = make_scene()
    sensor = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="3"/>' \
             '<integer name="height" value="2"/></film></sensor>'  # fmt: skip
    scene.write_text(scene.read_text().replace("<emitter", sensor + "<emitter"))
    assert run("render", scene, "-o", tmp_path / "a.exr", "--sensor", "all", "--spp", 1)[0] == 0
    shapes = [read_exr(tmp_path / f"a.sensor{n}.exr")[0]["R"].shape for n in range(2)]
    assert shapes == [(6, 8), (2, 3)]
    assert run("render", scene, "-o", tmp_path / "b.exr", "--sensor", "1", "--spp", 1)[0] == 0
    assert read_exr(tmp_path / "b.exr")[0]["R"].shape == (2, 3)
    kept = ("--frames", "7:8", "--spp", 1, "--checkpoint", tmp_path / "kept")
    assert run("render", scene, "-o", tmp_path / "c.##.exr", "--sensor", "all", *kept)[0] == 0
    names = [f"0{frame}.sensor{sensor}" for frame in (7, 8) for sensor in (0, 1)]
    assert sorted(folder.name for folder in (tmp_path / "kept").iterdir()) == names
    assert all((tmp_path / f"c.{name}.exr").exists() for name in names)


def test_frames_are_kept_each_in_a_folder(
    run, make_scene, tmp_path, monkeypatch, batches_of_sixteen_samples
):
    command = ("render", make_scene(body=BODY), "-o", tmp_path / "a.##.exr", "--frames", "3:4",
               "-D", "x={frame}", "--sensor", "0", "--checkpoint", tmp_path / "kept")  # fmt: skip
    render, seen = BatchRenderer.render, []

    def signalled(self, batch, *rest):
        seen.append((self.chosen.loaded.parameters["x"], batch.index))
        if seen[-1] == ("4", 1):
            os.kill(os.getpid(), signal.SIGTERM)
        return render(self, batch, *rest)

    monkeypatch.setattr(BatchRenderer, "render", signalled)
    assert run(*command, "--spp", 64)[0] == 143
    kept = {name: CheckpointFolder(tmp_path / "kept" / name).load().spp for name in ("03", "04")}
    assert kept == {"03": 64, "04": 32}
    assert not (tmp_path / "a.04.exr").exists() and (tmp_path / "a.04.partial.exr").exists()
    monkeypatch.undo()
    monkeypatch.setattr(BatchRenderer, "render", signalled)  # batches of other sizes now
    # The same command goes on in the second frame, where it was
    del seen[:]
    seen.append(("4", 1))
    code, out, err = run(*command, "--spp", 64)
    assert code == 0 and "64 spp" in out and "a.03.exr: exists already" in err
    assert not (tmp_path / "a.04.partial.exr").exists()
    assert seen[1] == ("4", 2)
    # More samples of all
    code, out, _ = run(*command, "--spp", 80)
    assert code == 0 and out.count("80 spp") == 2
    assert read_exr(tmp_path / "a.03.exr")[1]["spp"] == 80


@pytest.mark.slow
def test_frames_continue_after_the_process_was_killed(make_scene, tmp_path):
    (tmp_path / "animate.py").write_text(FUNCTION)
    scene = make_scene(body=BODY.replace("<shape", '<shape id="ball"'))
    command = [sys.executable, "-m", "mitsuba_ext", *map(str, (
        "render", scene, "-o", tmp_path / "a.#.exr", "--frames", "0:2", "--spp", 1 << 15,
        "--size", "32x32", "--parameters", f"{tmp_path / 'animate.py'}:kernels",
        "--checkpoint", tmp_path / "kept", "--every", "1spp",
    ))]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    second = CheckpointFolder(tmp_path / "kept" / "1")
    deadline = time.monotonic() + 120
    while not (second.path / "state.npz").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    before = second.load()
    assert before.spp > 0 and not (tmp_path / "a.1.exr").exists()
    finished = (tmp_path / "a.0.exr").read_bytes()
    assert subprocess.run(command, capture_output=True, timeout=300).returncode == 0
    assert (tmp_path / "a.0.exr").read_bytes() == finished
    after = second.load()
    assert after.spp == 1 << 15 and after.done[: len(before.done)] == before.done
    assert {file.name for file in tmp_path.glob("a.*")} == {f"a.{n}.exr" for n in range(3)}


FUNCTION = """
import mitsuba as mi

def move(frame):
    at = mi.ScalarTransform4f().translate([0.5 * frame, 0, 5])
    found = {"x": 0, "ball.to_world": at}
    if frame == 2:
        found["ball.bsdf.reflectance.value"] = [0.1, 0.2, 0.3]
    return found

def kernels(frame):
    return {"x": frame // 6, "ball.to_world": mi.ScalarTransform4f().translate([frame, 0, 5]),
            "ball.bsdf.reflectance.value": 0.1 * frame}

def wrong(frame):
    return WRONG
"""


@pytest.mark.parametrize("options", [(), ("--until", "1e-9")])
def test_a_function_moves_objects_without_loading_anew(run, make_scene, tmp_path, options):
    body = BODY.replace("<shape", '<shape id="ball"').replace(
        "/></shape>", '><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf></shape>')
    scene = make_scene(body=body)
    (tmp_path / "animate.py").write_text(FUNCTION)
    with mock.patch("mitsuba_ext.inputs.chosen.load_scene", wraps=chosen.load_scene) as load:
        code, _, err = run("render", scene, "-o", tmp_path / "a.#.exr", "--spp", 64, *options,
                           "--parameters", f"{tmp_path / 'animate.py'}:move",
                           "--frames", "0:3")  # fmt: skip
    assert code == 0 and not err and load.call_count == 1
    for frame in range(4):
        image, metadata = read_exr(tmp_path / f"a.{frame}.exr")
        assert "ball.to_world" in metadata["scene_values"]
        color = "0.1, 0.2, 0.3" if frame == 2 else "0.5, 0.5, 0.5"
        make_scene(body=body.replace("0.5, 0.5, 0.5", color))
        single = ("render", scene, "-o", tmp_path / "b.exr", "-D", f"x={0.5 * frame}", "--seed",
                  frame, "--spp", 64, *options)  # fmt: skip
        assert run(*single)[0] == 0
        np.testing.assert_allclose(
            read_exr(tmp_path / "b.exr")[0]["G"], image["G"], rtol=1e-4, atol=1e-5)


def test_other_values_need_no_other_kernels(run, make_scene, tmp_path, monkeypatch):
    (tmp_path / "animate.py").write_text(FUNCTION)
    counts, choose = [], chosen.LastScene.choose

    def counted(self, *arguments, **named):
        counts.append(kernels_compiled())
        return choose(self, *arguments, **named)

    monkeypatch.setattr(chosen.LastScene, "choose", counted)
    # The scene is loaded again for the last one, where another $x is given
    scene = make_scene(body=BODY.replace("<shape", '<shape id="ball"'))
    assert run("render", scene, "-o", tmp_path / "a.#.exr", "--frames", "0:6", "--spp", 64,
               "--parameters", f"{tmp_path / 'animate.py'}:kernels")[0] == 0  # fmt: skip
    assert len(counts) == 7 and counts[1:] == [counts[1]] * 6, counts


@pytest.mark.parametrize(("value", "words"), [
    ("3", "frame 0: must return a dict"),
    ("1 / 0", "frame 0: ZeroDivisionError"),
    ("{'bal.to_world': 3}", 'no object of the file has the id "bal": did you mean "ball"?'),
    ("{'ball.to_wold': 3}", 'no parameter "ball.to_wold": did you mean "ball.to_world"?'),
    ("{'lamp.to_world': 3}", 'no object of the file has the id "lamp"'),
    ("{'box.q.q.q.q.q.q.q': 3}", 'no parameter "box.q.q.q.q.q.q.q": it has "box.'),
    ("{'ball.to_world': 'up'}", "must be a number"),
    ("{'ball.to_world': [1, 2]}", "4x4"),
    ("{'ball.to_world': float('nan')}", "finite"),
    ("{'ball.bsdf.reflectance.value': [1, 2]}", "3 numbers are expected"),
    ("{'box.vertex_positions': 1}", "72 numbers are expected"),
    ("{'ball.silhouette_sampling_weight': [1, 2]}", "one number is expected"),
])  # fmt: skip
def test_wrong_values_are_named(run, make_scene, tmp_path, value, words):
    body = BODY.replace("<shape", '<shape type="cube" id="box"/><shape id="ball"')
    body = body.replace("$x", "0").replace(
        '<bsdf type="diffuse"/>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>')
    (tmp_path / "animate.py").write_text(FUNCTION.replace("WRONG", value))
    code, _, err = run("render", make_scene(body=body), "-o", tmp_path / "a.#.exr", "--frames",
                       "0:1", "--parameters", f"{tmp_path / 'animate.py'}:wrong")  # fmt: skip
    assert code == 2 and words in err and err.count("\n") == 1, err


def test_functions_that_are_not_there_are_named(run, make_scene, tmp_path):
    (tmp_path / "animate.py").write_text("x = 1")
    for text, words in ((tmp_path / "animate.py", "animate.py:frame"),
                        (f"{tmp_path / 'b.py'}:f", "no such file"),
                        (f"{tmp_path / 'animate.py'}:f", 'no function "f"'),
                        ("no_such_module:f", "ModuleNotFoundError")):  # fmt: skip
        code, _, err = run("render", make_scene(), "-o", tmp_path / "a.#.exr", "--frames", "0:1",
                           "--parameters", text)  # fmt: skip
        assert code == 2 and words in err, err


@pytest.mark.parametrize(("options", "words"), [
    (("--frames", "5:1"), "expected something like 1:100"),
    (("--frames", "1:2", "--checkpoint", "a", "--add", 3), "--add is for one image"),
    (("--parameters", "a.py:f"), "--parameters needs --frames"),
    (("--sensor", "1,b"), "expected something like 0, 0,2 or all"),
])  # fmt: skip
def test_wrong_ranges_are_named(run, make_scene, tmp_path, options, words):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "#.exr", *options)
    assert code == 2 and words in err
