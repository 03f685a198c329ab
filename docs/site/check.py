"""Checks a built site: its links lead somewhere, and it requests nothing from a network.

``python docs/site/check.py out/docs`` prints what is wrong, and then fails.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: What a browser requests without a click.
_REQUESTED = {"img": "src", "script": "src", "link": "href", "iframe": "src", "source": "src"}


class _Page(HTMLParser):
    """The anchors of a page, its links, and what it requests."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.requests: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"])
        if values.get(_REQUESTED.get(tag, "")):
            self.requests.append(values[_REQUESTED[tag]])


def faults(site: Path) -> list[str]:
    """What is wrong with a site, one line each."""
    read = {file: _Page(file.read_text(encoding="utf-8")) for file in site.rglob("*.html")}
    found = []
    for file, page in read.items():
        name = file.relative_to(site)
        found += [f"{name} requests {url}" for url in page.requests if _is_remote(url)]
        for url in (*page.links, *page.requests):
            if _is_remote(url) or url.startswith(("data:", "mailto:")):
                continue
            path, anchor = unquote(urlsplit(url).path), unquote(urlsplit(url).fragment)
            target = (file.parent / path).resolve() if path else file
            if not target.exists():
                found.append(f"{name}: no file for {url}")
            elif anchor and target in read and anchor not in read[target].anchors:
                found.append(f"{name}: no place for {url}")
    for file in site.rglob("*.css"):
        urls = re.findall(r"(?:url\(|@import )['\"]?([^'\")]+)", file.read_text(encoding="utf-8"))
        found += [f"{file.relative_to(site)} requests {url}" for url in urls if _is_remote(url)]
    return found


def _is_remote(url: str) -> bool:
    return url.startswith(("http:", "https:", "//"))


if __name__ == "__main__":
    lines = faults(Path(sys.argv[1]).resolve())
    print("\n".join(lines), file=sys.stderr)
    sys.exit(bool(lines))
