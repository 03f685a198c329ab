"""Starts this package in other processes."""

from __future__ import annotations

import codecs
import os
import sys


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in another process with the same packages.

    It is not ``python -m``, which may find another copy of this package in the current folder.

    Args:
        module: The full name of the module, which is executed as ``__main__``.
        arguments: Its command-line arguments.
    """
    paths = [os.fspath(path) for path in sys.path]  # a user may have added a Path
    code = (
        f"import sys; sys.path[:] = {paths!r}; import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *arguments]


def restart_in_utf8() -> None:
    """Restarts this command in Python's UTF-8 mode if file names have another encoding (as with
    ``LC_ALL=C`` and ``PYTHONUTF8=0``), because Mitsuba accepts only UTF-8 names."""
    is_utf8 = codecs.lookup(sys.getfilesystemencoding()).name == "utf-8"
    if is_utf8 or os.name != "posix" or not sys.executable:
        return
    os.environ["PYTHONUTF8"] = "1"
    os.execv(sys.executable, python_command("mitsuba_ext", *sys.argv[1:]))
