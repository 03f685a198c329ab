"""Errors whose message is all that a user of the command line needs: one sentence, no traceback."""

from __future__ import annotations


class InputError(ValueError):
    """Something that the user gave cannot be used. The message is one line: what, and where."""


class InstallationError(RuntimeError):
    """Something that is installed cannot be used. The message says what to do."""
