"""The documentation site: each plugin has a page with all its parameters, and Sphinx accepts it."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from mitsuba_ext.startup import pages, plugin_folders
from tests.support.paths import ROOT

SITE = ROOT / "docs" / "site"
KINDS = plugin_folders.plugin_names()
FILES = {file.stem: file.resolve() for kind in KINDS for file in plugin_folders.plugin_files(kind)}


@pytest.fixture(scope="module")
def plugins() -> Any:
    """The module that makes the pages."""
    pytest.importorskip("sphinx")
    sys.path.insert(0, str(SITE))
    import plugins

    yield plugins
    sys.path.remove(str(SITE))


@pytest.fixture(scope="module")
def site(plugins: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The pages of the plugins, without the rest of the site, and Sphinx's warnings."""
    pytest.importorskip("sphinx_tabs")
    from sphinx.application import Sphinx

    folder = tmp_path_factory.mktemp("site")
    warnings = (folder / "warnings.txt").open("w+", encoding="utf-8")
    app = Sphinx(
        ROOT, None, folder / "html", folder / "pages", "html", status=None, warning=warnings,
        confoverrides={
            "extensions": ["sphinx_tabs.tabs", "plugins", "offline", "offline_search"],
            "html_theme": "basic",
            "include_patterns": plugins.files(), "root_doc": "integrators/auto",
            "primary_domain": None, "nitpicky": True, "html_copy_source": False,
            "html_math_renderer": "mathml",
        },
    )  # fmt: skip
    app.build()
    warnings.seek(0)
    # The table of contents is not among these pages
    faults = [line for line in warnings if "isn't included in any toctree" not in line]
    return folder / "html", "".join(faults)


def test_docstrings_of_plugins_have_no_faults(site: tuple[Path, str]) -> None:
    assert site[1] == ""


@pytest.mark.parametrize("name", FILES)
def test_every_plugin_has_a_page_with_its_parameters(name: str, site: tuple[Path, str]) -> None:
    file = FILES[name]
    page = (site[0] / file.relative_to(ROOT).with_suffix(".html")).read_text(encoding="utf-8")
    keys = re.findall(r"^ *\* - (\w.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
    for key in ", ".join(keys).split(", ") if keys else ():
        assert f'id="parameter-{key}"' in page
    assert f'href="../code/{file.relative_to(ROOT)}.html"' in page
    assert "system-message" not in page


@pytest.mark.parametrize("name", FILES)
def test_rows_of_common_parameters_lead_to_their_list(name: str, site: tuple[Path, str]) -> None:
    file = FILES[name]
    page = site[0] / file.relative_to(ROOT).with_suffix(".html")
    row = re.search(
        r"<dt>[^\n]*Common parameters.*?</dd>", page.read_text(encoding="utf-8"), re.DOTALL
    )
    if row is None:
        return
    links = re.findall(r'href="([^"#]+)"', row.group())
    assert links and all((page.parent / link).exists() for link in links)


def test_diagrams_have_pictures(plugins: Any) -> None:
    import offline

    for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]:
        text = page.read_text(encoding="utf-8")
        for diagram in re.findall(r"^```mermaid\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            assert (ROOT / offline.diagram_file(diagram)).exists(), "run docs/site/diagrams.py"


@pytest.mark.parametrize("name", FILES)
def test_papers_of_a_page_are_in_the_bibliography(name: str) -> None:
    bibliography = (ROOT / "docs" / "bibliography.md").read_text(encoding="utf-8")
    entries = " ".join(bibliography.split()).split(" - ")
    text = " ".join(pages.read_page(FILES[name]).text.split())
    _, _, sources = text.partition(" Source")
    titles = re.findall(r"(?<!\*)\*([A-Z][^*]{9,})\*(?!\*)", sources)
    assert sources and not [
        title
        for title in titles
        if not any(f"*{title}" in entry and f"[`{name}`]" in entry for entry in entries)
    ]


def test_search_knows_the_text_of_each_page(site: tuple[Path, str]) -> None:
    script = (site[0] / "_static" / "page_texts.js").read_text(encoding="utf-8")
    texts = json.loads(re.search(r"^const pageTexts = (.*);$", script, re.MULTILINE)[1])
    assert len(texts) >= len(FILES)
    text = texts["integrators/bdpt.html"]
    assert "Bidirectional path tracer" in text and '<section id="' in text
    assert "page_texts.js" in (site[0] / "search.html").read_text(encoding="utf-8")


def test_check_finds_links_to_nothing_and_requests(tmp_path: Path, plugins: Any) -> None:
    import check

    (tmp_path / "a.html").write_text(
        '<h1 id="here">a</h1><a href="#here"></a><a href="#gone"></a><a href="b.html#x"></a>'
        '<a href="https://x.org"></a><script src="https://x.org/a.js"></script>'
    )
    (tmp_path / "style.css").write_text("@import 'https://x.org/a.css'; a { b: url(c.png) }")
    assert check.faults(tmp_path) == [
        "a.html requests https://x.org/a.js",
        "a.html: no place for #gone",
        "a.html: no file for b.html#x",
        "style.css requests https://x.org/a.css",
    ]
