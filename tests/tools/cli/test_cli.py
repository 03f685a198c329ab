"""The command line: its output, and its errors for bad input."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from mitsuba_ext import cli
from mitsuba_ext.compare import read_exr
from mitsuba_ext.inputs.names import MITSUBA_INTEGRATORS
from mitsuba_ext.startup import pages
from tests.support.command_line import in_subprocess

# ---- bad input ----

BAD_INPUT = [
    (["render"], "Missing argument 'SCENE'"),
    (["rendr"], "No such command 'rendr'"),
    (["scene.xml"], "'mitsuba-ext render scene.xml -o image.exr' renders this scene"),
    (["help"], "'mitsuba-ext --help' lists the commands"),
    (["render", "{scene}"], "'--output': image to write"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "1e3"], "'1e3' is not a whole number"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--time", "5s"], "'5s' is not a number"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--variant", "llvm_rgb"], 'mean "llvm_ad_rgb"?'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "$sp=8"], 'no parameter $sp: did you mean'),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", "bdpt,max_depth=4"],
        'did you mean "bdpt:max_depth=4"?',
    ),
    (["render", "{tmp}/none.xml", "-o", "{tmp}/a.exr"], "none.xml: no such scene"),
    (["render", "{tmp}", "-o", "{tmp}/a.exr"], "is not a file"),
    (["render", "{scene}"], "Missing option '-o'"),
    (["render", "{scene}", "-o", "{tmp}/a.tiff"], 'the extension ".tiff"'),
    (["render", "{scene}", "-o", "{tmp}/a"], "a name without extension"),
    (["render", "{scene}", "-o", "{tmp}"], "is a folder"),
    (["render", "{scene}", "-o", ""], "'-o' / '--output': expected a path, found \"\""),
    (["render", "{scene}", "-o", "{tmp}/none/a.exr"], "none: no such folder"),
    (["render", "{scene}", "-o", "{scene}/a.exr"], "is not a folder"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "0"], "'--spp': 0"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "100000000000"], "'--spp': 1000"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--integrator", ""], 'integrator "": expected'),
    (
        ["render", "{scene}", "-o", "{tmp}/a.exr", "--spp", "64", "--integrator",
         "neepp:save_learned={tmp}/none/map.npz"],
        '"neepp": "save_learned": {tmp}/none: no such folder',
    ),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--time", "0"], "'--time': 0"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--time", "1", "--spp", "1"], "combined"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--seed", "4294967296"], "'--seed'"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--size", "8"], 'found "8"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "--size", "0x8"], 'found "0x8"'),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "spp"], "expected key=value"),
    (["render", "{scene}", "-o", "{tmp}/a.exr", "-D", "none=1"], "no parameter $none"),
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
        ('<bsdf type="diffuse"/>', '<integrator type="bdpt"/>', 'object "_arg_0": bdpt\n'),
        ('type="independent"', 'type="mis_heuristic"', 'nesting in an integrator, with name="mis"'),
        ('<rfilter type="box"/>', '<string name="filtre" value="box"/>', "unreferenced"),
        ('name="width" value="8"', 'name="width" value="$none"', "$none"),
        ('name="width" value="8"', 'name="width" value="0"', "the film has the width 0"),
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


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have names in UTF-8")
def test_names_of_files_may_have_any_letters_in_any_locale(make_scene, tmp_path):
    folder = tmp_path / "szène ☃"
    folder.mkdir()
    scene = make_scene("szène ☃/büro 1.xml")
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"}
    result = in_subprocess("render", scene, "-o", folder / "ä.exr", env=plain, encoding="utf-8")
    assert result.returncode == 0, result.stderr
    assert "szène ☃/ä.exr: " in result.stdout and (folder / "ä.exr").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have names in UTF-8")
def test_names_that_are_not_utf8_are_refused(run, make_scene, tmp_path, monkeypatch):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/b\xe9d"))
    folder.mkdir()
    scene, named = make_scene(), make_scene(f"{folder.name}/scene.xml")
    for arguments in (
        (named, "-o", "a.exr"), (scene, "-o", folder / "a.png"),
        (scene, "-o", "a.exr", "--integrator", f"neepp:save_learned={folder}/learned.npz"),
    ):  # fmt: skip
        code, _, err = run("render", *arguments)
        assert code == 2 and "b?d" in err and "is not UTF-8" in err and err.count("\n") == 1
    monkeypatch.chdir(folder)
    code, _, err = run("render", "scene.xml", "-o", "a.exr")
    assert code == 2 and "b?d" in err and "is not UTF-8" in err and err.count("\n") == 1


def test_a_closed_terminal_changes_no_exit_code(run, tmp_path, monkeypatch):
    def gone(*_, **__):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(click, "echo", gone)
    assert run("render", tmp_path / "none.xml", "-o", tmp_path / "a.exr")[0] == 2


# ---- list, pages ----


def test_commands_that_only_print_start_without_mitsuba(make_scene, tmp_path):
    """They need no variant, no LLVM, and no packages that are slow to import either."""
    render = ["render", str(make_scene()), "-o", str(tmp_path / "image.exr"), "--integrator"]
    command_lines = [
        ["--help"], ["--version"], ["render", "--help"], ["list"], ["list", "neepp"],
        ["export-blender"],
        ["list", "path"], ["list", "neeep"], [*render, "neeep"], ["render", "none.xml", "-o", "a"],
        ["compare", render[1], "path", "neeep", "--spp=1"],
        [*render, "composed_path:directions=[guided_direction]"], [*render, "learned_lights"],
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
    assert 'nested plugin "guided_direction": did you mean "guided_directions"?' in result.stderr
    assert '"learned_lights" is not an integrator, but a decision to be nested in' in result.stderr


def test_list_names_the_origin_of_a_plugin_or_similar_names(run):
    for name, message in (
        ("path", '"path" is an integrator of Mitsuba\'s own'),
        ("sphere", '"sphere" is a plugin of Mitsuba\'s own'),
        ("neeep", 'no plugin "neeep": did you mean "neepp"?'),
        ("Volpath", 'did you mean "volpath"?'),
        ("something", "(there are: adaptive, auto, auto_path, bdpt, composed_path,"),
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
    from mitsuba_ext.startup import plugin_folders

    code, out, _ = run("list")
    assert code == 0
    assert re.search(r"neepp +│ integrator +│", out)
    assert re.search(r"guided_directions +│ decision +│", out)
    assert re.search(r"sobol_owen +│ sampler +│", out)
    for names in plugin_folders.plugin_names().values():
        for name in names:
            assert name in out
            code, page, _ = run("list", name)
            assert code == 0
            # None of the marks of reStructuredText; stars remain in "cuda_*" and in code
            assert not re.findall(r"``|\*\*|:\w+:`|`_|\|\w+\||^ *\.\. \w+::|\B\*\w", page)


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


def test_stars_of_emphasis_are_removed_except_in_code():
    text = "**Use it\nwhen** it is *very* fast (2 * 3, a_*).\n\n    {**scene, 'a': 2 ** 3, *b}\n"
    assert pages.parse_page("stars", text).text == (
        "Use it\nwhen it is very fast (2 * 3, a_*).\n\n    {**scene, 'a': 2 ** 3, *b}"
    )


@pytest.mark.parametrize("command", ["", *cli.cli.commands])
def test_help_is_plain_and_names_no_file_of_the_sources(run, command):
    code, out, _ = run(*command.split(), "--help")
    assert code == 0
    assert not re.findall(r"`|\*\*|:\w+:`|\bdocs/|\.md\b", out)


def test_page_of_a_plugin_without_docstring_is_empty():
    assert pages.parse_page("bare", "") == pages.Page("bare", "", (), "")


