"""The pages of the documentation: their links lead somewhere, and they are not too long."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import mitsuba_ext
from tests.support.paths import ROOT

README = ROOT / "README.md"
PAGES = [
    README,
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    *sorted(ROOT.glob("*/README.md")),
]


def _text(page: Path) -> str:
    """Without blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def _anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ +(.*?) *$", _text(page), re.MULTILINE)
    titles = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title) for title in titles]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page: Path) -> None:
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", _text(page)):
        path, _, anchor = link.partition("#")
        if "://" in link:
            continue
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in _anchors(target)):
            lost.append(link)
    assert not lost


def test_sample_output_names_the_present_version() -> None:
    stale = [
        f"{page.relative_to(ROOT)}: {found}"
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for found in re.findall(r"mitsuba_ext (\d+\.\d+\.\d+)", page.read_text(encoding="utf-8"))
        if found != mitsuba_ext.__version__
    ]
    assert not stale


def test_the_readme_is_short() -> None:
    assert len(README.read_bytes()) <= 12 * 1024


@pytest.mark.parametrize(("folder", "most"), [("examples", 12), ("benchmarks", 99)])
def test_every_script_is_in_the_table_of_its_folder(folder: str, most: int) -> None:
    table = (ROOT / folder / "README.md").read_text(encoding="utf-8")
    files = [file.name for file in (ROOT / folder).iterdir() if file.suffix in (".py", ".ipynb")]
    assert len(files) <= most
    assert not [name for name in files if f"({name})" not in table]


def test_commands_of_the_pages_name_scripts_that_are_there() -> None:
    lost = {
        name
        for page in PAGES
        for name in re.findall(r"(?:benchmarks|examples)/\w+\.(?:py|ipynb)", page.read_text())
        if not (ROOT / name).exists()
    }
    assert not lost
