"""The examples that are not part of another test do run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


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
