"""The command line: what it writes, and what it says about bad input."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from conftest import PATH, in_subprocess

from mitsuba_ext import pages, rendering, seed_passes
from mitsuba_ext.cli import stopping
from mitsuba_ext.compare import images, load_scene, read_exr, write_exr
from mitsuba_ext.names import MITSUBA_INTEGRATORS

# ---- render ----


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


@pytest.mark.parametrize("extension", ["png", "jpg", "hdr", "pfm"])
def test_render_writes_other_formats(run, make_scene, tmp_path, extension):
    import mitsuba as mi

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


def test_first_render_says_that_it_compiles(run, make_scene, tmp_path, monkeypatch):
    command = sys.modules["mitsuba_ext.cli.render"]
    # Before the scene is loaded, after that, after the render
    for counts, before, after in (((5, 7, 8), True, False), ((5, 5, 8), False, True),
                                  ((5, 5, 5), False, False)):  # fmt: skip
        steps = iter(counts)
        monkeypatch.setattr(command, "kernels_compiled", lambda steps=steps: next(steps))
        code, out, err = run("render", make_scene(), "-o", tmp_path / "a.exr")
        assert code == 0 and err.startswith("compiling kernels") == before
        assert ("kernels were compiled" in out) == after


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


def test_size_of_a_sensor_without_film(make_scene):
    scene = make_scene()
    text = scene.read_text()
    start, end = text.index("<film"), text.index("</film>") + len("</film>")
    scene.write_text(text[:start] + text[end:])
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    loaded = load_scene(scene, (10, 4))
    assert loaded.size == (10, 4)
    assert mi.render(loaded.scene, spp=1).shape == (4, 10, 3)


@pytest.fixture
def interrupted_integrator():
    """An integrator that Ctrl-C ends after the image (seed 0) or before it (other seeds)."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))

    class Interrupted(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if seed == 0:
                super().render(scene, sensor, seed, spp, develop, evaluate)
            raise KeyboardInterrupt

    mi.register_integrator("interrupted", lambda props: Interrupted(props))
    return "interrupted"


def test_interrupted_render_writes_what_the_film_holds(
    run, make_scene, tmp_path, interrupted_integrator
):
    output = tmp_path / "image.exr"
    arguments = ("render", make_scene(), "-o", output, "--integrator", interrupted_integrator)
    code, _, err = run(*arguments)
    assert code == 130
    assert err == f"interrupted during the render: {output}\n"
    assert read_exr(output)[0]["R"].shape == (6, 8)


@pytest.mark.parametrize("when", [("--seed", "1"), ("--time", "5")])
def test_render_interrupted_before_its_first_pass_leaves_an_older_file_alone(
    run, make_scene, tmp_path, interrupted_integrator, when
):
    output = tmp_path / "image.exr"
    output.write_bytes(b"older")
    arguments = ("render", make_scene(), "-o", output, "--integrator", interrupted_integrator)
    code, _, err = run(*arguments, *when)
    assert code == 130
    assert err.count("\n") == 1 and "nothing written" in err
    assert output.read_bytes() == b"older"


@pytest.mark.parametrize(
    "integrator, module, job",
    [("path", seed_passes, "SeedPasses"), ("composed_path", rendering, "_Job")],
)
@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_the_render_after_a_pass_and_keeps_an_older_image(
    run, make_scene, tmp_path, monkeypatch, integrator, module, job, name, code
):
    """In passes of 4 samples, of which the third is interrupted."""
    monkeypatch.setattr(module, "_PASS_SAMPLES", {dr.JitBackend.LLVM: 4 * 8 * 6})
    monkeypatch.setattr(module, "_PASS_SPP", 1)
    run_pass, passes = getattr(module, job)._run_pass, []

    def interrupted(self, *arguments):
        passes.append(self)
        if len(passes) % 3 == 0:
            os.kill(os.getpid(), getattr(signal, name))
        return run_pass(self, *arguments)

    monkeypatch.setattr(getattr(module, job), "_run_pass", interrupted)
    output, partial = tmp_path / "image.exr", tmp_path / "image.partial.exr"
    arguments = ("render", make_scene(), "-o", output, "--integrator", integrator, "--spp", 40)
    for target in (output, partial):
        found, _, err = run(*arguments)
        assert found == code
        assert f"interrupted after 12 of 40 spp: {target}" in err
        metadata = read_exr(target)[1]
        assert (metadata["spp"], metadata["interrupted"]) == (12, "true")
    assert f"{output} is an older image" in err
    assert sorted(tmp_path.iterdir()) == [output, partial, tmp_path / "scene.xml"]
    assert run(*arguments[:-1], 12)[0] == 0, "the last pass had all samples"
    assert read_exr(output)[1]["interrupted"] == "false"


def test_a_second_signal_ends_the_process_whatever_runs(run, make_scene, tmp_path, monkeypatch):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))
    exits: list[int] = []

    class Stubborn(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            while not exits:
                with contextlib.suppress(KeyboardInterrupt):
                    os.kill(os.getpid(), signal.SIGINT)
                    time.sleep(0.01)
            raise KeyboardInterrupt

    mi.register_integrator("stubborn", lambda props: Stubborn(props))
    monkeypatch.setattr(stopping, "_TOGETHER", 0.02)
    monkeypatch.setattr(os, "_exit", exits.append)
    arguments = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", "stubborn")
    assert run(*arguments)[0] == 130 and exits[0] == 130
    assert not (tmp_path / "a.exr").exists()


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
        raise OSError("No space left on device")

    monkeypatch.setattr(images, "write_film", full_disk)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "b.exr")
    assert code == 2 and "b.exr: cannot be written (No space left on device)" in err
    assert not list(tmp_path.glob("b*"))


