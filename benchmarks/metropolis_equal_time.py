"""Compares Metropolis integrators at equal CPU time, start-up included:

    .venv/bin/python benchmarks/metropolis_equal_time.py light ring pool keyhole caustic --seeds 8
    .venv/bin/python benchmarks/metropolis_equal_time.py filters ring pool --seeds 8

For each scene and integrator, writes a row of Markdown: mutations or samples per pixel, the CPU
time, the error, the 99th percentile of the pixels' errors, both also in units of those of the first
integrator, and the mean of the image. Errors are those of ``benchmarks/equal_samples.py``:
variances between seeds. Those of filters, which are biased, are squared differences from the mean
of the unbiased integrators, less the variance of that.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from equal_samples import error, load, options, percentile, print_header, print_row, title

import click  # isort: skip
import mitsuba as mi  # isort: skip

_PSSMLT = {"type": "pssmlt", "bidirectional": False}
_ALL = {"type": "erpt", "outliers": 0.0}

#: The groups.
INTEGRATORS = {
    "light": {
        "pssmlt, camera paths": _PSSMLT,
        "erpt": {"type": "erpt"},
        "erpt, all energy": _ALL,
        "pssmlt, both ends": {"type": "pssmlt"},
    },
    "filters": {
        "pssmlt, camera paths": _PSSMLT,
        "erpt": {"type": "erpt"},
        "erpt, most_consecutive 20": {"type": "erpt", "most_consecutive": 20},
        "erpt, all energy": _ALL,
        "erpt, all energy, proposal_filter 7": {**_ALL, "proposal_filter": 7},
        "erpt, all energy, most_consecutive 20": {**_ALL, "most_consecutive": 20},
        "erpt, all energy, both filters": {**_ALL, "proposal_filter": 7, "most_consecutive": 20},
    },
}
COLUMNS = ["scene", "", "per pixel", "seconds", "error", "99th percentile", "ratios", "mean"]


@dataclass
class Rendered:
    """Images of an integrator, their CPU time, and for how many mutations per pixel."""

    images: np.ndarray
    seconds: float
    spp: int

    @property
    def variance(self) -> np.ndarray:
        return self.images.var(axis=0, ddof=1)


@click.command()
@click.argument("group", type=click.Choice(list(INTEGRATORS)))
@options
def main(
    group: str, names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple
) -> None:
    """Compares a group of integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    for name in names:
        scene, seconds = load(name, size), 0.0
        made: dict[str, Rendered] = {}
        for number, (kind, values) in enumerate(INTEGRATORS[group].items()):
            seed = 1 + 1000 * number
            integrator = mi.load_dict({**values, "max_depth": max_depth})
            made[kind] = rendered(scene, integrator, spp, seconds, range(seed, seed + seeds))
            seconds = seconds or made[kind].seconds
        print_rows(title(name), made)


def rendered(
    scene: mi.Scene, integrator: mi.Integrator, spp: int, seconds: float, seeds: range
) -> Rendered:
    """Renders with ``spp``, or with as many as take ``seconds``, if that is not 0."""
    render(scene, integrator, 0, spp)  # Compiles
    for _ in range(2 if seconds else 0):
        spp = max(1, round(spp * seconds / render(scene, integrator, 0, spp)[1]))
    renders = [render(scene, integrator, 7919 * seed, spp) for seed in seeds]
    images = np.array([image for image, _ in renders])
    return Rendered(images, float(np.median([time for _, time in renders])), spp)


def render(
    scene: mi.Scene, integrator: mi.Integrator, seed: int, spp: int
) -> tuple[np.ndarray, float]:
    """An image, and its CPU time."""
    start = time.process_time()
    image = np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp), dtype=np.float64)
    return image, time.process_time() - start


def print_rows(name: str, made: dict[str, Rendered]) -> None:
    """Of a scene."""
    unbiased = {k: r for k, r in made.items() if "filter" not in k and "most" not in k}
    reference = np.mean([r.images.mean(axis=0) for r in unbiased.values()], axis=0)
    doubt = sum(r.variance / len(r.images) for r in unbiased.values()) / len(unbiased) ** 2
    first = None
    for kind, r in made.items():
        squares = r.variance
        if kind not in unbiased:
            squares = np.square(r.images - reference).mean(axis=0) - doubt
        both = np.array([error(squares, reference), percentile(squares, reference)])
        first = both if first is None else first
        print_row([
            name, kind, str(r.spp), f"{r.seconds:.1f}", *(f"{x:.2g}" for x in both),
            ", ".join(f"{x:.2f}" for x in both / first),
            f"{r.images.mean() / reference.mean():.3f}",
        ])  # fmt: skip


if __name__ == "__main__":
    main()
