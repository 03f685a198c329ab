"""How many files a reader opens to follow a sample."""

from __future__ import annotations

import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.rendering.render import Job
from tests.support.paths import ROOT

#: The functions that take samples, for the film or to learn from.
_TAKING = {f.__code__ for f in (Job.run_pass, Job._run_scout, Job._run_divided)}


class _Reader:
    """Notes the files of functions that are called while samples are taken."""

    def __init__(self) -> None:
        self.files: set[Path] = set()
        self._depth = 0

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        code: CodeType = frame.f_code
        if event == "call":
            self._depth += code in _TAKING
            if self._depth:
                self.files.add(Path(code.co_filename))
        elif event == "return":
            self._depth -= code in _TAKING


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("name", "spp", "most"),
    [("composed_path", 4, 22), ("neepp", 64, 30), ("vcm", 4, 40), ("auto", 104, 60)],
)
def test_few_files_take_part_in_a_sample(name: str, spp: int, most: int) -> None:
    scene = mi.load_file(str(ROOT / "scenes" / "cornell_box.xml"), width=96, height=54)
    integrator, reader = mi.load_dict({"type": name, "max_depth": 8}), _Reader()
    # Recorded passes call no Python
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        sys.setprofile(reader)
        try:
            mi.render(scene, integrator=integrator, spp=spp)
        finally:
            sys.setprofile(None)
    own = [ROOT / "mitsuba_ext", ROOT / "integrators"]
    files = {str(file) for file in reader.files if any(map(file.is_relative_to, own))}
    # The count is worth nothing if it misses the walk
    assert str(ROOT / "mitsuba_ext" / "transport" / "walk.py") in files
    assert len(files) <= most, "\n".join(sorted(files))
