"""``mitsuba-ext render --checkpoint`` and ``merge``: options, folders, signals."""

from __future__ import annotations

import errno
import json
import os
import signal

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.compare import load_reference, read_exr
from mitsuba_ext.images import image_files
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer
from mitsuba_ext.long_renders.folder import CheckpointFolder
from tests.support.command_line import PATH

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


def test_a_signal_saves_the_render_which_continues(run, make_scene, tmp_path, monkeypatch):
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
def test_ctrl_c_saves_the_render_and_ends_it(run, make_scene, tmp_path, monkeypatch, integrator):
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
    """The scene has an included file, a mesh and a texture."""
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
