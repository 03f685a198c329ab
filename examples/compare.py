"""Ten lines: integrators compared on a scene, as tables and as a report.

Run from the root of the repository: ``.venv/bin/python examples/compare.py`` (a minute).
"""

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext import compare

import mitsuba as mi  # isort: skip

mi.set_variant("llvm_ad_rgb")
integrators = {"path": "path", "neepp": "neepp", "coarse": {"type": "neepp", "grid": 4}}
comparison = compare.Comparison(
    "scenes/door_ajar.xml", integrators, compare.sweep([4, 16, 64]), folder="out/example"
)
results = comparison.run(lambda step: print(step.label))
compare.show(results)
print(comparison.folder / "report.html")
