"""Somebody can delete a technique: its folder, its row in the table of slots, its plugins and its
tests. Everything else works without it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

_FOLDERS = (
    "mitsuba_ext", "integrators", "emitters", "bsdfs", "samplers", "sensors", "shapes", "tests",
)  # fmt: skip

#: What renders in the copy.
_RENDERS = """
import numpy as np
import mitsuba_ext
import mitsuba as mi

assert mitsuba_ext.__file__.startswith(FOLDER), mitsuba_ext.__file__
mi.set_variant("llvm_ad_rgb")
box = mi.cornell_box()
box["sensor"]["film"] = {"type": "hdrfilm", "width": 8, "height": 8}
scene = mi.load_dict(box)
for plugin in (
    {"type": "auto"}, {"type": "composed_path", "next_event": "power", "mis": "balance"},
    {"type": "bdpt", "light_paths": "auto"}, {"type": "composed_prb"},
):
    image = np.array(mi.load_dict({**plugin, "max_depth": 4}).render(scene, spp=16))
    assert np.isfinite(image).all() and image.sum() > 0, plugin
"""


def _without(technique: str, folder: Path) -> None:
    """Copies the sources, without everything that belongs to a technique."""
    ignored = shutil.ignore_patterns("__pycache__", "references")
    for name in _FOLDERS:
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    shutil.rmtree(folder / "mitsuba_ext" / "techniques" / technique)
    shutil.rmtree(folder / "tests" / "unit" / "techniques" / technique, ignore_errors=True)
    for plugins in ("integrators", "samplers"):
        for file in (folder / plugins).glob("*.py"):
            if f"mitsuba_ext.techniques.{technique}" in file.read_text(encoding="utf-8"):
                file.unlink()
    table = folder / "mitsuba_ext" / "bases" / "slots.py"
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    table.write_text("".join(line for line in lines if technique not in line), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "technique", ["swarming", "learned_lights", "guided_directions", "portal_lights"]
)
def test_everything_else_works_without_a_technique(tmp_path: Path, technique: str) -> None:
    _without(technique, tmp_path)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    code = f"FOLDER = {str(tmp_path)!r}\n{_RENDERS}"
    for command in (
        [sys.executable, "-c", code],
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider",
         "tests/tools/test_architecture.py"],
    ):  # fmt: skip
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
