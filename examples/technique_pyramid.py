"""Renders one of our scenes with ``bdpt`` and draws the image of each of its techniques:

    .venv/bin/python examples/technique_pyramid.py caustic --max-depth 4 --out pyramid.png

Each row shows paths of one length; from left to right, more of their vertices come from the light
path. All images have the exposure of the complete image.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"


def layers(file: Path, kind: str) -> dict[tuple[int, int], np.ndarray]:
    """The ``weighted`` or ``plain`` images of a file that ``bdpt`` wrote, by (s, t)."""
    images = {}
    for name, bitmap in mi.Bitmap(str(file)).split():
        if name.startswith(f"{kind}."):
            s, t = (int(number[1:]) for number in name.split(".")[1].split("_"))
            images[s, t] = np.array(bitmap)
    return images


@click.command()
@click.argument("name")
@click.option("--max-depth", default=4)
@click.option("--spp", default=256)
@click.option("--width", default=240)
@click.option("--kind", type=click.Choice(["weighted", "plain"]), default="weighted")
@click.option("--out", type=click.Path(path_type=Path), default=Path("pyramid.png"))
def main(name: str, max_depth: int, spp: int, width: int, kind: str, out: Path) -> None:
    """Draws the techniques of the scene NAME."""
    from matplotlib.figure import Figure

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(
        str(SCENES / f"{name}.xml"), width=width, height=width * 9 // 16, rfilter="box"
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "techniques.exr"
        integrator = {"type": "bdpt", "max_depth": max_depth, "technique_images": str(file)}
        image = np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp))
        images = layers(file, kind)
    white = np.quantile(image[..., :3], 0.98)
    rows = range(1, max_depth + 1)
    figure = Figure(figsize=(2.2 * (max_depth + 1), 1.45 * max_depth), layout="constrained")
    axes = figure.subplots(max_depth, max_depth + 1, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for k in rows:
        for s in range(k + 1):
            if (s, k + 1 - s) in images:
                shown = np.clip(images[s, k + 1 - s] / white, 0, 1) ** (1 / 2.2)
                axes[k - 1, s].imshow(shown)
                axes[k - 1, s].set_title(f"s = {s}, t = {k + 1 - s}", fontsize=8)
    figure.savefig(out, dpi=110)
    print(out)


if __name__ == "__main__":
    main()
