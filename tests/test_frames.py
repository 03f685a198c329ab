"""``mitsuba-ext render --frames`` and ``--sensor`` with several sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext.cli.common import kernels_compiled
from mitsuba_ext.cli.frames import pictures
from mitsuba_ext.cli.render_job import RenderJob
from mitsuba_ext.compare import InputError, read_exr

pytestmark = pytest.mark.usefixtures("variant")

BODY = """<shape type="sphere">
  <transform name="to_world"><translate x="$x" z="5"/></transform>
  <bsdf type="diffuse"/></shape>"""


def test_a_frame_has_its_file_its_values_and_its_seed():
    found = list(pictures(Path("a/b.###.png"), [("x", "{frame / 2}"), ("y", "v{frame}_{1+1}"),
                          ("z", "plain")], [None], 7, range(9, 11)))  # fmt: skip
    assert [tuple(picture) for picture in found] == [
        (Path("a/b.009.png"), (("x", "4.5"), ("y", "v9_2"), ("z", "plain")), None, 16),
        (Path("a/b.010.png"), (("x", "5.0"), ("y", "v10_2"), ("z", "plain")), None, 17),
    ]
    names = [picture.output.name for picture in pictures(Path("a.exr"), [], [0, 2], 0, None)]
    assert names == ["a.sensor0.exr", "a.sensor2.exr"]
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


@pytest.mark.parametrize(("options", "words"), [
    (("--frames", "5:1"), "expected something like 1:100"),
    (("--frames", "1:2", "--checkpoint", "a"), "--checkpoint keeps one image"),
    (("--sensor", "1,b"), "expected something like 0, 0,2 or all"),
])  # fmt: skip
def test_wrong_ranges_are_named(run, make_scene, tmp_path, options, words):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "#.exr", *options)
    assert code == 2 and words in err
