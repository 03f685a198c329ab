"""The page that shows a render. Its style is the report's of ``compare``, and a few rules more."""

from __future__ import annotations

import base64
import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np

_FOLDER = Path(__file__).parent
_REPORT_STYLE = _FOLDER.parent / "compare" / "report" / "report.css"


@cache
def render_page() -> str:
    """The HTML of the page, which needs no other files."""
    import jinja2
    from markupsafe import Markup

    template = jinja2.Template(
        _read(_FOLDER / "live.html"), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    style = _read(_REPORT_STYLE) + _read(_FOLDER / "live.css")
    return template.render(
        style=Markup(style), script=Markup(_script()), colors=json.dumps(_colors())
    )


@cache
def policy() -> str:
    """The page's content security policy: only its own script runs, it only asks its own server,
    and no other page can show it in a frame."""
    script = base64.b64encode(hashlib.sha256(_script().encode()).digest()).decode()
    return (
        f"default-src 'none'; connect-src 'self'; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{script}'; img-src data:; base-uri 'none'; form-action 'none'; "
        f"frame-ancestors 'none'"
    )


@cache
def _script() -> str:
    return _read(_FOLDER / "live.js")


def _colors() -> list[list[int]]:
    """The colours of errors, as in the report."""
    import matplotlib

    table = matplotlib.colormaps["inferno"](np.arange(256))[:, :3]
    return np.round(255 * table).astype(int).tolist()


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
