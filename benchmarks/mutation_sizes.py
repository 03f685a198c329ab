"""Measures what other sizes of mutations do to the error of Metropolis integrators:

    .venv/bin/python benchmarks/mutation_sizes.py ring pool keyhole --spp 32 --seeds 8

Both sizes are multiplied by each factor. Writes a row of Markdown for each scene and integrator:
the error (as in ``benchmarks/equal_samples.py``) in units of that of the default sizes, and the
rate of accepted small steps.
"""

from __future__ import annotations

import re

import numpy as np
from equal_samples import error, load, options, print_header, print_row, render_in_turns, title

import mitsuba_ext  # noqa: F401
from mitsuba_ext.estimators.chains.small_steps import SmallSteps

import click  # isort: skip
import mitsuba as mi  # isort: skip

FACTORS = (1 / 4, 1, 4)
INTEGRATORS = {
    "pssmlt, camera paths": {"type": "pssmlt", "bidirectional": False},
    "pssmlt, both ends": {"type": "pssmlt"},
    "erpt": {"type": "erpt"},
}


@click.command()
@options
@click.option("--integrator", "kinds", multiple=True, help="Which (default: all).")
def main(
    names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple, kinds: tuple
) -> None:
    """Compares sizes on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(["scene", "integrator", *(f"{factor:g}" for factor in FACTORS)])
    for name in names:
        scene = load(name, size)
        for kind in kinds or INTEGRATORS:
            jobs = {str(f): (scene, with_sizes(kind, f, max_depth), spp) for f in FACTORS}
            renders = render_in_turns(jobs, seeds)
            mean = np.mean([r.mean for r in renders.values()], axis=0)
            errors = [error(r.variance, mean) for r in renders.values()]
            default = errors[FACTORS.index(1)]
            accepted = [re.findall(r"([\d.]+%) of small", r.learned[-1])
                        for r in renders.values()]  # fmt: skip
            cells = [f"{e / default:.2f} ({''.join(a)})" for e, a in zip(errors, accepted)]
            print_row([title(name), kind, *cells])


def with_sizes(kind: str, factor: float, max_depth: int) -> mi.Integrator:
    """An integrator whose sizes, which are no parameters, are multiplied by a factor."""
    integrator = mi.load_dict({**INTEGRATORS[kind], "max_depth": max_depth})
    owner = getattr(integrator, "long_chains", integrator)
    owner.steps = SmallSteps(factor * SmallSteps.low, factor * SmallSteps.high)
    return integrator


if __name__ == "__main__":
    main()
