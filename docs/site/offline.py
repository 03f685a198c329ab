"""What the site needs to be read from a folder, without a network.

Links to source files lead to pages of the site that show them. Formulas become MathML, which
browsers show without a script. A diagram in Mermaid's language is shown as the picture that
``diagrams.py`` made of it.
"""

from __future__ import annotations

import hashlib
import posixpath
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from plugins import ROOT, CodeLink
from sphinx import addnodes
from sphinx.util.logging import getLogger

if TYPE_CHECKING:
    from sphinx.application import Sphinx

#: Files that are shown as pages of text, and the language of each.
_LANGUAGES = {".py": "python", ".toml": "toml", ".xml": "xml", ".sh": "bash", "": "text"}

_DIAGRAMS = "docs/figures"

_log = getLogger(__name__)


def diagram_file(source: str) -> str:
    """The picture of a diagram, as a path from the root of the repository."""
    digest = hashlib.sha256(source.strip().encode()).hexdigest()[:8]
    return f"{_DIAGRAMS}/diagram_{digest}.svg"


class _Links:
    """The files outside of the documentation that pages link to."""

    def __init__(self) -> None:
        self.shown: set[str] = set()
        self.copied: set[str] = set()

    def resolve(self, app: Sphinx, document: nodes.document) -> None:
        """Turns links to such files into links to pages of the site."""
        folder = posixpath.dirname(app.env.docname)
        for link in list(document.findall(CodeLink)):
            link.replace_self(self._reference(app, link["path"], link.children))
        for link in list(document.findall(addnodes.pending_xref)):
            if link.get("reftype") != "myst":
                continue
            target = link["reftarget"]
            if link["refdomain"] == "doc" and target not in app.env.found_docs:
                path = next(f"{target}{end}" for end in app.config.source_suffix
                            if (ROOT / f"{target}{end}").exists())  # fmt: skip
                link.replace_self(self._reference(app, path, link.children))
            elif link["refdomain"] is None and (ROOT / folder / target).is_dir():
                # A folder: there is nothing to show
                link.replace_self(link.children)
        for link in list(document.findall(addnodes.download_reference)):
            path = posixpath.normpath(posixpath.join(folder, link["reftarget"]))
            if Path(path).suffix in {*_LANGUAGES, ".html"}:
                link.replace_self(self._reference(app, path, link.children))

    def _reference(self, app: Sphinx, path: str, children: list[nodes.Node]) -> nodes.reference:
        here = app.env.docname
        if path.endswith(".html"):
            self.copied.add(path)
            uri = posixpath.relpath(f"files/{path}", posixpath.dirname(here) or ".")
        else:
            self.shown.add(path)
            uri = app.builder.get_relative_uri(here, f"code/{path}")
        return nodes.reference("", "", *children, internal=True, refuri=uri)

    def pages(self, app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
        """A page for each text file."""
        for path in sorted(self.shown):
            text = (ROOT / path).read_text(encoding="utf-8")
            language = _LANGUAGES.get(Path(path).suffix, "text")
            body = app.builder.highlighter.highlight_block(text, language, linenos=False)
            context = {"parents": [], "title": path, "body": f'<h1 class="file">{path}</h1>{body}'}
            yield f"code/{path}", context, "page.html"

    def copy(self, app: Sphinx, error: Exception | None) -> None:
        """Copies the pages that other programs made."""
        for path in self.copied if error is None else ():
            copy = Path(app.outdir) / "files" / path
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, copy)


def _show_diagrams(_app: Sphinx, document: nodes.document) -> None:
    for block in list(document.findall(nodes.literal_block)):
        if block.get("language") != "mermaid":
            continue
        picture = diagram_file(block.astext())
        if (ROOT / picture).exists():
            image = nodes.image(uri=f"/{picture}", alt="Diagram")
            block.replace_self(nodes.container("", image, classes=["diagram"]))
        else:
            _log.warning("no %s: run docs/site/diagrams.py", picture, location=block)
            block["language"] = "text"


def _show_formula(writer: Any, node: nodes.math) -> None:
    is_block = isinstance(node, nodes.math_block)
    writer.body.append(latex2mathml.tex2mathml(node.astext(), as_block=is_block))
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    links = _Links()
    app.connect("doctree-read", links.resolve)
    app.connect("html-collect-pages", links.pages)
    app.connect("build-finished", links.copy)
    # Before Sphinx collects the pictures of a page
    app.connect("doctree-read", _show_diagrams, priority=100)
    show = (_show_formula, None)
    app.add_html_math_renderer("mathml", inline_renderers=show, block_renderers=show)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
