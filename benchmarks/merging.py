"""Compares ``vcm`` and ``sppm`` with other integrators at about equal time:

    .venv/bin/python benchmarks/merging.py pool caustic /somewhere/scene.xml --seconds 5

The name of a scene may be followed by parameters: ``"pool:lamp=0.1:radiance=9920, 9120, 7520"``.

Each integrator gets so many samples per pixel as fit into the time, by a short render before.
Writes a row of Markdown for each scene and integrator: samples per pixel, seconds (the median of
the seeds but the first; with ``--cpu`` those of all threads together, which other work on the
machine hardly changes), the variance between seeds (relative as in ``equal_samples.py``; all of
it, and without the largest 0.1 % of the values), the efficiency that follows from each, relative to
the first integrator, and the mean of the image, in which bias shows, with its standard error.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import click
import numpy as np
from equal_samples import error, load, print_header, print_row, title

import mitsuba_ext  # noqa: F401

import mitsuba as mi  # isort: skip

INTEGRATORS = ("path", "bdpt", "vcm", "sppm", "erpt", "pssmlt", "mlt")

#: Samples per pixel of the renders that compile kernels and measure the speed.
_TRIAL = 32


def renders(
    scene: mi.Scene,
    kind: str,
    max_depth: int,
    seconds: float,
    seeds: int,
    clock: Callable[[], float],
) -> tuple[np.ndarray, float, int]:
    """The images, the time of one, and its samples per pixel."""

    def render(spp: int, seed: int) -> tuple[np.ndarray, float]:
        integrator = mi.load_dict({"type": kind, "max_depth": max_depth})
        begin = clock()
        image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3]
        return image.astype(float), clock() - begin

    trials = [render(_TRIAL, 1000 + k)[1] for k in range(3)]
    spp = max(8, round(_TRIAL * seconds / min(trials)))
    images, times = zip(*(render(spp, seed) for seed in range(seeds)))
    return np.stack(images), float(np.median(times[1:])), spp


@click.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--seconds", default=5.0, show_default=True)
@click.option("--cpu", is_flag=True, help="The seconds are CPU time.")
@click.option("--seeds", default=4, show_default=True)
@click.option("--max-depth", default=8, show_default=True)
@click.option("--size", type=(int, int), default=(160, 90), show_default=True)
@click.option("--integrator", "kinds", multiple=True, default=INTEGRATORS)
def main(names, seconds, cpu, seeds, max_depth, size, kinds) -> None:
    """Compares on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(["scene", "", "spp", "seconds", "error", "trimmed", "efficiency", "trimmed",
                  "mean"])  # fmt: skip
    clock = time.process_time if cpu else time.perf_counter
    for name in names:
        scene = load(name, size)
        found = {kind: renders(scene, kind, max_depth, seconds, seeds, clock) for kind in kinds}
        # The scale of errors is that of the integrator with the least of them
        mean = min((images for images, _, _ in found.values()), key=_spread).mean(axis=0)
        first: dict[float, float] = {}
        for kind, (images, taken, spp) in found.items():
            errors = [error(images.var(axis=0, ddof=1), mean, trimmed=t) for t in (0.0, 0.001)]
            costs = [e * taken for e in errors]
            ratios = [first.setdefault(k, cost) / cost for k, cost in enumerate(costs)]
            means = images.mean(axis=(1, 2, 3))
            deviation = means.std(ddof=1) / len(means) ** 0.5
            print_row([
                title(name), kind, str(spp), f"{taken:.1f}", *(f"{e:.2g}" for e in errors),
                *(f"{r:.2g}" for r in ratios), f"{means.mean():.4g} ± {deviation:.1g}",
            ])  # fmt: skip


def _spread(images: np.ndarray) -> float:
    return float(images.var(axis=0).mean())


if __name__ == "__main__":
    main()
