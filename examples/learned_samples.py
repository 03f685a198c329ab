"""Shows what ``pss_guided`` has learned for a pixel (as Fig. 2.3 of the thesis does for a tile).

``.venv/bin/python examples/learned_samples.py scenes/door_ajar.xml 200 150`` writes
``learned_samples.png``: the density of the primary samples of the first bounce, and the directions
that the surface's BSDF samples with them, projected along the normal.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from matplotlib import pyplot as plt

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Resolution of the plot of a density, and number of plotted directions.
RESOLUTION, DIRECTIONS = 64, 4096


@click.command()
@click.argument("scene", type=click.Path(exists=True, path_type=Path))
@click.argument("x", type=int)
@click.argument("y", type=int)
@click.option("--regions", type=click.Choice(["surfaces", "tiles"]), default="surfaces")
@click.option("--spp", default=64, show_default=True, help="Samples per pixel of the render.")
@click.option("--out", type=click.Path(path_type=Path), default="learned_samples.png")
def main(scene: Path, x: int, y: int, regions: str, spp: int, out: Path) -> None:
    """Renders SCENE and plots the learned density for the pixel X, Y."""
    mi.set_variant("llvm_ad_rgb")
    loaded = mi.load_file(str(scene))
    integrator = mi.load_dict({"type": "pss_guided", "regions": regions, "max_depth": 6})
    image = mi.render(loaded, integrator=integrator, spp=spp)
    print(integrator.statistics.learned)
    print(f"{integrator.statistics.zero_radiance:.1%} of the paths had zero radiance")
    guide = integrator.guide
    if guide is None:
        raise click.ClickException("nothing is guided in this scene")

    sensor = loaded.sensors()[0]
    width, height = sensor.film().crop_size()
    position = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    si = loaded.ray_intersect(ray)
    if not dr.any(si.is_valid()):
        raise click.ClickException(f"the pixel {x}, {y} shows no surface")
    pixel = mi.UInt32(y * int(width) + x)

    cell = (dr.arange(mi.Float, RESOLUTION) + 0.5) / RESOLUTION
    u, v = dr.meshgrid(cell, cell)
    density = guide.density(si, pixel, mi.Point2f(u, v)).numpy().reshape(RESOLUTION, RESOLUTION)

    # Samples of that density, by rejection sampling
    random = np.random.default_rng(0)
    tried = mi.Point2f(random.random((2, 64 * DIRECTIONS), np.float32))
    probability = guide.density(si, pixel, tried).numpy() / density.max()
    kept = np.flatnonzero(random.random(len(probability)) < probability)[:DIRECTIONS]
    sample = dr.gather(mi.Point2f, tried, mi.UInt32(kept.astype(np.uint32)))
    lobe = mi.Float(random.random(len(kept), np.float32))
    bs, _weight = si.bsdf(ray).sample(mi.BSDFContext(), si, lobe, sample)
    directions = bs.wo.numpy()

    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2))
    axes[0].imshow(np.clip(np.array(mi.TensorXf(image))[..., :3], 0, 1) ** (1 / 2.2))
    axes[0].plot([x], [y], "r+", markersize=14)
    axes[0].set_title("the pixel")
    shown = axes[1].imshow(density, origin="lower", extent=(0, 1, 0, 1), cmap="magma")
    axes[1].set_title("density of primary samples")
    figure.colorbar(shown, ax=axes[1])
    axes[2].scatter(directions[0], directions[1], s=2)
    axes[2].set(aspect="equal", xlim=(-1, 1), ylim=(-1, 1), title="directions around the normal")
    figure.tight_layout()
    figure.savefig(out)
    print(out)


if __name__ == "__main__":
    main()
