"""The results of a comparison as an object that notebooks show as tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any


class Results(dict):
    """The content of ``results.json`` (:mod:`.results`), as a dict that notebooks show as a table
    with thumbnails for each scene.

    Attributes:
        folder: The folder of the comparison, which holds the images.
    """

    def __init__(self, content: Mapping[str, Any], folder: Path) -> None:
        super().__init__(content)
        self.folder = folder

    def _repr_html_(self) -> str:
        from .report.summary import render_summary

        return render_summary(self, self.folder)
