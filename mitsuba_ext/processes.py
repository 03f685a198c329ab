"""Other processes that run this package."""

from __future__ import annotations

import os
import sys


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in another process, with the same packages as in this one.

    ``python -m`` does not do: it looks first in the current folder, where another copy of this
    package may be.

    Args:
        module: Its full name; it is executed as ``__main__``.
        arguments: What it finds in ``sys.argv``.
    """
    paths = [os.fspath(path) for path in sys.path]  # a user may have added a Path
    code = (
        f"import sys; sys.path[:] = {paths!r}; import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code, *arguments]
