"""Folders of the source tree."""

from __future__ import annotations

from pathlib import Path

#: The folder that holds ``tests``, ``scenes``, ``docs`` and the package.
ROOT = Path(__file__).parents[2]
