"""The report of a comparison: one self-contained HTML file.

It contains images, plots, style sheet and script, so it opens without a network and can be sent as
it is. Its content comes from the comparison's folder (``results.json`` and the EXRs that it names),
so it can be written again at any time.
"""

from __future__ import annotations

from pathlib import Path

from ...images.image_files import replacing
from .records import read_results

__all__ = ["write_report"]

NAME = "report.html"


def write_report(folder: str | Path) -> Path:
    """Writes ``report.html`` next to ``results.json``, and returns its path.

    Args:
        folder: The folder with the ``results.json`` of a comparison. The report lists missing or
            damaged images, and contains everything else.

    Raises:
        InputError: There is no ``results.json``, or it cannot be read.
        OSError: The report cannot be written; an older report is kept.
    """
    from .page import render_page

    folder = Path(folder)
    page = render_page(read_results(folder), folder)
    path = folder / NAME
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path
