"""Compares samplers at equal samples, by the variance between seeds and CPU time:

    .venv/bin/python benchmarks/samplers.py cornell_box defocus /somewhere/scene.xml --spp 16,64,256

Writes one row of Markdown for each scene and number of samples: error and time of each sampler, in
units of those of ``independent``. Errors are those of ``benchmarks/equal_samples.py``. Samplers
that round the number of samples up are credited with what they take: their error is multiplied by
it, and their time divided.

Samplers may have parameters. Noise that blurs away is compared by ``--blur``, the standard
deviation in pixels of a Gaussian filter of the images:

    .venv/bin/python benchmarks/samplers.py cornell_box --spp 1,4,16 --blur 2 \\
        --samplers sobol_owen,sobol_owen:blue_noise=true
"""

from __future__ import annotations

import click
import numpy as np
from equal_samples import error, load, print_header, print_row, render_in_turns, title
from scipy.ndimage import gaussian_filter

import mitsuba as mi  # isort: skip

SAMPLERS = "stratified,multijitter,orthogonal,ldsampler,sobol_owen"


@click.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--spp", default="16,64,256", help="Numbers of samples per pixel.")
@click.option("--seeds", default=8)
@click.option("--size", type=(int, int), default=(64, 36), help="Of the film.")
@click.option("--max-depth", default=8)
@click.option("--integrator", default="composed_path")
@click.option("--variant", default="llvm_ad_rgb")
@click.option("--samplers", default=SAMPLERS, help="Besides independent.")
@click.option("--blur", default=0.0, help="Compare blurred images: of so many pixels.")
def main(
    names: tuple[str, ...], spp: str, seeds: int, size: tuple, max_depth: int, integrator: str,
    variant: str, samplers: str, blur: float,
) -> None:  # fmt: skip
    """Compares samplers in the scenes NAMES."""
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    kinds = ["independent", *samplers.split(",")]
    print_header(["scene", "samples", *(f"`{kind}`" for kind in kinds), "time"])
    for name in names:
        for count in map(int, spp.split(",")):
            method = {"type": integrator, "max_depth": max_depth}
            scenes = {kind: load(name, size, kind) for kind in kinds}
            renders = render_in_turns({k: (s, method, count) for k, s in scenes.items()}, seeds)
            for r in renders.values():
                r.images = [gaussian_filter(image, (blur, blur, 0)) for image in r.images]
            mean = np.mean([r.mean for r in renders.values()], axis=0)
            errors = {kind: error(r.variance, mean) for kind, r in renders.items()}
            # Samples taken, in units of those asked for
            more = {kind: _taken(scene, count) / count for kind, scene in scenes.items()}
            cells = [f"{errors[k] / errors['independent'] * more[k]:.3f}" for k in kinds]
            first = renders["independent"].time
            times = [f"{renders[k].time / first / more[k]:.2f}" for k in kinds[1:]]
            print_row([title(name), str(count), *cells, ", ".join(times)])


def _taken(scene: mi.Scene, spp: int) -> int:
    """The samples that the sampler takes."""
    sampler = scene.sensors()[0].sampler()
    sampler.set_sample_count(spp)
    return sampler.sample_count()


if __name__ == "__main__":
    main()
