"""Compares adaptive samples with uniform ones, at equal samples and at equal time.

    .venv/bin/python benchmarks/adaptive.py mirrors_and_glass caustic --spp 128

Both render with ``composed_path``. The uniform render at equal time gets as many samples as fit
into the time of the adaptive one. Errors of pixels are relative, as in relMSE: the 95th percentile
and the mean over pixels and seeds are given relative to those of uniform samples.
"""

from __future__ import annotations

import time

import click
import numpy as np
from equal_samples import load, options, print_header, print_row, title

import mitsuba_ext  # noqa: F401

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Samples of the reference, in units of those of a render.
REFERENCE = 16


def timed(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int):
    """The image, and the seconds that it took."""
    begin = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
    return image.astype(np.float64), time.perf_counter() - begin


def errors(images: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The relative errors of pixels."""
    square = np.mean((images - reference) ** 2, axis=-1)
    brightness = reference.mean(axis=-1)
    return np.sqrt(square / (brightness**2 + 1e-2 * brightness.mean() ** 2))


def figures(images: list[np.ndarray], reference: np.ndarray) -> np.ndarray:
    error = errors(np.array(images), reference)
    return np.array([np.quantile(error, 0.95), error.mean()])


@click.command()
@options
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    columns = ["95th percentile", "mean", "time"]
    print_header(["scene", *columns, "at equal time: 95th percentile", "mean"])
    path = {"type": "composed_path", "max_depth": max_depth}
    uniform, adaptive = mi.load_dict(path), mi.load_dict({"type": "adaptive", "nested": path})
    for name in names:
        scene = load(name, size)
        for integrator in (uniform, adaptive):
            timed(scene, integrator, spp, 0)
        renders = [
            (timed(scene, adaptive, spp, seed), timed(scene, uniform, spp, 1000 + seed))
            for seed in range(1, seeds + 1)
        ]
        slower = min(a[1] for a, _ in renders) / min(b[1] for _, b in renders)
        more = max(1, round(spp * slower))
        longer = [timed(scene, uniform, more, 2000 + seed)[0] for seed in range(1, seeds + 1)]
        parts = [timed(scene, uniform, spp, 3000 + i)[0] for i in range(REFERENCE)]
        reference = np.mean(parts, axis=0)
        ours = figures([a[0] for a, _ in renders], reference)
        equal = ours / figures([b[0] for _, b in renders], reference)
        in_time = ours / figures(longer, reference)
        values = [*equal, slower, *in_time]
        print_row([title(name), *(f"{value:.2f}" for value in values)])
        dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
