"""``mitsuba-ext render``: the integrator, the scene and its changes, warnings."""

from __future__ import annotations

import importlib
import json
import re
import sys

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.cli import image_render
from mitsuba_ext.compare import load_scene, read_exr, timing
from mitsuba_ext.inputs.scene_remarks import scene_remarks
from tests.support.command_line import PATH, PLAIN_PATH


def test_render_writes_an_exr_with_metadata(run, make_scene, tmp_path):
    output = tmp_path / "image.exr"
    scene = make_scene()
    code, _, err = run("render", scene, "-o", output, "--spp", 9, "--seed", 5, "--size", "10x4")
    assert (code, err) == (0, "")
    channels, metadata = read_exr(output)
    assert set(channels) == {"R", "G", "B"}
    assert channels["R"].shape == (4, 10)
    assert metadata["integrator"] == "path"
    assert json.loads(metadata["parameters"])["max_depth"] == 3
    assert (metadata["seed"], metadata["spp"], metadata["scene"]) == (5, 9, str(scene))
    assert metadata["seconds"] > 0
    assert json.loads(metadata["versions"])["mitsuba"].startswith("3.")


NOTE = '"auto" renders this scene'


@pytest.mark.parametrize(
    "integrator, options, rendered, note",
    [
        (PLAIN_PATH, [], "auto", f'{NOTE}, in place of its "path" (which --integrator scene'),
        (PLAIN_PATH, ["--preview", "{tmp}/b.png"], "auto", f"{NOTE}, in place of"),
        ("", [], "auto", f"{NOTE}, which names no integrator"),
        (PLAIN_PATH, ["--integrator", "scene"], "path", ""),
        (PLAIN_PATH, ["--integrator", "path"], "path", ""),
        (PLAIN_PATH, ["--variant", "scalar_rgb"], "path", '"path" renders this scene: "auto"'),
        (PATH, ["--variant", "scalar_rgb"], "path", ""),
        (PATH, [], "path", ""),
        (PLAIN_PATH.replace("path", "volpath"), [], "volpath", ""),
        (PLAIN_PATH.replace("path", "auto"), [], "auto", ""),
        (f'<integrator type="moment">{PLAIN_PATH}</integrator>', [], "path", ""),
    ],
)
def test_auto_renders_scenes_that_ask_for_path_or_nothing(
    run, make_scene, tmp_path, integrator, options, rendered, note
):
    output = tmp_path / "image.exr"
    options = [option.format(tmp=tmp_path) for option in options]
    code, _, err = run("render", make_scene(integrator=integrator), "-o", output, *options)
    assert code == 0 and err.startswith(note) and err.count("\n") == bool(note)
    metadata = read_exr(output)[1]
    assert metadata["integrator"] == rendered
    if integrator:
        assert json.loads(metadata["parameters"])["max_depth"] == 3


@pytest.mark.parametrize("options", [[], ["--integrator", "path"], ["--checkpoint", "{tmp}/kept"]])
def test_a_sampler_without_samples_is_refused(run, make_scene, tmp_path, options):
    scene = make_scene(integrator=PLAIN_PATH)
    options = ["-D", "spp=0", *(option.format(tmp=tmp_path) for option in options)]
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", *options)
    assert code == 2 and "0 samples per pixel" in err and str(scene) in err


def test_an_integrator_that_nests_none_is_black_and_says_so(run, make_scene, tmp_path):
    render = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator")
    assert '"moment" nests no integrator' in run(*render, "moment")[2]
    assert "nests no" not in run(*render, "moment:image=[path]")[2]


@pytest.mark.parametrize("light", ["area", "solid_angle_area"])
def test_a_light_that_is_in_no_shape_is_refused(run, make_scene, tmp_path, light):
    scene = make_scene(body=f'<emitter type="{light}"/>')
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr")
    assert code == 2 and f'"{light}" is in no shape' in err and str(scene) in err


def test_a_scene_without_integrator_needs_one_where_auto_is_not_supported(
    run, make_scene, tmp_path
):
    scene = make_scene(integrator="")
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", "--variant", "scalar_rgb")
    assert code == 2 and "no integrator: name one" in err and str(scene) in err


def test_first_render_says_that_it_compiles(run, make_scene, tmp_path, monkeypatch):
    command = image_render
    # Before the scene is loaded, after that, after the render
    for counts, before, after in (((5, 7, 8), True, False), ((5, 5, 8), False, True),
                                  ((5, 5, 5), False, False)):  # fmt: skip
        steps = iter(counts)
        monkeypatch.setattr(command, "kernels_compiled", lambda steps=steps: next(steps))
        code, out, err = run("render", make_scene(), "-o", tmp_path / "a.exr")
        assert code == 0 and err.startswith("compiling kernels") == before
        assert ("(compiled 3 kernels: the next" in out) == after


