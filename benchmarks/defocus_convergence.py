"""How fast depth of field comes near a traced thin lens, with and without a denoiser:

    .venv/bin/python benchmarks/defocus_convergence.py kitchen defocus hairball sponza

Writes a row of Markdown for each scene, technique and number of samples (FLIP, SSIM, seconds), and
a plot of FLIP over time. ``path`` traces the ``thinlens``; *denoised* means that Open Image Denoise
has been run, on the image of ``path`` with guides of 32 samples per pixel (whose time counts), and
in ``ecoc_dof`` on the layers. FLIP and SSIM are those against ``path`` at many samples, whose noise
they contain. Times are CPU seconds, the smaller of two, in turns, kernels compiled before.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import matplotlib.pyplot as plt
import numpy as np
from defocus import reference_of, scene_of, ssim, timed
from equal_samples import print_header, print_row
from matplotlib.ticker import LogLocator, NullFormatter

from mitsuba_ext.images.denoising import denoiser
from mitsuba_ext.images.flip import mean_flip
from mitsuba_ext.rendering.scene_guides import render_guides

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

FIGURES = Path(__file__).parents[1] / "docs" / "figures"


def denoised_path(scene: mi.Scene, path: mi.Integrator, spp: int, seed: int):
    image, seconds = timed(scene, path, spp, seed)
    begin = time.process_time()
    guides = render_guides(scene, scene.sensors()[0], seed)
    albedo, normal = (
        np.stack([guides[f"{name}.{c}"] for c in letters], axis=2).astype(np.float32)
        for name, letters in (("albedo", "RGB"), ("normal", "XYZ"))
    )
    color = np.ascontiguousarray(image, dtype=np.float32)
    result = denoiser().denoise(color, albedo=albedo, normal=normal, hdr=True)
    return np.array(result, np.float64), seconds + time.process_time() - begin


def techniques(max_depth: int) -> dict:
    """Renders of a scene, by name: called with the scene, samples per pixel and a seed."""
    nested = {"type": "path", "max_depth": max_depth}
    path = mi.load_dict(nested)
    plain, denoised = (
        mi.load_dict({"type": "ecoc_dof", "denoise": flag, "nested": nested})
        for flag in (False, True)
    )
    return {
        "path": lambda scene, spp, seed: timed(scene, path, spp, seed),
        "path, denoised": lambda scene, spp, seed: denoised_path(scene, path, spp, seed),
        "ecoc_dof": lambda scene, spp, seed: timed(scene, plain, spp, seed),
        "ecoc_dof, denoised": lambda scene, spp, seed: timed(scene, denoised, spp, seed),
    }


@click.command()
@click.option("--size", type=(int, int), default=(320, 180), help="Of the film.")
@click.option("--spp", default="4,16,64", help="Samples per pixel, separated by commas.")
@click.option("--reference-spp", default=1024)
@click.option("--max-depth", default=4)
@click.argument("names", nargs=-1, required=True)
def main(names, size, spp, reference_spp, max_depth) -> None:
    """Compares on the scenes NAMES: hairball, kitchen, sponza, or ours."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    counts = [int(n) for n in spp.split(",")]
    print_header(["scene", "technique", "samples", "FLIP", "SSIM", "CPU seconds"])
    figure, axes = plt.subplots(1, len(names), figsize=(3.6 * len(names), 3), squeeze=False)
    for axis, name in zip(axes[0], names):
        scene = scene_of(name, size)
        reference = reference_of(scene, mi.load_dict({"type": "path", "max_depth": max_depth}),
                                 reference_spp)  # fmt: skip
        renders = techniques(max_depth)
        curves = {label: [] for label in renders}
        for count in counts:
            for render in renders.values():
                render(scene, count, 0)
            times = {label: [render(scene, count, 1)[1]] for label, render in renders.items()}
            for label, render in renders.items():
                image, seconds = render(scene, count, 2)
                flip, seconds = mean_flip(image, reference), min(seconds, *times[label])
                curves[label].append((seconds, flip))
                print_row([name, label, str(count), f"{flip:.4f}", f"{ssim(image, reference):.4f}",
                           f"{seconds:.2f}"])  # fmt: skip
        plot(axis, name, curves)
        dr.flush_malloc_cache()
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(FIGURES / "defocus_convergence.svg", metadata={"Date": None})


def plot(axis: plt.Axes, name: str, curves: dict[str, list[tuple[float, float]]]) -> None:
    """FLIP over CPU seconds, of each technique."""
    for label, points in curves.items():
        axis.loglog(*np.transpose(points), "o-", label=label, markersize=4)
    axis.set(title=name, xlabel="CPU seconds", ylabel="FLIP")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_locator(LogLocator(subs=(1, 2, 5)))
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter(NullFormatter())


if __name__ == "__main__":
    main()
