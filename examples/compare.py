"""Ten lines: compare integrators on a scene, with tables and a report.

``.venv/bin/python examples/compare.py`` (a minute) writes to ``out/example`` in the current folder.
"""

from pathlib import Path

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext import compare

import mitsuba as mi  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "door_ajar.xml"

mi.set_variant("llvm_ad_rgb")
integrators = {"path": "path", "neepp": "neepp", "coarse": {"type": "neepp", "grid": 4}}
comparison = compare.Comparison(
    SCENE, integrators, compare.sweep([4, 16, 64]), folder="out/example"
)
results = comparison.run()
compare.show(results)
print(comparison.folder / "report.html")
