"""Shows the paths behind the pixels of a render. The equivalent of ``mitsuba-ext replay`` in
Python::

    import mitsuba_ext
    import mitsuba as mi
    from mitsuba_ext import replay

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")
    pixels, image = replay.bright_pixels(scene, 3, spp=64)
    for pixel in replay.paths_of_pixels(scene, pixels, spp=64):
        print(pixel.pixel, pixel.value, pixel.paths[0].vertices)
"""

from __future__ import annotations

from .paths import FoundLight, PathVertex, PixelPaths, SamplePath
from .render_again import bright_pixels, paths_of_pixels

__all__ = [
    "FoundLight",
    "PathVertex",
    "PixelPaths",
    "SamplePath",
    "bright_pixels",
    "paths_of_pixels",
]
