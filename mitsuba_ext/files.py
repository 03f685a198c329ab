"""Checks whether files and folders can be written, and replaces files in one step."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError

#: The name of this machine: a process id is valid on one machine only, and several machines may
#: share a folder.
_HOST = re.sub(r"\W", "_", platform.node())


def check_folder(folder: Path) -> None:
    """Raises :class:`InputError` if no file can be made in ``folder``."""
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot write here ({error.strerror})") from error


def make_folder(folder: Path) -> None:
    """Makes a folder, and checks that files can be made in it.

    Raises:
        InputError: The folder or a file in it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error
    check_folder(folder)


def check_target(path: Path) -> None:
    """Raises :class:`InputError` if the file ``path`` cannot be made; for use before a render."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder")
    check_folder(path.parent)


def _is_alive(process: int) -> bool:
    if os.name != "posix":  # there, signal 0 ends a process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it is another user's; or it is no number of a process
        pass
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to; the finished file then replaces ``path`` in one step.

    After an exception, ``path`` is unchanged. Removes temporary files for ``path`` of processes on
    this machine that were killed while they wrote.
    """
    before, after = f".{path.stem}.{_HOST}-", path.suffix
    temporary = path.with_name(f"{before}{os.getpid()}{after}")
    for name in os.listdir(path.parent):
        if name.startswith(before) and name.endswith(after):
            process = name[len(before) : len(name) - len(after)]
            if process.isdecimal() and not _is_alive(int(process)):
                with contextlib.suppress(OSError):
                    path.with_name(name).unlink()
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
