"""Ten lines: render a scene with an integrator of ours, and print the cost.

``.venv/bin/python examples/quickstart.py`` writes ``door_ajar.exr`` to the current folder.
"""

from pathlib import Path

import mitsuba_ext  # registers the plugins; import it before mitsuba: it chooses the LLVM library

import mitsuba as mi  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "door_ajar.xml"

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(SCENE))  # or your own
integrator = mi.load_dict({"type": "auto"})
image = mi.render(scene, integrator=integrator, spp=64, seed=1)
mi.Bitmap(image).write("door_ajar.exr")

statistics = integrator.statistics
print(f"{statistics.seconds:.1f} s, {statistics.rays}, {statistics.learned}")
print(f"mitsuba_ext {mitsuba_ext.__version__}: door_ajar.exr")
