"""Shows the paths behind the pixels of a render. The equivalent of ``mitsuba-ext replay`` in
Python::

    import mitsuba_ext
    import mitsuba as mi
    from mitsuba_ext import replay

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")
    integrator = mi.load_dict({"type": "auto"})
    pixels, image = replay.bright_pixels(scene, 3, integrator, spp=64)
    found = replay.paths_of_pixels(scene, pixels, integrator, spp=64)
    print(found[0].paths[0].vertices)
    replay.draw_paths("paths.png", image, scene, scene.sensors()[0], found)
"""

from __future__ import annotations

from .drawing import draw_paths
from .paths import FoundLight, PathVertex, PixelPaths, SamplePath
from .render_again import bright_pixels, paths_of_pixels

__all__ = [
    "FoundLight",
    "PathVertex",
    "PixelPaths",
    "SamplePath",
    "bright_pixels",
    "draw_paths",
    "paths_of_pixels",
]