def test_pixels_that_are_not_finite_are_counted(run, make_scene, tmp_path):
    bright = '<emitter type="constant"><rgb name="radiance" value="3e38"/></emitter>'
    scene = make_scene()
    scene.write_text(scene.read_text().replace('<emitter type="constant"/>', bright))
    code, out, err = run("render", scene, "-o", tmp_path / "a.exr")
    assert code == 1 and "a.exr: 4 spp" in out
    assert f"48 of 48 pixels of {tmp_path / 'a.exr'} are NaN or infinite" in err


def test_what_the_image_does_not_show_is_said(run, make_scene, tmp_path):
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


# ---- bad input ----

BAD_INPUT = [
    (["render"], "Missing argument 'SCENE'"),
    (["rendr"], "No such command 'rendr'"),
    (["render", "{tmp}/none.xml", "-o", "{tmp}/a.exr"], "none.xml: no such scene"),
    (["render", "{tmp}", "-o", "{tmp}/a.exr"], "is not a file"),
    (["render", "{scene}"], "Missing option '-o'"),
    (["render", "{scene}", "-o", "{tmp}/a.tiff"], 'the extension ".tiff"'),
    (["render", "{scene}", "-o", "{tmp}/a"], "a name without extension"),
    (["render", "{scene}", "-o", "{tmp}"], "is a folder"),
    (["render", "{scene}", "-o", "{tmp}/none/a.exr"], "none: no such folder"),
    (["render", "{scene}", "-o", "{scene}/a.exr"], "is not a folder"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "0"], "'--spp': 0"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "100000000000"], "'--spp': 1000"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", ""], 'integrator "": expected'),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "64", "--integrator",
         "neepp:save_map={tmp}/none/map.npz"],
        '"neepp": "save_map": {tmp}/none: no such folder',
    ),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--time", "0"], "'--time': 0"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--time", "1", "--spp", "1"], "exclude"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--seed", "4294967296"], "'--seed'"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--size", "8"], 'found "8"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--size", "0x8"], 'found "0x8"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "spp"], "expected key=value"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "none=1"], "none=1"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "spp=many"], '"many"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--variant", "none"], 'unknown variant "none"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "none"], 'integrator "none"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "diffuse"], "not an integrator"),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "path:none=1"],
        'integrator "path" has no parameter "none"',
    ),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "path:max_depth=few"],
        '"max_depth" has the wrong type',
    ),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "path:max_depth=-7"],
        '"max_depth" must be',
    ),
    (["compare", "{scene}", "--spp", "1"], "Missing argument 'INTEGRATOR"),
    (["compare", "{scene}", "path"], "give one of --spp, --time, --sweep, --until"),
    (["compare", "{scene}", "path", "--spp", "1", "--time", "1"], "give one of"),
    (["compare", "{scene}", "path", "--sweep", "4,x"], 'found "4,x"'),
    (["compare", "{scene}", "path", "--until", "0"], "'--until': 0"),
    (["compare", "path", "--spp", "1"], "no scene was given"),
    (["compare", "{scene}", "{tmp}/none.xml", "path", "--spp", "1"], "none.xml: no such scene"),
    (["compare", "{scene}", "{tmp}/none.json", "--spp", "1"], "none.json: no such file"),
    (["compare", "{scene}", "path", "--spp", "1", "--plugin", "no_such_module"], "no_such_module"),
    (["compare", "{scene}", "path", "--spp", "0"], "'--spp': 0"),
    (["compare", "{scene}", "path", "--spp", "1", "--seeds", "0"], "'--seeds': 0"),
    (["compare", "{scene}", "path", "path", "--spp", "1"], "given twice"),
    (["compare", "{scene}", "none", "--spp", "1"], 'integrator "none"'),
    (["compare", "{scene}", "path", "--spp", "1", "--reference-spp", "4"], "'--reference-spp'"),
    (["compare", "{scene}", "path", "--spp", "1", "--reference", "{tmp}/none.exr"], "no such file"),
    (["compare", "{scene}", "path", "--spp", "1", "--reference", "{scene}"], "unreadable"),
    (["compare", "{scene}", "path", "--spp", "1", "--out", "{scene}"], "cannot make this folder"),
    (["list", "none"], 'no plugin "none"'),
]


