"""Makes the pictures of the Mermaid diagrams in our pages, in ``docs/figures/``.

Needed only after a change of a diagram, with a network: ``.venv/bin/python docs/site/diagrams.py``.
It needs npm (for Mermaid) and Chromium.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from offline import ROOT, diagram_file
from playwright.sync_api import sync_playwright

PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]


def main() -> None:
    names = ("chromium", "chromium-browser", "google-chrome")
    executable = next(filter(None, map(shutil.which, names)), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        subprocess.run(["npm", "pack", "--silent", "mermaid@11"], cwd=folder, check=True)
        shutil.unpack_archive(next(Path(folder).glob("*.tgz")), folder)
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        page = browser.new_page()
        page.add_script_tag(path=Path(folder) / "package" / "dist" / "mermaid.min.js")
        # Without labels of HTML, which not every program that shows SVG knows
        page.evaluate(
            "mermaid.initialize({theme: 'neutral', htmlLabels: false,"
            " flowchart: {wrappingWidth: 400}})"
        )
        for file in PAGES:
            text = file.read_text(encoding="utf-8")
            for diagram in re.findall(r"^```mermaid\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
                plain = re.sub("</?b>", "", diagram)
                svg = page.evaluate("async text => (await mermaid.render('d', text)).svg", plain)
                picture = ROOT / diagram_file(diagram)
                picture.write_text(svg + "\n", encoding="utf-8")
                print(picture)
        browser.close()


if __name__ == "__main__":
    main()
