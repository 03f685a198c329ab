"""The command line: what it writes, and what it says about bad input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext import cli, pages
from mitsuba_ext.compare import InputError, load_reference, load_scene, read_exr, write_exr
from mitsuba_ext.scenes import make_integrator, parse_integrator

SCENE = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  {integrator}
  <sensor type="perspective">
    <float name="fov" value="45"/>
    <film type="hdrfilm">
      <integer name="width" value="8"/>
      <integer name="height" value="6"/>
      <rfilter type="box"/>
      {film}
    </film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
  <emitter type="constant"/>
  {body}
</scene>
"""

SPHERE = """<shape type="sphere">
    <transform name="to_world"><translate z="5"/></transform>
    <bsdf type="diffuse"/>
  </shape>"""

PATH = '<integrator type="path"><integer name="max_depth" value="3"/></integrator>'


@pytest.fixture
def make_scene(tmp_path):
    def make(name="scene.xml", integrator=PATH, film="", body=SPHERE) -> Path:
        path = tmp_path / name
        path.write_text(SCENE.format(integrator=integrator, film=film, body=body))
        return path

    return make


@pytest.fixture
def run(capsys):
    """Runs the command in this process; returns the exit code, stdout and stderr."""

    def command(*arguments) -> tuple[int, str, str]:
        code = cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return command


