"""``mitsuba-ext doctor`` without its renders."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import mitsuba_ext
from mitsuba_ext.startup import doctor, plugin_folders

pytestmark = pytest.mark.usefixtures("variant")


def test_integrators_that_wrap_others_are_tried_around_one_of_ours():
    for name in plugin_folders.plugin_names()["integrators"]:
        if name == "reweighted_wavelength":
            with pytest.raises(RuntimeError, match="use a spectral one"):
                doctor._make(name)
            continue
        label, integrator = doctor._make(name)
        wraps = name in (
            "adaptive", "ecoc_dof", "variance", "reweighted_lens", "reweighted_time",
        )  # fmt: skip
        assert label == (f"{name} around composed_path" if wraps else name)
        assert integrator.name == name


def test_each_result_is_one_line():
    refused = {"name": "variance", "refused": '"variance": what it needs'}
    assert doctor._line(refused) == 'variance: not tried: "variance": what it needs'
    result = {"name": "neepp", "label": "neepp", "mean": 0.5, "seconds": 1.0, "finite": True}
    assert doctor._line(result) == "neepp: mean 0.5000, 1.00 s"
    assert doctor._line({**result, "finite": False}).startswith("! not finite")
    assert doctor._line({"name": "neepp", "error": "why"}) == "! neepp: why"


def test_process_that_says_nothing_is_an_error(monkeypatch):
    monkeypatch.setattr(doctor, "python_command", lambda *_: [sys.executable, "-c", "pass"])
    (result,) = doctor._render_elsewhere("llvm_ad_rgb", ["neepp", "path"], 60)
    assert result == {"name": "neepp", "error": "its process ended with exit code 0"}


def test_report_tells_which_copy_of_the_package_runs(monkeypatch, run):
    monkeypatch.setattr(doctor, "tiny_renders", lambda _variant: iter(["neepp: fine"]))
    code, out, _ = run("doctor")
    folder = Path(mitsuba_ext.__file__).parent
    assert f"mitsuba_ext {mitsuba_ext.__version__} ({folder})" in out
    assert (code, "Everything works." in out) in ((0, True), (1, False))
    monkeypatch.setattr(doctor, "tiny_renders", lambda _variant: iter(["! neepp: trouble"]))
    code, out, _ = run("doctor")
    assert code == 1 and "Lines that start with ! need attention." in out
