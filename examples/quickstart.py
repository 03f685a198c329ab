"""Ten lines: a scene, an integrator of ours, an image and what it cost.

Run from the root of the repository: ``.venv/bin/python examples/quickstart.py``.
"""

import mitsuba_ext  # registers the plugins; before mitsuba, so that it can choose the LLVM library

import mitsuba as mi  # isort: skip

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file("scenes/door_ajar.xml", integrator="neepp", spp=64)
image = mi.render(scene, seed=1)
mi.Bitmap(image).write("door_ajar.exr")

statistics = scene.integrator().statistics
print(f"{statistics.seconds:.1f} s, {statistics.rays}, {statistics.learned}")
print(f"mitsuba_ext {mitsuba_ext.__version__}: door_ajar.exr")
