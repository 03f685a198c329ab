"""Starts this package in other processes."""

from __future__ import annotations

import os
import sys


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in another process, with the same packages as in this one.

    It does not use ``python -m``, which searches the current folder first: another copy of this
    package may be there.

    Args:
        module: Full name of the module; it is executed as ``__main__``.
        arguments: Its command-line arguments.
    """
    paths = [os.fspath(path) for path in sys.path]  # a user may have added a Path
    code = (
        f"import sys; sys.path[:] = {paths!r}; import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *arguments]
