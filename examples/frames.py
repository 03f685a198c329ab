"""Frames of a moving camera: one scene in memory, kernels compiled once.

``.venv/bin/python examples/frames.py`` writes ``frame.000.png`` to ``frame.007.png``. From the
shell: ``mitsuba-ext render SCENE -o frame.png --frames 0:7 --parameters FILE.py:FUNCTION``.
"""

from pathlib import Path

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "cornell_box.xml"
FRAMES = 8

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(SCENE), integrator="auto_path", width=160, height=120)
camera = mi.traverse(scene.sensors()[0])
start = mi.ScalarTransform4f(camera["to_world"].matrix.numpy()[..., 0])
for frame in range(FRAMES):
    # The camera moves sideways, along its own x axis
    step = mi.ScalarTransform4f().translate([0.02 * frame, 0, 0])
    camera["to_world"] = mi.Transform4f(start @ step)
    camera.update()
    image = mi.render(scene, spp=32, seed=frame)  # a seed of its own: noise that does not stick
    mi.util.write_bitmap(f"frame.{frame:03}.png", image, write_async=False)
    print(f"frame {frame}: {scene.integrator().statistics.seconds:.2f} s")