def in_subprocess(*arguments, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "mitsuba_ext.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)


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
    assert err == f"interrupted: {output} has the samples so far\n"
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
    (["compare", "{scene}", "path"], "Missing option '--spp'"),
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
    assert message in err
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


# ---- compare ----


def test_compare_writes_table_results_and_images(run, make_scene, tmp_path):
    out = tmp_path / "results"
    arguments = ("compare", make_scene(), "path", "prb:rr_depth=9", "--spp", 4, "--out", out)
    code, text, err = run(*arguments, "--seeds", 2, "--reference-spp", 256)
    assert (code, err) == (0, "")
    assert "prb:rr_depth=9" in text and "1.00x" in text

    results = json.loads((out / "results.json").read_text())
    assert results["schema"] == 1
    assert results["seeds"] == [0, 1]
    assert results["scene"]["size"] == [8, 6]
    first, second = results["integrators"]
    assert first["parameters"] == {"max_depth": 3, "rr_depth": 5}
    assert second["parameters"] == {"max_depth": 3, "rr_depth": 9}
    assert first["efficiency_ratio"] == pytest.approx(1)
    assert len(second["runs"]) == 2
    assert second["runs"][1]["spp"] == 4
    # prb is path with other roulette, which a depth of 3 does not reach: the same numbers
    assert second["summary"]["relmse"]["mean"] == pytest.approx(
        first["summary"]["relmse"]["mean"], rel=0.05
    )
    assert results["reference"]["noise"] > 0

    channels, metadata = read_exr(out / second["runs"][1]["image"])
    assert channels["G"].shape == (6, 8)
    assert (metadata["integrator"], metadata["seed"], metadata["spp"]) == ("prb", 1, 4)


def test_rendered_reference_is_kept_until_the_scene_changes(run, make_scene, tmp_path):
    out = tmp_path / "results"
    scene = make_scene()

    def references() -> dict[str, int]:
        run("compare", scene, "path", "--spp", 1, "--seeds", 1, "--reference-spp", 32, "--out", out)
        return {path.name: path.stat().st_mtime_ns for path in out.glob("*32spp*.exr")}

    first = references()
    assert len(first) == 1
    assert references() == first
    scene.write_text(scene.read_text().replace('z="5"', 'z="6"'))
    assert len(references()) == 2


def test_rendered_reference_has_the_mean_and_its_variance(run, make_scene, tmp_path):
    scene = make_scene()
    command = ("compare", scene, "path", "--spp", 1, "--seeds", 1, "--out", tmp_path)
    assert run(*command, "--reference-spp", 512)[0] == 0
    reference = load_reference(next(tmp_path.glob("*512spp*.exr")))
    # The background is exact; the sphere is not
    assert reference.mean[0, 0] == pytest.approx(1)
    assert reference.variance[0, 0] == pytest.approx(0, abs=1e-10)
    assert reference.variance.max() > 1e-6


def test_plain_rgb_reference_is_accepted(run, make_scene, tmp_path):
    path = tmp_path / "plain.exr"
    write_exr(path, np.ones((6, 8, 3)), "RGB", {})
    command = ("compare", make_scene(), "path", "--spp", 4, "--seeds", 1, "--out", tmp_path / "o")
    code, out, _ = run(*command, "--reference", path)
    assert code == 0 and "variance unknown" in out


@pytest.mark.parametrize(
    "pixels, channels, message",
    [
        (np.ones((5, 8, 3)), "RGB", "8x5, but the scene renders 8x6"),
        (np.ones((6, 8, 1)), "Y", "found Y"),
        (np.zeros((6, 8, 3)), "RGB", "black"),
        (np.full((6, 8, 3), np.nan), "RGB", "48 of 48 pixels not finite"),
    ],
)
def test_unfit_reference_is_refused(run, make_scene, tmp_path, pixels, channels, message):
    path = tmp_path / "reference.exr"
    write_exr(path, pixels, channels, {})
    out = tmp_path / "o"
    code, _, err = run(
        "compare", make_scene(), "path", "--spp", 4, "--reference", path, "--out", out
    )
    assert code == 2
    assert message in err and str(path) in err and err.count("\n") == 1
    assert not out.exists()


def test_truncated_reference_is_one_line(make_scene, tmp_path):
    path = tmp_path / "reference.exr"
    write_exr(path, np.random.default_rng(0).random((6, 8, 3)), "RGB", {})
    path.write_bytes(path.read_bytes()[:-200])
    scene = make_scene()
    # In a process of its own: libraries write to the terminal past Python
    result = in_subprocess(
        "compare", scene, "path", "--spp", "1", "--reference", path, "--out", tmp_path / "o"
    )
    assert result.returncode == 2
    assert result.stdout == "" and result.stderr.count("\n") == 1
    assert f"{path}: unreadable" in result.stderr


def test_failing_integrator_is_a_row_and_does_not_stop_the_others(run, make_scene, tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))

    class Fails(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
            return image * float("nan") if seed == 1 else image

    mi.register_integrator("fails_at_seed_1", lambda props: Fails(props))
    code, out, _ = run(
        "compare", make_scene(), "path", "fails_at_seed_1", "--spp", 2, "--out", tmp_path
    )
    assert code == 1
    assert "seed 1: 48 of 48 pixels not finite" in out
    path, fails = json.loads((tmp_path / "results.json").read_text())["integrators"]
    assert (len(path["runs"]), len(fails["runs"])) == (3, 1)
    assert fails["error"] and fails["efficiency"] is None


# ---- list, specifications, pages ----


def test_list_and_help_need_neither_variant_nor_llvm():
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": "/none/libLLVM.so"}
    for arguments in (["list"], ["--help"], ["render", "--help"], ["--version"]):
        result = in_subprocess(*arguments, env=environment)
        assert result.returncode == 0, result.stderr
        assert result.stdout  # on stderr, Dr.Jit itself may complain about LLVM


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


def test_integrator_specification():
    assert parse_integrator("path") == ("path", {})
    name, parameters = parse_integrator("x:a=1,b=0.5,c=true,d=false,e=1e-3,f=mean")
    assert name == "x"
    assert parameters == {"a": 1, "b": 0.5, "c": True, "d": False, "e": 1e-3, "f": "mean"}
    assert [type(value) for value in parameters.values()] == [int, float, bool, bool, float, str]


@pytest.mark.parametrize(
    "text", ["", ":", "path:", "path:a", "path:=1", "path:a=", "a b", "x:a=1,a=2"]
)
def test_malformed_specification_is_refused(text):
    with pytest.raises(InputError, match="integrator"):
        parse_integrator(text)


def test_depth_is_inherited_where_the_integrator_knows_it(make_scene):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    loaded = load_scene(make_scene())
    assert loaded.depth == {"max_depth": 3, "rr_depth": 5}
    assert make_integrator("prb", {"max_depth": 7}, loaded.depth)[1]["max_depth"] == 7
    assert make_integrator("direct", {}, loaded.depth)[1] == {}
    unlimited = load_scene(make_scene("b.xml", integrator='<integrator type="path"/>'))
    assert unlimited.depth["max_depth"] == -1
    nested = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH}</integrator>'
    assert load_scene(make_scene("c.xml", integrator=nested)).depth["max_depth"] == 3
