"""Draws what samplers do:

    .venv/bin/python benchmarks/sampler_plots.py --out samplers.png

- above: the points of a pixel, in pairs of the first numbers that a path draws;
- below: the power spectrum of the error over the pixels, for ``sobol_owen`` alone and with blue
  noise. Each pixel estimates the area of a quarter of a disk. Powers are in units of the mean
  power of ``independent``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

import mitsuba_ext  # noqa: F401  (registers the samplers)  # isort: skip
import mitsuba as mi  # isort: skip

SAMPLERS = (
    "independent", "stratified", "multijitter", "orthogonal", "ldsampler", "sobol_owen",
    "halton", "hammersley", "faure", "lattice", "latin_hypercube",
)  # fmt: skip

#: Numbers of a path, counted from 0: the place in the pixel, then two for the next decision, ….
PAIRS = ((0, 1), (2, 3), (0, 2), (4, 5))

SPECTRA = {
    "independent": {"type": "independent"},
    "sobol_owen": {"type": "sobol_owen"},
    "blue noise": {"type": "sobol_owen", "blue_noise": True},
}


def points(sampler: dict, spp: int, pixels: int, pairs: int, seed: int) -> np.ndarray:
    """The first numbers of samples: [pixel, sample, number]."""
    made = mi.load_dict(sampler)
    made.set_sample_count(spp)
    spp = made.sample_count()
    made.set_samples_per_wavefront(spp)
    made.seed(seed, spp * pixels)
    drawn = [np.array(made.next_2d()).T for _ in range(pairs)]
    return np.concatenate(drawn, axis=1).reshape(pixels, spp, 2 * pairs)


def power(sampler: dict, spp: int, size: int, seeds: int) -> np.ndarray:
    """The mean power of the error, frequencies in the order of ``numpy.fft``: [y, x]."""
    total = np.zeros((size, size))
    for seed in range(seeds):
        drawn = points(sampler, spp, size * size, 1, 1 + 7919 * seed)
        image = ((drawn**2).sum(axis=-1) < 1).mean(axis=-1).reshape(size, size)
        total += np.abs(np.fft.fft2(image - np.pi / 4)) ** 2
    return total / seeds


def radial_means(spectrum: np.ndarray, rings: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies up to 0.5 per pixel, and the mean power of each ring."""
    frequency = np.fft.fftfreq(len(spectrum))
    ring = (np.hypot(frequency, frequency[:, None]) * 2 * rings).astype(int)
    sums, counts = (
        np.bincount(ring.ravel(), weights=w)[:rings] for w in (spectrum.ravel(), None)
    )
    return (np.arange(rings) + 0.5) / (2 * rings), sums / counts


def _draw_projections(figure) -> None:
    axes = figure.subplots(len(PAIRS), len(SAMPLERS))
    for column, kind in zip(axes.T, SAMPLERS):
        drawn = points({"type": kind}, 64, 1, 3, 1)[0]
        column[0].set_title(kind, fontsize=7)
        for axis, (x, y) in zip(column, PAIRS):
            axis.scatter(drawn[:, x], drawn[:, y], s=2, color="black", linewidths=0)
            axis.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
    for axis, (x, y) in zip(axes[:, 0], PAIRS):
        axis.set_ylabel(f"{x + 1}, {y + 1}", fontsize=7)


def _draw_spectra(figure, counts: list[int], size: int, seeds: int) -> None:
    kinds = list(SPECTRA)[1:]
    axes = figure.subplots(
        1, len(counts) * (len(kinds) + 1), width_ratios=[*([1] * len(kinds)), 1.3] * len(counts)
    )
    for index, spp in enumerate(counts):
        first = index * (len(kinds) + 1)
        spectra = {
            kind: power({**sampler, **_width(sampler, size)}, spp, size, seeds)
            for kind, sampler in SPECTRA.items()
        }
        unit = spectra["independent"].mean()
        curves = axes[first + len(kinds)]
        for kind, spectrum in spectra.items():
            curves.loglog(*radial_means(spectrum / unit), linewidth=0.9, label=kind)
        curves.set_title("power by frequency", fontsize=7)
        curves.set_ylim(5e-3, 2)
        curves.tick_params(labelsize=5)
        curves.set_box_aspect(1)
        for axis, kind in zip(axes[first:], kinds):
            shown = np.log10(np.fft.fftshift(spectra[kind]) / unit + 1e-6)
            axis.imshow(shown, vmin=-2, vmax=0.2, cmap="gray")
            axis.set_title(f"{kind}, {spp} spp", fontsize=7)
            axis.axis("off")
    axes[-1].legend(fontsize=5)


def _width(sampler: dict, size: int) -> dict:
    return {"film_width": size} if "blue_noise" in sampler else {}


@click.command()
@click.option("--spp", default="1,4,16", help="Samples per pixel of the spectra.")
@click.option("--size", default=128, help="Pixels of a side of the film.")
@click.option("--seeds", default=16, help="Renders that a spectrum is the mean of.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("samplers.png"))
def main(spp: str, size: int, seeds: int, out: Path) -> None:
    """Draws points and spectra."""
    from matplotlib.figure import Figure

    mi.set_variant("llvm_ad_rgb")
    figure = Figure(figsize=(11, 5.9), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[4, 1.5])
    _draw_projections(above)
    _draw_spectra(below, [int(count) for count in spp.split(",")], size, seeds)
    figure.savefig(out, dpi=110)
    print(out)


if __name__ == "__main__":
    main()
