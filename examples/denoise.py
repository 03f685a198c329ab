"""A denoised image from few samples, guided by albedo and normals.

``pip install 'mitsuba_ext[denoise]'``, then ``.venv/bin/python examples/denoise.py`` writes
``noisy.png`` and ``denoised.png``. From the shell:
``mitsuba-ext render SCENE -o image.png --denoise``.
"""

from pathlib import Path

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.rendering.scene_guides import render_guides

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "cornell_box.xml"

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(SCENE), integrator="auto_path", rfilter="box")  # other filters blur noise
noisy = np.array(mi.render(scene, spp=16))[..., :3]
guides = render_guides(scene, scene.sensors()[0])  # albedo.R to normal.Z
albedo, normal = np.split(np.stack(list(guides.values()), axis=2), 2, axis=2)
for name, image in {"noisy": noisy, "denoised": denoise(noisy, albedo, normal)}.items():
    mi.util.write_bitmap(f"{name}.png", mi.TensorXf(image), write_async=False)
