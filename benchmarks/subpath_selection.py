"""Compares uniform and learned selection of light vertices in ``bdpt`` at equal samples:

    .venv/bin/python benchmarks/subpath_selection.py corridor night_classroom /somewhere/scene.xml

Writes one row of Markdown for each scene: root mean square error and CPU time (learning included),
relative to the uniform selection; the time to an equal error (error² · time); and what was learned
with the last seed. Errors are those of ``benchmarks/equal_samples.py``, times are the median of the
seeds.
"""

from __future__ import annotations

import click
from equal_samples import error, load, options, print_header, print_row, render_in_turns, title

import mitsuba as mi  # isort: skip

SELECTIONS = ("uniform", "visibility")
INTEGRATORS = {kind: {"type": "bdpt", "subpath_selection": kind} for kind in SELECTIONS}


@click.command()
@options
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares the selections on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(["scene", "error", "time", "time to equal error", "learned"])
    for name in names:
        renders = render_in_turns(load(name, size), INTEGRATORS, max_depth, spp, seeds)
        uniform, learned = (renders[kind] for kind in SELECTIONS)
        mean = (uniform.mean + learned.mean) / 2
        square = error(learned.variance, mean) / error(uniform.variance, mean)
        slower = learned.time / uniform.time
        ratios = (f"{x:.2f}" for x in (square**0.5, slower, square * slower))
        print_row([title(name), *ratios, learned.learned[-1]])


if __name__ == "__main__":
    main()
