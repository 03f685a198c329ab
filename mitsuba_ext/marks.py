"""Marks in the folder of a comparison, which outlive the process that sets them: what it was making
when it died, and that the folder is in use."""

from __future__ import annotations

import contextlib
import os
import re
import uuid
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from .errors import InputError
from .files import make_folder

try:
    import fcntl
except ImportError:  # not on Windows: nothing is locked there
    fcntl = None

#: Suffixes of the mark of an integrator whose run (or a reference) is being made, with the process
#: that makes it inside, and after that process died, with the reason inside.
_RUNNING = ".running"
_CRASHED = ".crashed"

_LOCK = ".lock"

#: Tells the processes of one session from others. A supervisor hands its own on to its workers.
SESSION_VARIABLE = "MITSUBA_EXT_SESSION"
SESSION = os.environ.get(SESSION_VARIABLE) or uuid.uuid4().hex


def readable(label: str) -> str:
    """The part of a file's name that is for the eye."""
    return re.sub(r"[^\w.=-]+", "_", label)[:60].strip("_")


def mark_of(folder: Path, label: str) -> Path:
    """The mark of an integrator in the folder of a scene. One for all its runs: a process that died
    in one of them would die in the others, and a run need not have the same name again."""
    return folder / f"{readable(label)}_{zlib.crc32(label.encode()):08x}{_RUNNING}"


def has_crashed(mark: Path) -> bool:
    """Did an earlier process die in a render of this integrator?"""
    return mark.with_suffix(_CRASHED).exists()


@contextlib.contextmanager
def marked(mark: Path) -> Iterator[None]:
    """Sets a mark while something is being rendered. One that stays tells a supervisor what the
    process died of (:func:`blame`).

    Raises:
        RuntimeError: A process died of it before.
    """
    if has_crashed(mark):
        raise RuntimeError(mark.with_suffix(_CRASHED).read_text(encoding="utf-8"))
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.write_text(str(os.getpid()), encoding="utf-8")
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def running(folder: Path, process: int) -> set[Path]:
    """The marks of what ``process`` is rendering in ``folder``."""
    marks = set()
    for mark in folder.glob(f"*/*{_RUNNING}"):
        with contextlib.suppress(FileNotFoundError):  # just finished
            if mark.read_text(encoding="utf-8") == str(process):
                marks.add(mark)
    return marks


def blame(folder: Path, process: int, message: str) -> set[Path]:
    """After the end of ``process``: notes ``message`` as the end of what it was rendering. Returns
    the marks of that; none if it was rendering nothing."""
    marks = running(folder, process)
    for mark in marks:
        mark.with_suffix(_CRASHED).write_text(message, encoding="utf-8")
        mark.unlink()
    return marks


def forgive(folder: Path) -> None:
    """Forgets all marks: what they say is tried again."""
    for suffix in (_RUNNING, _CRASHED):
        for mark in folder.glob(f"*/*{suffix}"):
            mark.unlink()


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """Keeps other comparisons out of ``folder``, which is made if it is missing: they would measure
    each other's load. The lock ends with the process, whatever ends it; marks of a process that is
    gone are removed. In a worker, all this is up to its supervisor.

    Raises:
        InputError: Another comparison is running there, or the folder cannot be made.
    """
    if SESSION_VARIABLE in os.environ:
        yield
        return
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    file = _lock(folder)
    try:
        forgive(folder)
        yield
    finally:
        if file is not None:
            (folder / _LOCK).unlink(missing_ok=True)
            file.close()
        with contextlib.suppress(OSError):  # something was written
            for path in missing:
                path.rmdir()


def _lock(folder: Path) -> TextIO | None:
    """The locked file; ``None`` where nothing can be locked."""
    if fcntl is None:
        return None
    path = folder / _LOCK
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            process = file.read() or "unknown"  # just being written
            file.close()
            raise InputError(
                f"{folder}: another comparison is running in this folder (process {process}): wait "
                f"for its end, or name another folder"
            ) from None
        except OSError:  # a file system without locks
            file.close()
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # its holder has removed it since it was opened
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file
