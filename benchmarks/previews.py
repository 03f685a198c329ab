"""Renders the pictures of scenes/README.md (15 minutes): ``python benchmarks/previews.py``.

They are denoised. All have the same curve: a pixel of the 98th percentile is nearly white.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from PIL import Image

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.rendering.scene_guides import render_guides

import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"

#: Samples per pixel for a clean picture of each scene without a denoiser; with one, an eighth.
PICTURES = {
    "door_ajar": 2048,
    "rooms": 2048,
    "cornell_box": 512,
    "open": 256,
    "mirrors_and_glass": 2048,
    "sunny_gloss": 1024,
    "many_lamps": 2048,
    "window": 2048,
    "box_with_hole": 512,
    "colonnade": 192,
    "three_balls": 192,
    "defocus": 2048,
    "fast_balls": 512,
    "fan": 512,
    "lantern": 2048,
    "six_balls": 256,
    "colour_wheel": 512,
    "spotlights": 128,
    "panes": 256,
    "peppers_ghost": 128,
    "bounce_card": 128,
    "burning_glass": 256,
    "showroom": 256,
    "discharge_lamps": 512,
    "paperweight": 512,
    "flint": 1024,
    "caustic": 256,
    "glass_lamp": 96,
    "ring": 768,
    "pool": 512,
    "water_glass": 512,
    "mirrored_lamp": 512,
    "keyhole": 5120,
    "shaded_lamp": 192,
    "corridor": 64,
    "night_classroom": 128,
    "near_lights": 256,
    "fog": 1024,
    "volume_caustic": 256,
    "tissue": 1024,
    "dunes": 256,
}

#: Scenes rendered by light paths or chains, or in which nothing is learned of visibility; all
#: others have "neepp".
INTEGRATORS = {
    **dict.fromkeys(
        [
            "caustic",
            "glass_lamp",
            "corridor",
            "ring",
            "shaded_lamp",
            "burning_glass",
            "bounce_card",
        ],
        "bdpt",
    ),
    "pool": "erpt",
    "keyhole": "auto",  # a denoiser keeps the spots of chains
    **dict.fromkeys(["water_glass", "mirrored_lamp"], "vcm"),
    **dict.fromkeys(["volume_caustic", "tissue"], "sppm"),
    **dict.fromkeys(
        [
            "six_balls",
            "colour_wheel",
            "spotlights",
            "panes",
            "peppers_ghost",
            "showroom",
            "discharge_lamps",
            "paperweight",
        ],
        "swarm_path",
    ),
}

#: Scenes that are not 16 : 9.
WIDTHS = {"cornell_box": 216, "caustic": 240, "glass_lamp": 240, "ring": 240, "shaded_lamp": 240}

#: The values of the 98th percentile, before the sRGB curve.
_WHITE = 0.9

#: Scenes that need a spectral variant.
SPECTRAL = {"flint", "discharge_lamps"}


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Writes scenes/previews/NAME.jpg for the scenes NAMES (all, if none is given), 360 pixels
    high."""
    folder = SCENES / "previews"
    folder.mkdir(exist_ok=True)
    for name in names or PICTURES:
        mi.set_variant("llvm_ad_spectral" if name in SPECTRAL else "llvm_ad_rgb")
        spp = max(16, PICTURES[name] // 8)
        size = {"width": 2 * WIDTHS.get(name, 320), "height": 360}
        file = SCENES / f"{name}.xml"
        if '"rfilter"' in file.read_text(encoding="utf-8"):
            size["rfilter"] = "box"  # others give neighbours the same noise
        scene = mi.load_file(str(file), **size, integrator=INTEGRATORS.get(name, "neepp"))
        image = np.array(mi.render(scene, spp=spp))[..., :3]
        guides = render_guides(scene, scene.sensors()[0])
        albedo, normal = np.split(np.stack(list(guides.values()), axis=2), 2, axis=2)
        picture(denoise(image, albedo, normal)).save(folder / f"{name}.jpg", quality=88)
        statistics = scene.integrator().statistics
        print(f"{name}: {spp} spp, {statistics.seconds:.0f} s, {statistics.learned}", flush=True)


def picture(image: np.ndarray) -> Image.Image:
    linear = np.clip(image * _WHITE / np.quantile(image, 0.98), 0, 1)
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return Image.fromarray(np.round(255 * srgb).astype(np.uint8))


if __name__ == "__main__":
    main()
