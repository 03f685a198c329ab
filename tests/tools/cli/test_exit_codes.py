"""The exit codes of each subcommand agree with the table in docs/command.md."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import cli
from mitsuba_ext.cli import supervisor
from mitsuba_ext.compare import write_exr
from mitsuba_ext.compare.experiment import Experiment
from mitsuba_ext.images import denoising, image_files
from mitsuba_ext.inputs.chosen import LastScene
from mitsuba_ext.rendering.seed_passes import SeedPasses
from mitsuba_ext.startup import doctor
from mitsuba_ext.util.errors import InputError
from tests.support.command_line import in_subprocess
from tests.support.paths import ROOT

pytestmark = pytest.mark.usefixtures("variant")

PAGE = ROOT / "docs" / "command.md"



def documented() -> dict[str, set[int]]:
    """The codes of each subcommand, as the page says."""
    rows = re.findall(r"^\| `([a-z-]+)` \|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    columns = (0, 1, 2, 130, 143, 129)
    return {
        name: {code for code, cell in zip(columns, cells.split("|")) if cell.strip() != "–"}
        for name, cells in rows
    }


def test_the_page_names_all_subcommands():
    assert set(documented()) == set(cli.cli.commands)


@pytest.fixture
def exits(run, tmp_path):
    """Checks the codes of calls against what the page says of their subcommand."""

    def check(name: str, *calls: tuple[int, tuple]) -> None:
        for code, arguments in calls:
            found, _, err = run(name, *arguments)
            assert found == code and code in documented()[name], (arguments, found, err)

    return check


@pytest.fixture
def image(tmp_path) -> Path:
    write_exr(tmp_path / "image.exr", np.ones((4, 5, 3), np.float32), "RGB", {})
    return tmp_path / "image.exr"


def test_render(exits, make_scene, tmp_path, monkeypatch):
    target = ("-o", tmp_path / "a.exr", "--spp", 4)
    exits("render", (0, (make_scene(), *target)), (2, (tmp_path / "no.xml", *target)))
    monkeypatch.setattr(image_files, "count_non_finite", lambda film: (3, 48))
    exits("render", (1, (make_scene(), *target)))
    run_pass = SeedPasses._run_pass
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)):

        def signalled(self, spp, number=number):
            os.kill(os.getpid(), number)
            return run_pass(self, spp)

        monkeypatch.setattr(SeedPasses, "_run_pass", signalled)
        exits("render", (code, (make_scene(), "-o", tmp_path / "a.exr", "--spp", 1 << 16)))


def test_a_signal_while_the_scene_is_loaded(exits, make_scene, tmp_path, monkeypatch):
    """Mitsuba would report what the signal interrupts as an error of a plugin, or not at all."""
    target, set_variant = ("-o", tmp_path / "a.exr"), mi.set_variant
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)):

        def loads(*variants, number=number):
            try:
                os.kill(os.getpid(), number)
                set_variant(*variants)
            except KeyboardInterrupt as error:
                raise ImportError("an error while initializing the extension") from error

        def instantiated(*_, number=number, **__):
            try:
                os.kill(os.getpid(), number)
                signal.sigtimedwait([], 0)
            except KeyboardInterrupt as error:
                raise InputError("failed to instantiate a plugin") from error

        with monkeypatch.context() as patch:
            patch.setattr(mi, "set_variant", loads)
            exits("render", (code, (make_scene(), *target)))
        with monkeypatch.context() as patch:
            patch.setattr(LastScene, "choose", instantiated)
            exits("render", (code, (make_scene(), *target)))
    assert not (tmp_path / "a.exr").exists()


def test_merge(exits, run, make_scene, tmp_path):
    for seed in "12":
        assert run("render", make_scene(), "-o", tmp_path / "a.exr", "--seed", seed, "--spp", 4,
                   "--checkpoint", tmp_path / seed)[0] == 0  # fmt: skip
    folders = (tmp_path / "1", tmp_path / "2", "-o", tmp_path / "both")
    exits("merge", (0, folders), (2, folders))


def test_denoise(exits, image, tmp_path, monkeypatch):
    monkeypatch.setattr(denoising, "denoiser", lambda: None)
    monkeypatch.setattr(denoising, "denoise_file", lambda *_: [])
    exits("denoise", (0, (image,)), (2, (image, "-o", image)))

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(denoising, "denoise_file", interrupted)
    exits("denoise", (130, (image,)))


def test_compare(exits, make_scene, tmp_path, monkeypatch, without_report):
    options = ("--spp", 2, "--seeds", 1, "--reference-spp", 64, "--out", tmp_path / "out")
    exits("compare", (0, (make_scene(), "path", *options)), (2, (make_scene(), "path")))
    # A scene that is broken, beside one that is not
    broken = make_scene("broken.xml", body="<shape type='nothing'/>")
    exits("compare", (1, (make_scene(), broken, "path", *options)))

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Experiment, "_take", interrupted)
    exits("compare", (130, (make_scene(), "path", *options, "--seeds", 2)))
    # SIGTERM and SIGHUP: tests/tools/cli/test_supervisor.py
    assert {143, 129} <= documented()["compare"] and supervisor.GRACE


def test_the_others(exits, image, tmp_path, monkeypatch):
    exits("diff", (0, (image, image)), (2, (image, tmp_path / "no.exr")))
    exits("list", (0, ()), (0, ("neepp",)), (2, ("nothing",)))
    exits("completion", (0, ("bash",)), (2, ("tcsh",)))
    exits("export-blender", (0, ()), (2, ("-o", tmp_path / "no" / "integrators.json")))
    for code in (0, 1):
        monkeypatch.setattr(doctor, "main", lambda code=code: code)
        exits("doctor", (code, ()))
    exits("doctor", (2, ("--nothing",)))


def test_a_request_to_save_is_ignored_from_the_start():
    """SIGUSR1 would end the process while Mitsuba is imported."""
    code = (
        "import signal, sys; from mitsuba_ext.__main__ import main; sys.argv = ['', '--version']; "
        "code = main(); assert signal.getsignal(signal.SIGUSR1) is signal.SIG_IGN; "
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler; sys.exit(code)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.slow
def test_processes_have_these_codes_too(make_scene, tmp_path):
    scene = make_scene()
    assert in_subprocess("render", scene, "-o", tmp_path / "a.exr").returncode == 0
    assert in_subprocess("render", scene, "-o", tmp_path / "a.nothing").returncode == 2
    assert in_subprocess("diff", scene, scene).returncode == 2
    assert in_subprocess("nothing").returncode == 2
    assert in_subprocess().returncode == 2
