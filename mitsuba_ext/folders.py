"""Folders that somebody wants to write to."""

from __future__ import annotations

import tempfile
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
    """Makes a folder in which files can be made.

    Raises:
        InputError: It cannot be.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error
    check_folder(folder)
