"""The files that ``mitsuba-ext render`` writes, and files that it cannot write."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.cli import image_render
from mitsuba_ext.compare import read_exr, write_exr
from mitsuba_ext.images import image_files
from mitsuba_ext.util import marks
from tests.support.command_line import PATH


@pytest.mark.parametrize("extension", ["png", "jpg", "hdr", "pfm"])
def test_render_writes_other_formats(run, make_scene, tmp_path, extension):
    output = tmp_path / f"image.{extension}"
    assert run("render", make_scene(), "-o", output)[0] == 0
    bitmap = mi.Bitmap(str(output))
    assert (bitmap.width(), bitmap.height()) == (8, 6)
    assert bitmap.srgb_gamma() == (extension in ("png", "jpg"))


def test_render_keeps_aovs_in_an_exr_and_leaves_them_out_of_a_png(run, make_scene, tmp_path):
    integrator = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH}</integrator>'
    scene = make_scene(integrator=integrator)
    assert run("render", scene, "-o", tmp_path / "image.exr")[0] == 0
    assert "d.T" in read_exr(tmp_path / "image.exr")[0]
    assert run("render", scene, "-o", tmp_path / "image.png")[0] == 0


def test_a_file_that_another_render_writes_is_refused(run, make_scene, tmp_path):
    output = tmp_path / "out" / "a.exr"
    output.parent.mkdir()
    command = ("render", make_scene(), "-o", output, "--spp", 1)
    with marks.written_alone(output):
        code, _, err = run(*command)
        assert code == 2 and f"another render writes this file (process {os.getpid()})" in err
        assert run(*command[:3], tmp_path / "b.exr", "--spp", 1)[0] == 0
    assert run(*command)[0] == 0
    assert [path.name for path in output.parent.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("which", ["a.exr", "a.noisy.exr", "b.png"])
def test_a_read_only_target_is_found_before_the_render(
    run, make_scene, tmp_path, monkeypatch, which
):
    """The test does not change modes, because its user may be allowed to write all files."""
    (tmp_path / which).touch()

    def access(path, mode, *, _access=os.access, **named) -> bool:
        is_refused = mode == os.W_OK and Path(path).name == which
        return not is_refused and _access(path, mode, **named)

    monkeypatch.setattr(os, "access", access)
    monkeypatch.setattr(image_render, "select_variant", lambda *_: pytest.fail("too late"))
    options = ("--preview", tmp_path / "b.png", "--denoise")
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", *options)
    assert code == 2 and f"{which}: is read-only" in err
    code, _, err = run("render", make_scene(), "-o", tmp_path / "none" / "a.exr")
    assert code == 2 and "no such folder" in err


def test_output_that_cannot_hold_the_film_is_refused_before_rendering(
    run, make_scene, tmp_path, monkeypatch
):
    scene = make_scene(film='<spectrum name="band" value="400:1, 700:1"/>')
    scene.write_text(scene.read_text().replace("hdrfilm", "specfilm"))
    arguments = ("render", scene, "--variant", "llvm_ad_spectral", "-o")
    code, _, err = run(*arguments, tmp_path / "a.png")
    assert code == 2 and 'the film "SpecFilm" has no RGB image: write it to an .exr' in err
    assert run(*arguments, tmp_path / "a.exr")[0] == 0
    assert set(read_exr(tmp_path / "a.exr")[0]) == {"band"}

    def full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(tmp_path), "write_bytes", full_disk)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "b.exr")
    assert code == 2 and "b.exr: cannot be written (No space left on device)" in err
    assert not list(tmp_path.glob("b*"))


def test_failing_write_leaves_an_older_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "image.exr"
    write_exr(path, np.ones((2, 2, 3)), "RGB", {})
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError):
        write_exr(path, np.zeros((2, 2, 3)), "RGB", {})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_that_does_not_fit_is_refused_at_once(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--size", "200000x200000")
    assert code == 2 and "a film of 200000x200000 pixels with 4 channels needs at least" in err
    assert not list(tmp_path.glob("tmp*"))


def test_the_check_of_a_film_keeps_its_crop_window(tmp_path):
    window = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 5, "crop_height": 4}
    film = mi.load_dict({"type": "hdrfilm", "width": 20, "height": 10, **window})
    image_files.check_film(tmp_path / "a.exr", film, ["a.R"])
    assert list(film.crop_size()) == [5, 4] and list(film.crop_offset()) == [3, 2]
    assert list(film.size()) == [20, 10] and not list(tmp_path.iterdir())


def test_render_writes_cryptomattes_of_objects_that_mitsuba_would_merge(
    run, make_scene, tmp_path
):
    cubes = "".join(
        f'<shape type="cube" id="{name}"><transform name="to_world"><translate x="{x}" z="8"/>'
        f'</transform><bsdf type="diffuse"/></shape>'
        for name, x in (("left", 1.5), ("right", -1.5))
    )
    wish = ("--integrator", "composed_path:max_depth=1,aovs=o:cryptomatte_object")
    output = tmp_path / "image.exr"
    assert run("render", make_scene(body=cubes), "-o", output, *wish)[0] == 0
    channels, metadata = read_exr(output)
    (manifest,) = (text for key, text in metadata.items() if key.endswith("/manifest"))
    assert set(json.loads(manifest)) == {"left", "right"}
    assert len(np.unique(channels["o00.r"])) == 3 and channels["o00.g"].max() == 1
    err = run("render", make_scene(body=cubes), "-o", tmp_path / "image.png", *wish)[2]
    assert "only an .exr can hold masks" in err
