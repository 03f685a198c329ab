"""Compares adaptive samples with uniform ones, at equal samples and at equal time.

    .venv/bin/python benchmarks/adaptive.py mirrors_and_glass caustic --spp 128

Both render with ``composed_path``. The uniform render at equal time gets as many samples as fit
into the time of the adaptive one. Errors of pixels are relative, as in relMSE: the 95th percentile
and the mean over pixels and seeds are given relative to those of uniform samples.
"""

from __future__ import annotations

import click
import numpy as np
from equal_samples import load, options, print_header, print_row, render_in_turns, title

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Samples of the reference, in units of those of a render.
REFERENCE = 16


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
    for name in names:
        scene = load(name, size)
        jobs = {"adaptive": (scene, {"type": "adaptive", "nested": path}, spp),
                "uniform": (scene, path, spp)}  # fmt: skip
        adaptive, uniform = render_in_turns(jobs, seeds).values()
        slower = min(adaptive.seconds) / min(uniform.seconds)
        more = {"": (scene, path, max(1, round(spp * slower)))}
        longer = render_in_turns(more, seeds)[""]
        integrator = mi.load_dict(path)
        reference = np.mean([
            np.array(mi.render(scene, integrator=integrator, spp=spp, seed=3000 + i))
            for i in range(REFERENCE)
        ], axis=0)  # fmt: skip
        ours = figures(adaptive.images, reference)
        equal = ours / figures(uniform.images, reference)
        in_time = ours / figures(longer.images, reference)
        values = [*equal, slower, *in_time]
        print_row([title(name), *(f"{value:.2f}" for value in values)])
        dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
