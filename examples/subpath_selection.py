"""Compares uniform and learned selection of light vertices in ``bdpt`` at equal samples:

    .venv/bin/python examples/subpath_selection.py corridor night_classroom /somewhere/scene.xml

Writes one row of Markdown for each scene: root mean square error and CPU time (learning included),
relative to the uniform selection; the time to an equal error (error² · time); and what was learned.
Errors are those of ``examples/bidirectional.py``; times are the shortest of all seeds.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import numpy as np
from bidirectional import error, load

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

SELECTIONS = ("uniform", "visibility")


@click.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--max-depth", default=8)
@click.option("--spp", default=64)
@click.option("--seeds", default=4)
@click.option("--size", type=(int, int), default=(128, 72), help="Width and height of the film.")
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares the selections on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print("| scene | error | time | time to equal error | |\n|---|---|---|---|---|")
    for name in names:
        scene = load(name, *size)
        integrators = [
            mi.load_dict({"type": "bdpt", "max_depth": max_depth, "subpath_selection": s})
            for s in SELECTIONS
        ]
        images, seconds = ([], []), ([], [])
        for seed in range(seeds + 1):  # the first compiles the kernels
            for i, integrator in enumerate(integrators):
                start = time.process_time()
                image = mi.render(scene, integrator=integrator, seed=1 + 7919 * seed, spp=spp)
                image = np.array(image, dtype=np.float64)
                if seed > 0:
                    images[i].append(image)
                    seconds[i].append(time.process_time() - start)
        mean = np.mean(images[0] + images[1], axis=0).reshape(-1, 3)
        squares = [error(np.var(x, axis=0, ddof=1).reshape(-1, 3), mean) for x in images]
        ratio, duration = squares[1] / squares[0], min(seconds[1]) / min(seconds[0])
        learned = integrators[1].statistics.learned
        label = Path(name).parent.name if Path(name).name == "scene.xml" else Path(name).stem
        cells = [label, *(f"{x:.2f}" for x in (ratio**0.5, duration, ratio * duration)), learned]
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
