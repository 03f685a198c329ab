"""Errors that the command line shows as one sentence, without a traceback."""

from __future__ import annotations


class InputError(ValueError):
    """An input of the user cannot be used. The message is one line that names it and the fault."""


class InstallationError(RuntimeError):
    """Installed software cannot be used. The message says what to do."""