def test_misspelt_integrator_gets_a_suggestion(run, make_scene, tmp_path):
    for integrator, meant in (("neeep:max_depth=2", "neepp"), ("paht", "path")):
        arguments = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", integrator)
        assert f'did you mean "{meant}"?' in run(*arguments)[2]


def test_modules_beside_the_user_are_found(run, make_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_plugin_beside.py").write_text("raise RuntimeError('found')")
    output = tmp_path / "a.exr"
    *_, err = run("render", make_scene(), "-o", output, "--plugin", "my_plugin_beside")
    assert 'the plugin "my_plugin_beside": found' in err


def test_a_plugin_does_not_let_files_beside_the_user_run(run, make_scene, tmp_path, monkeypatch):
    """Neither while it is imported, nor later."""
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.chdir(tmp_path)
    for name in ("OpenEXR", "colorsys"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        (tmp_path / f"{name}.py").write_text(f"open('{name} ran', 'w').close()")
    (tmp_path / "only_here.py").write_text("import colorsys")
    (tmp_path / "later.py").write_text("")
    before = list(sys.path)
    arguments = ("-o", tmp_path / "a.exr", "--plugin", "only_here", "--until", "1")
    assert run("render", make_scene(), *arguments)[0] == 0
    assert sys.path == before and not list(tmp_path.glob("* ran"))
    with pytest.raises(ImportError):
        importlib.import_module("later")


def test_render_replaces_an_integrator_that_does_not_exist_here(run, make_scene, tmp_path):
    bogus = '<integrator type="bogus"><float name="x" value="1"/></integrator>'
    scene = make_scene(integrator=bogus)
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr")
    assert code == 2 and "bogus" in err
    assert run("render", scene, "-o", tmp_path / "a.exr", "--integrator", "path")[0] == 0


def test_render_passes_scene_parameters(run, make_scene, tmp_path):
    assert run("render", make_scene(), "-o", tmp_path / "a.exr", "-D", "spp=7")[0] == 0
    assert read_exr(tmp_path / "a.exr")[1]["spp"] == 7


def test_render_fills_a_time(run, make_scene, tmp_path):
    assert run("render", make_scene(), "-o", tmp_path / "a.exr", "--time", 0.5)[0] == 0
    metadata = read_exr(tmp_path / "a.exr")[1]
    # Loose: other processes share the machine
    assert 0.1 < metadata["seconds"] < 5


_CHANGES = ["--size", "12x8", "--crop", "5x4+6+3", "--filter", "tent:radius=2", "--max-depth", 1]


def test_crop_window_filter_and_depth_replace_the_settings_of_the_scene(run, make_scene, tmp_path):
    def image(path, *options) -> np.ndarray:
        command = ["render", path, "-o", tmp_path / "a.exr", "--integrator", "path", "--spp", 4]
        assert run(*command, *options)[0] == 0
        return np.stack([read_exr(tmp_path / "a.exr")[0][name] for name in "RGB"])

    changed = image(make_scene(), *_CHANGES)
    assert json.loads(read_exr(tmp_path / "a.exr")[1]["changes"]) == {
        "reconstruction filter": "tent:radius=2", "crop window": "5x4+6+3", "maximum depth": "1",
    }  # fmt: skip
    window = {"width": 12, "height": 8, "crop_width": 5, "crop_height": 4, "crop_offset_x": 6,
              "crop_offset_y": 3}  # fmt: skip
    integers = "".join(f'<integer name="{k}" value="{v}"/>' for k, v in window.items())
    text = make_scene().read_text()
    film = f'{integers}<rfilter type="tent"><float name="radius" value="2"/></rfilter>'
    text = re.sub(r'(?s)(<film type="hdrfilm">).*(</film>)', rf"\1{film}\2", text)
    same = tmp_path / "same.xml"
    same.write_text(text.replace('"max_depth" value="3"', '"max_depth" value="1"'))
    assert changed.shape == (3, 4, 5) and np.array_equal(changed, image(same))
    # Also where the sensor has no film, or the film has a crop window already
    without = tmp_path / "without.xml"
    without.write_text(re.sub("(?s)<film.*</film>", "", text))
    assert np.array_equal(changed, image(without, *_CHANGES))
    assert np.array_equal(changed, image(same, *_CHANGES))


@pytest.mark.parametrize(
    "options, words",
    [
        (["--filter", "bxo"], 'unknown reconstruction filter "bxo": use box, tent'),
        (["--filter", "tent:width=2"], '"tent:width=2": Found 1 unreferenced property'),
        (["--filter", "box:"], "expected NAME or NAME:key=value"),
        (["--crop", "5x4"], "expected something like 64x36+100+20"),
        (["--crop", "50x4+0+0"], "the crop window 50x4+0+0 does not fit into the image of "),
        (["--max-depth", "-2"], "is not in the range"),
    ],
)
def test_changes_that_do_not_fit_a_scene_are_refused(run, make_scene, tmp_path, options, words):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", *options)
    assert code == 2 and words in err and err.count("\n") == 1


def test_a_depth_for_an_integrator_without_one_is_refused(run, make_scene, tmp_path):
    scene = make_scene(integrator='<integrator type="depth"/>')
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", "--max-depth", 3)
    assert code == 2 and '"depth" has no maximum depth' in err


def test_a_checkpoint_folder_belongs_to_the_changes_of_its_scene(run, make_scene, tmp_path):
    command = ["render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", "path",
               "--checkpoint", tmp_path / "kept", "--spp", 4, "--filter"]  # fmt: skip
    assert run(*command, "box")[0] == 0
    code, _, err = run(*command, "tent")
    assert code == 2 and '"reconstruction filter" differs (box there, tent here)' in err


@pytest.mark.parametrize("integrator", ["path", "auto", "composed_path"])
def test_a_render_says_how_much_of_the_time_it_used(
    run, make_scene, tmp_path, integrator, monkeypatch
):
    """Our integrators that learn plan for the time; the speed of the others is measured."""
    monkeypatch.setattr(timing, "samples_for", lambda *_: 2)
    command = ["render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", integrator]
    _, out, err = run(*command, "--time", 0.5 if integrator != "composed_path" else 60)
    if integrator == "composed_path":
        assert re.search(r"a.exr: 2 spp in \d+\.\d of 60 s", out + err)
    else:
        assert read_exr(tmp_path / "a.exr")[1]["spp"] > 2


def test_size_of_a_sensor_without_film(make_scene):
    scene = make_scene()
    text = scene.read_text()
    start, end = text.index("<film"), text.index("</film>") + len("</film>")
    scene.write_text(text[:start] + text[end:])
    mi.set_variant("llvm_ad_rgb")
    loaded = load_scene(scene, (10, 4))
    assert loaded.size == (10, 4)
    assert mi.render(loaded.scene, spp=1).shape == (4, 10, 3)


def test_pixels_that_are_not_finite_are_counted(run, make_scene, tmp_path):
    bright = '<emitter type="constant"><rgb name="radiance" value="3e38"/></emitter>'
    scene = make_scene()
    scene.write_text(scene.read_text().replace('<emitter type="constant"/>', bright))
    code, out, err = run("render", scene, "-o", tmp_path / "a.exr")
    assert code == 1 and "a.exr: 4 spp" in out
    assert f"48 of 48 pixels of {tmp_path / 'a.exr'} are NaN or infinite" in err


def test_warnings_name_the_parts_of_a_scene_that_the_image_lacks(run, make_scene, tmp_path):
    """Media, which path does not see; no light; other sensors than the first."""
    second = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="5"/>'
    fog = '<medium type="homogeneous" name="interior"/><bsdf type="null"/>'
    scene = make_scene(body=f'<shape type="cube">{fog}</shape>{second}</film></sensor>')
    scene.write_text(scene.read_text().replace('<emitter type="constant"/>', ""))
    output = tmp_path / "a.exr"
    code, _, err = run("render", scene, "-o", output)
    assert code == 0 and read_exr(output)[0]["R"].shape == (6, 8)
    assert 'participating media, and "path" treats them as absent: use "volpath"' in err
    assert "the scene has no light: the image is black" in err
    assert "the scene has 2 sensors: the first is rendered" in err
    assert err.count("warning") == 3
    arguments = ("--sensor", 1, "--integrator", "volpath", "--spp", 1)
    code, _, err = run("render", scene, "-o", output, *arguments)
    assert code == 0 and read_exr(output)[0]["R"].shape[1] == 5
    assert err.count("warning") == 1 and "no light" in err
    code, _, err = run("render", scene, "-o", output, "-s", 2)
    assert code == 2 and "there is no sensor 2: the scene has 2" in err


@pytest.mark.parametrize(
    "name, words",
    [("path", ["media", "no light"]), ("volpath", ["no light"]), ("volpathmis", ["no light"]),
     ("prbvolpath", ["no light"]), ("depth", []), ("volprim_rf_basic", [])],
)  # fmt: skip
def test_remarks_fit_the_integrators_of_mitsuba(variant, name, words):
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    scene = load_scene({"type": "scene", "sensor": {"type": "perspective"}, "fog": fog})
    remarks = scene_remarks(scene, mi.load_dict({"type": name}), name)
    assert len(remarks) == len(words)
    assert all(word in remark for word, remark in zip(words, remarks))


@pytest.mark.parametrize(("arguments", "words"), [
    (("denoise", ""), "expected a path"), (("diff", "", "b"), "expected a path"),
    (("render", "s.xml", "-o", "a.exr", "--threads", 100000), "not in the range"),
])  # fmt: skip
def test_odd_arguments_are_named(run, arguments, words):
    code, _, err = run(*arguments)
    assert code == 2 and words in err
