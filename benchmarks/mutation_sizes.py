"""Measures what other sizes of mutations do to the error of Metropolis integrators:

    .venv/bin/python benchmarks/mutation_sizes.py ring pool keyhole --spp 32 --seeds 8

Prints, for each scene and integrator, the table of ``mitsuba-ext compare --no-reference`` for the
default sizes, and for both sizes multiplied by each factor. The lines below it have the rates of
accepted steps.
"""

from __future__ import annotations

import click
from equal_samples import SCENES, options

from mitsuba_ext import compare
from mitsuba_ext.estimators.chains.small_steps import SmallSteps

import mitsuba as mi  # isort: skip

FACTORS = (1, 1 / 4, 4)
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
    for name in names:
        changes = compare.SceneChanges(None, "box", max_depth)
        scene = compare.SceneSetup(SCENES / f"{name}.xml", size, changes=changes)
        for kind in kinds or INTEGRATORS:
            made = {f"{kind}, sizes x {f:g}": with_sizes(kind, f, max_depth) for f in FACTORS}
            compare.show(compare.Comparison(
                scene, made, compare.equal_samples(spp), seeds, with_reference=False, cpu_time=True
            ).run())  # fmt: skip


def with_sizes(kind: str, factor: float, max_depth: int) -> mi.Integrator:
    """An integrator whose sizes, which are no parameters, are multiplied by a factor."""
    integrator = mi.load_dict({**INTEGRATORS[kind], "max_depth": max_depth})
    owner = getattr(integrator, "long_chains", integrator)
    owner.steps = SmallSteps(factor * SmallSteps.low, factor * SmallSteps.high)
    return integrator


if __name__ == "__main__":
    main()
