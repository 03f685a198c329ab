"""The documentation site. ``make docs`` builds it into ``out/docs``, to be read without a network.

Its pages are the Markdown files of the repository, where they lie, and the files of the plugins,
whose docstrings are their pages (``plugins.py``).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import plugins  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

from mitsuba_ext import __version__  # noqa: E402

project = "mitsuba_ext"
author = "the authors of mitsuba_ext"
release = version = __version__
language = "en"

extensions = [
    "myst_nb", "sphinx_tabs.tabs", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "plugins",
    "offline", "offline_search",
]  # fmt: skip
root_doc = "README"
include_patterns = [
    "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**.md", "*/README.md", *plugins.files(),
]  # fmt: skip
# Folders that need not be searched, and the part of the README that only the site has
exclude_patterns = [
    ".*", "out", "build", "dist", "tests", "**/__pycache__", "docs/site/contents.md",
]  # fmt: skip

# Roles without a domain are ours, not those of Python
primary_domain = None
nitpicky = True
# Types in the docstrings of the Python API: not all of them have a page here
nitpick_ignore_regex = [("py:.*", ".*")]

# Docstrings of the Python API
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
napoleon_use_ivar = True

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

# Tutorials are executed. Their results are kept until their code changes
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "out" / "docs_work" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
# The scripts of widgets would come from a server
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

# Links into the pages of Mitsuba and Dr.Jit need a network when the site is built
if os.environ.get("DOCS_INTERSPHINX"):
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "mitsuba": ("https://mitsuba.readthedocs.io/en/latest/", None),
        "drjit": ("https://drjit.readthedocs.io/en/latest/", None),
    }

html_theme = "furo"
html_title = f"mitsuba_ext {version}"
html_static_path = ["static"]
html_css_files = ["style.css"]
html_extra_path = ["index.html"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
pygments_style = "friendly"
pygments_dark_style = "monokai"
# style.css has the style of tabs
sphinx_tabs_disable_css_loading = True
sphinx_tabs_disable_tab_closing = True


def setup(app: Sphinx) -> None:
    """Only on the site, the README has the table of contents."""

    def add_contents(_app: Sphinx, docname: str, content: list[str]) -> None:
        if docname == root_doc:
            contents = (HERE / "contents.md").read_text(encoding="utf-8")
            if not (ROOT / "docs" / "gallery" / "index.md").exists():
                # It is not in the repository: benchmarks/gallery.py makes it
                contents = contents.replace("docs/gallery/*\n", "")
            content[0] += contents

    app.connect("source-read", add_contents)
