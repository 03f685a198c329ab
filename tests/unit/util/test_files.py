"""Files that are replaced in one step."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from mitsuba_ext.util import archives, marks
from mitsuba_ext.util.errors import InputError
from mitsuba_ext.util.files import replacing
from mitsuba_ext.util.stored_arrays import DamagedError


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    file = tmp_path / "a.exr"
    with replacing(file) as temporary:
        temporary.write_text("one")
        assert not file.exists()
    with pytest.raises(KeyboardInterrupt), replacing(file) as temporary:
        temporary.write_text("two")
        raise KeyboardInterrupt
    assert [f.name for f in tmp_path.iterdir()] == ["a.exr"] and file.read_text() == "one"


def test_files_left_by_killed_processes_are_removed(tmp_path):
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


def test_a_link_is_replaced_and_its_target_is_not(tmp_path):
    mine, link = tmp_path / "mine.txt", tmp_path / "a.exr"
    mine.write_text("my text")
    link.symlink_to(mine)
    with replacing(link) as temporary:
        temporary.write_text("image")
    assert mine.read_text() == "my text" and link.read_text() == "image" and not link.is_symlink()


def test_an_error_names_the_file(tmp_path):
    with pytest.raises(OSError, match="No space left on device: .*a.exr"):
        with replacing(tmp_path / "a.exr"):
            raise OSError(28, "No space left on device")
    with pytest.raises(OSError, match="none/a.exr|none"), replacing(tmp_path / "none" / "a.exr"):
        pass


def test_a_small_archive_does_not_fill_the_memory(tmp_path):
    """The archive has 64 KiB: an array is read only if it has the expected shape."""
    file = tmp_path / "a.npz"
    archives.write(file, "something 1", {"counts": np.zeros(1 << 26, np.uint8)})
    assert file.stat().st_size < 1 << 17
    tracemalloc.start()
    stored = archives.read(file, "something 1", "a.npz", "delete it")
    with pytest.raises(DamagedError, match=r"a.npz has been damaged \(the array"):
        stored.take("counts", "u", (10,))
    with pytest.raises(DamagedError, match=r"has the shape \(67108864,\)\): delete it"):
        stored.take("counts", "u", (None,), longest=1 << 20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 23
    with pytest.raises(DamagedError, match="of another version"):
        archives.read(file, "something 2", "a.npz", "delete it")


def test_a_pipe_and_an_endless_file_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", tmp_path):
        with pytest.raises(OSError):
            archives.read_bytes(path)
    (tmp_path / "long").write_bytes(bytes(100))
    with pytest.raises(OSError, match="100 bytes, more than 99"):
        archives.read_bytes(tmp_path / "long", 99)


@pytest.mark.parametrize("make", [
    lambda lock, mine: lock.symlink_to(mine), lambda lock, mine: lock.hardlink_to(mine)
    if hasattr(lock, "hardlink_to") else os.link(mine, lock),
    lambda lock, mine: os.mkfifo(lock), lambda lock, mine: lock.mkdir(),
    lambda lock, mine: lock.write_text("my text"),
])  # fmt: skip
def test_files_that_are_not_locks_are_left_alone(tmp_path, make):
    mine, folder = tmp_path / "mine.txt", tmp_path / "kept"
    mine.write_text("my text")
    folder.mkdir()
    make(folder / ".lock", mine)
    with pytest.raises(InputError, match=r"\.lock: (cannot be used as|is not) "):
        with marks.locked(folder):
            pass
    assert mine.read_text() == "my text" and os.path.lexists(folder / ".lock")


def test_only_marks_are_removed(tmp_path):
    """Marks belong to a comparison; other files with these suffixes belong to somebody else."""
    mark = marks.mark_of(tmp_path / "scene", "path")
    others = [tmp_path / "mine" / "job.running", tmp_path / "mine" / "job.crashed"]
    for file in (mark, mark.with_suffix(".crashed"), *others):
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    with marks.locked(tmp_path):
        pass
    assert mark.exists()
    with marks.in_use(tmp_path):
        pass
    assert all(file.exists() for file in others) and not mark.exists()
    assert not mark.with_suffix(".crashed").exists()
