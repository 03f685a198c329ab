"""Mark files in the folder of a comparison. They record which render is running, in which render a
process died, and that the folder is in use. They remain when a process dies."""

from __future__ import annotations

import contextlib
import os
import re
import stat
import uuid
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from .errors import InputError
from .files import make_folder, new_file

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there
    fcntl = None

#: Suffixes of an integrator's mark: while one of its runs or a reference is being rendered (the
#: file holds the process id), and after the process died during it (the file holds the reason).
_RUNNING = ".running"
_CRASHED = ".crashed"

_LOCK = ".lock"

#: The folder of rendered references, beside the folders of the scenes.
REFERENCES = "references"

#: Identifies a session. A supervisor passes its identifier on to its workers.
SESSION_VARIABLE = "MITSUBA_EXT_SESSION"
SESSION = os.environ.get(SESSION_VARIABLE) or uuid.uuid4().hex


def readable(label: str) -> str:
    """The readable part of a file name: the label without special characters, shortened."""
    return re.sub(r"[^\w.=-]+", "_", label)[:60].strip("_")


def mark_of(folder: Path, label: str) -> Path:
    """The mark of an integrator in the folder of a scene. All its runs share the mark: a process
    that died in one run would probably die in the others, and the file name of a run can differ the
    next time."""
    return folder / f"{readable(label)}_{zlib.crc32(label.encode()):08x}{_RUNNING}"


def has_crashed(mark: Path) -> bool:
    """Whether an earlier process died in a render of this integrator."""
    return mark.with_suffix(_CRASHED).exists()


@contextlib.contextmanager
def marked(mark: Path) -> Iterator[None]:
    """Sets a mark during a render. If the process dies, the mark stays and tells the supervisor in
    which render it died (:func:`blame`).

    Raises:
        RuntimeError: A process has already died in a render of this integrator.
    """
    if has_crashed(mark):
        raise RuntimeError(mark.with_suffix(_CRASHED).read_text(encoding="utf-8", errors="replace"))
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.unlink(missing_ok=True)  # a link, or the mark of a process that died
    with new_file(mark) as file:
        file.write(str(os.getpid()))
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def running(folder: Path, process: int) -> set[Path]:
    """The marks that ``process`` has set in ``folder``."""
    marks = set()
    for mark in folder.glob(f"*/*{_RUNNING}"):
        with contextlib.suppress(FileNotFoundError):  # just finished
            if mark.read_text(encoding="utf-8", errors="replace") == str(process):
                marks.add(mark)
    return marks


def begun(folder: Path, process: int) -> set[tuple[Path, int]]:
    """The marks of :func:`running`, each with a number that differs from render to render. Marks of
    references are omitted, because references have no time limit."""
    found = set()
    for mark in running(folder, process):
        if mark.parent.name != REFERENCES:
            with contextlib.suppress(FileNotFoundError):
                found.add((mark, mark.stat().st_mtime_ns))
    return found


def renew(mark: Path) -> None:
    """Changes the mark's number for :func:`begun`, as another render of the integrator begins."""
    with contextlib.suppress(FileNotFoundError):
        os.utime(mark)


def blame(folder: Path, process: int, message: str) -> set[Path]:
    """After ``process`` has died, records ``message`` as the reason in the mark of the render that
    it was in. Returns the marks of that render; an empty set if it was not rendering."""
    marks = running(folder, process)
    for mark in marks:
        mark.with_suffix(_CRASHED).write_text(message, encoding="utf-8")
        mark.unlink()
    return marks


def forgive(folder: Path) -> None:
    """Removes all marks, but no other files, so that crashed integrators are tried again."""
    for suffix in (_RUNNING, _CRASHED):
        for mark in folder.glob(f"*/*{suffix}"):
            if re.search(r"_[0-9a-f]{8}$", mark.stem):
                mark.unlink()


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """Locks ``folder`` against other comparisons, because they would slow each other down
    (:func:`locked`). Marks of earlier processes are removed. In a worker, this does nothing,
    because its supervisor holds the lock.

    Raises:
        InputError: Another comparison is running there, or the folder cannot be made.
    """
    if SESSION_VARIABLE in os.environ:
        yield
        return
    with locked(folder):
        forgive(folder)
        yield


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks ``folder`` against other processes; makes it if it is missing. The lock ends with the
    process, however the process ends.

    Raises:
        InputError: Another process uses the folder, or the folder cannot be made or locked.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    lock = folder / _LOCK
    file = _lock(lock, lock, f"{folder}: another process uses this folder", "folder")
    try:
        yield
    finally:
        if file is not None:
            (folder / _LOCK).unlink(missing_ok=True)
            file.close()
        with contextlib.suppress(OSError):  # not empty, because something was written
            for path in missing:
                path.rmdir()


@contextlib.contextmanager
def written_alone(path: Path) -> Iterator[None]:
    """Locks ``path``, which a render will write, against other renders: the later image would
    replace the earlier one. The lock ends with the process.

    Raises:
        InputError: Another render will write the file.
    """
    mark = path.with_name(f".{path.name}{_LOCK}")
    file = _lock(mark, path, f"{path}: another render writes this file", "file")
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)
        if file is not None:
            file.close()


def _lock(path: Path, named: Path, refusal: str, what: str) -> TextIO | None:
    """Makes the file ``path``, and locks it; ``None`` on a system without locks.

    Parameters:
        named: The file that the message names if ``path`` cannot be written.
        refusal: The beginning of the message if another process has locked ``path``.
        what: The kind of thing that process uses: a folder or a file.
    """
    if fcntl is None:
        return None
    while True:
        file = _opened(path)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            process = file.read() or "unknown"  # the other process has not written its id yet
            file.close()
            raise InputError(
                f"{refusal} (process {process}): wait for its end, or name another {what}"
            ) from None
        except OSError:  # a file system without locks
            file.close()
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # the process that held the lock has removed the file since it was opened
    try:
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
    except OSError as error:
        path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # closing the file writes its buffer
            file.close()
        raise InputError(f"{named}: cannot be written ({error.strerror})") from None
    return file


def _opened(path: Path) -> TextIO:
    """Opens a lock file, or makes it.

    Raises:
        InputError: The file cannot be made, or it is not a lock but a file of the user.
    """
    try:
        # A link might lead to any file of the user's
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        file = os.fdopen(os.open(path, flags, 0o666), "a+", encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be used as a lock ({error.strerror})") from None
    file.seek(0)
    is_regular = stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    if not is_regular or not re.fullmatch(r"\d{0,20}", file.read(32)):
        file.close()
        raise InputError(f"{path}: is not our lock file: remove it, or name another folder")
    return file
