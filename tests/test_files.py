"""Files that are replaced in one step."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mitsuba_ext.files import replacing


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    file = tmp_path / "a.exr"
    with replacing(file) as temporary:
        temporary.write_text("one")
        assert not file.exists()
    with pytest.raises(KeyboardInterrupt), replacing(file) as temporary:
        temporary.write_text("two")
        raise KeyboardInterrupt
    assert [f.name for f in tmp_path.iterdir()] == ["a.exr"] and file.read_text() == "one"


def test_what_killed_processes_have_left_is_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    file = tmp_path / "a.exr"
    with replacing(file) as temporary:
        temporary.touch()
        own = temporary.name
    names = [own.replace(str(os.getpid()), str(process)) for process in (dead.pid, os.getppid())]
    others = [names[0].replace(".a.", ".b."), f".a.elsewhere-{dead.pid}.exr", ".a.x.exr"]
    for name in (*names, *others):
        (tmp_path / name).write_text("half")
    with replacing(file) as temporary:
        temporary.write_text("whole")
    assert {f.name for f in tmp_path.iterdir()} == {"a.exr", names[1], *others}
