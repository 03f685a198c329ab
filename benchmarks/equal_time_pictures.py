"""Renders the pictures of the README: ``path`` beside an integrator of ours, at equal time.

    .venv/bin/python benchmarks/equal_time_pictures.py rooms door_ajar glass_lamp pool

Kernels are compiled before. ``path`` is rendered by ``composed_path`` with its defaults, which
makes the same image and ends at a timeout. Both halves have one exposure: that of our image.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from equal_samples import load
from PIL import Image, ImageDraw

import mitsuba as mi  # isort: skip

FIGURES = Path(__file__).parents[1] / "docs" / "figures"

#: The integrator of ours for each scene, and the longest paths.
OURS = {
    "rooms": ({"type": "auto_path"}, 8),
    "door_ajar": ({"type": "auto_path"}, 8),
    "glass_lamp": ({"type": "bdpt"}, 12),
    "pool": ({"type": "vcm"}, 8),
    "caustic": ({"type": "bdpt"}, 8),
}

#: Where the brightest values of our image come to lie, before the sRGB curve.
_WHITE = 0.9


def _rendered(scene: mi.Scene, integrator: dict, seconds: float, max_depth: int):
    """The image, and the samples per pixel that fit into the time."""
    timed = mi.load_dict({**integrator, "max_depth": max_depth, "timeout": seconds})
    for seed in range(3):  # the first two compile the kernels of timed passes
        image = np.array(mi.render(scene, integrator=timed, spp=1 << 16, seed=seed))[..., :3]
    return image, timed.statistics


def _to_8_bit(image: np.ndarray, scale: float) -> Image.Image:
    linear = np.clip(image * scale, 0, 1)
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return Image.fromarray(np.round(255 * srgb).astype(np.uint8))


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(OURS)))
@click.option("--seconds", default=5.0, show_default=True, help="For each render.")
@click.option("--size", type=(int, int), default=(320, 180), show_default=True)
def main(names: tuple[str, ...], seconds: float, size: tuple[int, int]) -> None:
    """Renders the scenes NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    for name in names or OURS:
        ours, max_depth = OURS[name]
        scene = load(name, size)
        halves = {"path": {"type": "composed_path"}, ours["type"]: ours}
        made = {k: _rendered(scene, v, seconds, max_depth) for k, v in halves.items()}
        scale = _WHITE / np.quantile(made[ours["type"]][0], 0.98)
        picture = Image.new("RGB", (2 * size[0] + 4, size[1]), "white")
        for index, (label, (image, statistics)) in enumerate(made.items()):
            half = _to_8_bit(image, scale)
            ImageDraw.Draw(half).text((6, size[1] - 16), label, fill="white", stroke_width=1,
                                      stroke_fill="black")  # fmt: skip
            picture.paste(half, (index * (size[0] + 4), 0))
            print(f"{name}, {label}: {statistics.spp} spp in {statistics.seconds:.1f} s")
        picture.save(FIGURES / f"equal_time_{name}.jpg", quality=90)


if __name__ == "__main__":
    main()