@pytest.mark.parametrize("arguments, message", BAD_INPUT, ids=lambda value: str(value)[-60:])
def test_bad_input_is_one_line_and_exit_code_2(run, make_scene, tmp_path, arguments, message):
    scene = make_scene()
    before = sorted(tmp_path.iterdir())
    arguments = [text.format(scene=scene, tmp=tmp_path) for text in arguments]
    code, out, err = run(*arguments)
    assert code == 2
    assert out == ""
    assert message.format(tmp=tmp_path) in err
    assert err.count("\n") == 1 and err.startswith("mitsuba-ext: ")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("</scene>", "", "tag"),
        ("<scene", "<bsdf", "tag"),
        ("8", "wide", "wide"),
        ('type="sphere"', 'type="sphre"', 'Plugin "sphre" not found'),
        ('type="sphere"', 'type="ply"', "filename"),
        ('<float name="fov"', '<float name="fovv"', "unreferenced"),
        ('<rfilter type="box"/>', '<string name="filtre" value="box"/>', "unreferenced"),
        ('name="width" value="8"', 'name="width" value="$none"', "$none"),
        (PATH, "", "no integrator"),
    ],
)
def test_broken_scene_is_one_line_that_names_the_file(
    run, make_scene, tmp_path, old, new, message
):
    scene = make_scene()
    scene.write_text(scene.read_text().replace(old, new, 1))
    output = tmp_path / "image.exr"
    output.write_bytes(b"older")
    code, _, err = run("render", scene, "-o", output)
    assert code == 2
    assert message in err and str(scene) in err
    assert err.count("\n") == 1
    assert output.read_bytes() == b"older"


def test_size_of_a_film_with_crop_window_is_refused(run, make_scene, tmp_path):
    crop = "".join(
        f'<integer name="crop_{key}" value="{value}"/>'
        for key, value in (("offset_x", 1), ("offset_y", 1), ("width", 4), ("height", 3))
    )
    scene = make_scene(film=crop)
    code, _, err = run("render", scene, "-o", tmp_path / "a.exr", "--size", "9x9")
    assert code == 2 and "crop window" in err
    assert run("render", scene, "-o", tmp_path / "a.exr")[0] == 0
    assert read_exr(tmp_path / "a.exr")[0]["R"].shape == (3, 4)


