"""Frames of a moving camera: one scene in memory, kernels compiled and lights learned once.

``.venv/bin/python examples/frames.py`` writes ``frame.000.png`` to ``frame.007.png``. From the
shell: ``mitsuba-ext render SCENE -o frame.png --frames 0:7 --parameters FILE.py:FUNCTION``.
"""

from pathlib import Path

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "cornell_box.xml"
FRAMES = 8

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(SCENE), width=160, height=120)
integrator = mi.load_dict({"type": "auto_path", "keep_learned": True})  # the first frame learns
camera = mi.traverse(scene.sensors()[0])
start = mi.ScalarTransform4f(camera["to_world"].matrix.numpy()[..., 0])
for frame in range(FRAMES):
    # The camera moves sideways, along its own x axis
    step = mi.ScalarTransform4f().translate([0.02 * frame, 0, 0])
    camera["to_world"] = mi.Transform4f(start @ step)
    camera.update()
    # Each frame has a seed of its own: noise does not stick to the picture
    image = mi.render(scene, integrator=integrator, spp=32, seed=frame)
    mi.util.write_bitmap(f"frame.{frame:03}.png", image, write_async=False)
    print(f"frame {frame}: {integrator.statistics.seconds:.2f} s")
