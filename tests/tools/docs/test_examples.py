"""The examples run, unless another test runs them."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mitsuba_ext import compare
from tests.support.furnaces import check_furnace
from tests.support.paths import ROOT
from tests.support.technique import Technique

import mitsuba as mi  # isort: skip

EXAMPLES = ROOT / "examples"


def test_quickstart_runs_in_any_folder(tmp_path, monkeypatch, capsys):
    """All but the render."""
    monkeypatch.setattr(mi, "render", lambda scene, **_: np.ones((2, 4, 3), np.float32))
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "quickstart.py"), run_name="__main__")
    assert (tmp_path / "door_ajar.exr").is_file()
    assert "door_ajar.exr" in capsys.readouterr().out


def test_comparison_runs_in_any_folder(tmp_path, monkeypatch):
    """All but the measurements."""
    seen = []
    monkeypatch.setattr(compare.Comparison, "run", lambda comparison: seen.append(comparison))
    monkeypatch.setattr(compare, "show", lambda results: None)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "compare.py"), run_name="__main__")
    (comparison,) = seen
    assert all(Path(setup.source).is_file() for setup in comparison.scenes)
    assert comparison.folder.resolve() == tmp_path / "out" / "example"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("file", "plugin"), [("nearest_light", "nearest_light"), ("own_learner", "proven_lights")]
)
def test_a_technique_of_ones_own_has_the_exact_radiance(file: str, plugin: str):
    runpy.run_path(str(EXAMPLES / f"{file}.py"))
    technique = Technique("composed_path", {"next_event": {"type": plugin}, "rr_depth": 100})
    check_furnace("furnace_lamps", technique, max_depth=3, precision=0.005)
    assert len((EXAMPLES / f"{file}.py").read_text().splitlines()) < 100


def test_the_page_on_techniques_shows_lines_of_the_example():
    page = (EXAMPLES.parent / "docs" / "add_a_technique.md").read_text(encoding="utf-8")
    example = (EXAMPLES / "nearest_light.py").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    lines = {line for block in blocks for line in block.splitlines() if line.strip(" .")}
    assert blocks and all(line in example for line in lines)


def test_the_page_on_inverse_rendering_shows_lines_of_the_example():
    page = (EXAMPLES.parent / "docs" / "inverse_rendering.md").read_text(encoding="utf-8")
    example = (EXAMPLES / "inverse_rendering.py").read_text(encoding="utf-8")
    loop = page.split("**3.")[1].split("```")[1]
    lines = [line.strip() for line in loop.splitlines() if "optimizer" in line or "loss" in line]
    lines = [line for line in lines if "for key" not in line and "0.4" not in line]
    assert len(lines) > 5 and all(line in example for line in lines)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_colours_are_approached(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "inverse_rendering.py"))["main"](steps=6)
    errors = re.findall(r"rb: an error of (\S+)", capsys.readouterr().out)
    assert len(errors) == 2 and all(0.15 < float(error) < 0.23 for error in errors)
    assert (tmp_path / "inverse_rendering.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("file", ["frames", "denoise"])
def test_other_examples_write_their_images(file: str, tmp_path, monkeypatch):
    if file == "denoise":
        pytest.importorskip("mitsuba_oidn")
    monkeypatch.chdir(tmp_path)
    subprocess.run([sys.executable, EXAMPLES / f"{file}.py"], check=True, timeout=300)
    assert len(list(tmp_path.glob("*.png"))) == {"frames": 8, "denoise": 2}[file]


@pytest.mark.slow
def test_notebook_runs_at_a_small_size(tmp_path):
    notebook = json.loads((EXAMPLES / "compare.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    script = "\n".join(cells)
    # Jupyter is not installed here
    script = script.replace("from IPython.display import IFrame", "IFrame = lambda *_, **__: None")
    script = script.replace("(160, 90)", "(32, 18)").replace("[4, 16, 64]", "[2, 4]")
    script = script.replace('"../out/notebook"', repr(str(tmp_path / "out")))
    path = tmp_path / "notebook.py"
    path.write_text(script, encoding="utf-8")
    result = subprocess.run(
        [sys.executable, path], cwd=EXAMPLES, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert "cut at depth 3" in result.stdout and "standard error of a pixel" in result.stdout
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "depth"), [("six_balls", 2), ("peppers_ghost", 4)])
def test_maps_of_pixels_are_drawn(tmp_path, scene: str, depth: int):
    pytest.importorskip("matplotlib")
    target = tmp_path / "maps.png"
    command = [
        sys.executable, EXAMPLES / "swarm_maps.py", EXAMPLES.parent / f"scenes/{scene}.xml",
        "100,90", "200,50", "--always", "--spp", "8", "--max-depth", str(depth), "--out", target,
    ]  # fmt: skip
    subprocess.run(command, check=True, timeout=300)
    assert target.stat().st_size > 10_000