def test_no_traceback_from_the_process(tmp_path):
    result = in_subprocess("render", tmp_path / "none.xml", "-o", tmp_path / "a.exr")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and "none.xml" in result.stderr


# ---- list, pages ----


def test_what_only_prints_starts_without_mitsuba(make_scene, tmp_path):
    """Nor does it need a variant, LLVM, or the packages that are slow to import."""
    render = ["render", str(make_scene()), "-o", str(tmp_path / "image.exr"), "--integrator"]
    command_lines = [
        ["--help"], ["--version"], ["render", "--help"], ["list"], ["list", "neepp"],
        ["list", "path"], ["list", "neeep"], [*render, "neeep"], ["render", "none.xml", "-o", "a"],
        ["compare", render[1], "path", "neeep", "--spp=1"],
    ]  # fmt: skip
    code = f"""
import sys
from mitsuba_ext import cli
for command_line in {command_lines}:
    cli.main(command_line)
    for name in ("mitsuba", "drjit", "scipy", "matplotlib"):
        assert name not in sys.modules, (command_line, name)
assert "rich" in sys.modules
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("Usage:") == 2
    assert result.stderr.count('unknown integrator "neeep": did you mean "neepp"?') == 2


def test_list_says_whose_plugin_a_name_is_or_what_it_may_have_meant(run):
    for name, message in (
        ("path", '"path" is an integrator of Mitsuba\'s own'),
        ("sphere", '"sphere" is a plugin of Mitsuba\'s own'),
        ("neeep", 'no plugin "neeep": did you mean "neepp"?'),
        ("Volpath", 'did you mean "volpath"?'),
        ("something", "(there are: composed_path,"),
    ):
        code, out, err = run("list", name)
        assert (code, out) == (2, "") and message in err, err


def test_every_integrator_of_mitsuba_is_known_by_name(variant):
    import mitsuba as mi

    refused = []
    for name in MITSUBA_INTEGRATORS:
        if name == "aov":  # ends the process where it has no parameters
            continue
        try:
            made = mi.PluginManager.instance().create_object(mi.Properties(name))
            assert isinstance(made, mi.Integrator)
        except RuntimeError as error:
            refused.append(name)
            assert "not found" not in str(error)
    assert set(refused) <= {"moment", "stokes"}  # which nest others
    files = Path(mi.__file__).parent / "python" / "ad" / "integrators"
    python = {file.stem for file in files.glob("*.py")} - {"__init__", "common"}
    assert python <= set(MITSUBA_INTEGRATORS)


def test_list_shows_every_plugin(run):
    from mitsuba_ext import registry

    code, out, _ = run("list")
    assert code == 0
    for names in registry.plugin_names().values():
        for name in names:
            assert name in out
            assert run("list", name)[0] == 0


def test_page_is_read_from_the_docstring():
    page = pages.parse_page(
        "fancy",
        r"""
        .. _integrator-fancy:

        Fancy light transport (:monosp:`fancy`)
        ---------------------------------------

        .. pluginparameters::

         * - max_depth
           - |int|
           - Longest path, -1 for :math:`\infty`. A value of
             1 shows lights only. (Default: -1)

         * - model
           - |string|
           - Either ``a`` (the
             first) or ``b``.

        It is fancy. It is
        new.

        Use it rarely.

        .. tabs::
            .. code-tab:: python

                'type': 'fancy'
        """,
    )
    assert page.title == "Fancy light transport (fancy)"
    assert page.parameters == (
        pages.Parameter("max_depth", "int", "-1", "Longest path, -1 for ∞. A value of 1 shows "
                        "lights only."),
        pages.Parameter("model", "string", "", "Either a (the first) or b."),
    )
    assert page.summary == "It is fancy. It is new."
    assert "Use it rarely." in page.text and "'type': 'fancy'" in page.text
    assert "pluginparameters" not in page.text and "tab" not in page.text


def test_page_of_a_plugin_without_docstring_is_empty():
    assert pages.parse_page("bare", "") == pages.Page("bare", "", (), "")


