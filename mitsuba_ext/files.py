"""Checks whether files and folders can be written, and replaces files in one step."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError


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


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to; the finished file then replaces ``path`` in one step.

    After an exception, ``path`` is unchanged.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
