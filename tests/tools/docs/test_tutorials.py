"""The tutorials (``docs/tutorials``, notebooks as text): their form, and that they run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

FOLDER = ROOT / "docs" / "tutorials"
TUTORIALS = sorted(FOLDER.glob("*.md"))

#: The code of a cell, after its options (lines that begin with a colon).
_CELL = re.compile(
    r"^```\{code-cell\} ipython3\n(?::[^\n]*\n)*\n?(.*?)^```$", re.DOTALL | re.MULTILINE
)


def _cells(tutorial: Path) -> list[str]:
    return _CELL.findall(tutorial.read_text(encoding="utf-8"))


def test_there_are_tutorials() -> None:
    assert len(TUTORIALS) >= 7


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_is_a_short_notebook_with_python_cells(tutorial: Path) -> None:
    text = tutorial.read_text(encoding="utf-8")
    assert text.startswith("---\nfile_format: mystnb\n") and "name: python3" in text
    assert len(text.splitlines()) <= 180
    cells = _cells(tutorial)
    assert len(cells) == text.count("{code-cell}") >= 5
    script = "\n".join(cells)
    compile(script, str(tutorial), "exec")
    assert script.index("import mitsuba_ext") < script.index("import mitsuba as mi")
    assert max(map(len, script.splitlines())) <= 100
    assert "## Where to go next" in text


@pytest.mark.slow
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs_from_top_to_bottom(tutorial: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    script = tmp_path / "tutorial.py"
    script.write_text(
        "import matplotlib\nmatplotlib.use('agg')\n" + "\n".join(_cells(tutorial)), encoding="utf-8"
    )
    before = set(FOLDER.iterdir())
    result = subprocess.run(
        [sys.executable, script], cwd=FOLDER, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert set(FOLDER.iterdir()) == before  # it leaves no files
