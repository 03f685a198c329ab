"""Checks whether files and folders can be written, and replaces files in one step."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from .errors import InputError

#: The name of this machine: a process id is valid on one machine only, and several machines may
#: share a folder.
_HOST = re.sub(r"\W", "_", platform.node())


def is_utf8(text: str) -> bool:
    """Whether Mitsuba accepts the text. (In Python, a file name may contain any bytes.)"""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    """The text, with question marks for bytes that are not UTF-8."""
    return text.encode("utf-8", "replace").decode("utf-8")


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
    """Raises :class:`InputError` if the file ``path`` cannot be made or replaced; for use before a
    render."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder")
    check_folder(path.parent)
    # In a writable folder, even a read-only file could be replaced, against its owner's wish
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(f"{path}: is read-only")


def _is_alive(process: int) -> bool:
    if os.name != "posix":  # there, signal 0 ends a process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's process, or not a process id
        pass
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields the path of an empty temporary file to write to (:func:`beside`); the finished file
    then replaces ``path`` in one step. If ``path`` is a link, the link is replaced, not its target.
    After an exception, ``path`` is unchanged.

    Raises:
        OSError: The file cannot be written; the error names it.
    """
    with beside(path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextlib.contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Yields the path of an empty temporary file in the folder of ``path``, which is removed
    afterwards. Also removes temporary files for ``path`` left by processes on this machine that
    were killed while writing. Its name cannot be guessed, so nobody can put a link in its place.

    Raises:
        OSError: The file cannot be written; the error names it.
    """
    before, after = f".{path.stem}.{_HOST}-", path.suffix
    temporary = path.with_name(f"{before}{os.getpid()}-{uuid.uuid4().hex[:8]}{after}")
    try:
        for name in os.listdir(path.parent):
            if name.startswith(before) and name.endswith(after):
                process = name[len(before) : len(name) - len(after)].partition("-")[0]
                if process.isdecimal() and not _is_alive(int(process)):
                    with contextlib.suppress(OSError):
                        path.with_name(name).unlink()
        new_file(temporary).close()
        yield temporary
    except OSError as error:
        if error.filename is not None and error.filename != str(temporary):
            raise
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def new_file(path: Path) -> TextIO:
    """Opens a text file that does not exist yet. A link counts as existing.

    Raises:
        OSError: The file exists, or it cannot be made.
    """
    return path.open("x", encoding="utf-8")
