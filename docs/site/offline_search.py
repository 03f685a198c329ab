"""Lets the search page show the text around what it finds in a site that is read from a folder.

Sphinx's search requests each page that it finds, which browsers refuse for files on disk. Here, a
script holds the text of all pages, and answers these requests.
"""

from __future__ import annotations

import json
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_FILE = "page_texts.js"

#: Answers the requests of Sphinx's ``searchtools.js`` from ``pageTexts``.
_SCRIPT = """\
const pageTexts = %s;
window.fetch = (url) => {
  const root = document.documentElement.dataset.content_root;
  const page = decodeURI(url).slice(root.length).split("#")[0];
  return Promise.resolve({ text: () => pageTexts[page] ?? "" });
};
"""

#: Elements whose text is not part of what a page says.
_SILENT = ("script", "style", "svg", "button")

_WITHOUT_END = ("img", "br", "hr", "input", "link", "meta", "wbr", "source", "col")


class _Text(HTMLParser):
    """The text of a page's main part. Sections stay elements: Sphinx looks for their anchors."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.parts: list[str] = []
        self._depth = self._silent = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in _WITHOUT_END:
            return
        values = dict(attrs)
        if self._depth == 0 and values.get("role") != "main":
            return
        self._depth += 1
        if self._silent or tag in _SILENT or "headerlink" in (values.get("class") or ""):
            self._silent += 1
        if tag == "section":
            self.parts.append(f'<section id="{escape(values.get("id") or "")}">')

    def handle_endtag(self, tag: str) -> None:
        if self._depth == 0 or tag in _WITHOUT_END:
            return
        if tag == "section":
            self.parts.append("</section>")
        self._silent = max(0, self._silent - 1)
        self._depth -= 1

    def handle_data(self, data: str) -> None:
        if self._depth and not self._silent:
            self.parts.append(escape(" ".join(data.split()) + " ", quote=False))


def _add_script(app: Sphinx, page: str, _template: str, _context: Any, _tree: Any) -> None:
    if page == "search":
        app.add_js_file(_FILE)


def _write(app: Sphinx, error: Exception | None) -> None:
    if error is not None:
        return
    folder = Path(app.outdir)
    pages = (folder / app.builder.get_target_uri(name) for name in app.env.found_docs)
    texts = {
        page.relative_to(folder).as_posix(): '<div role="main">'
        + "".join(_Text(page.read_text(encoding="utf-8")).parts)
        + "</div>"
        for page in sorted(pages)
    }
    script = _SCRIPT % json.dumps(texts, ensure_ascii=False).replace("</", "<\\/")
    (folder / "_static" / _FILE).write_text(script, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("html-page-context", _add_script)
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
