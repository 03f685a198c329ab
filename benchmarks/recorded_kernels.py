"""The time of short renders with kernels that are recorded (``mitsuba_ext/transport/frozen.py``),
and with kernels that are traced for each pass.

    python benchmarks/recorded_kernels.py ../shared/scenes/kitchen/scene.xml --spp 1

Both take turns; the first half of the rounds, which compile and record, does not count.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

#: Chains of those integrators that have such, for ``--mutations``.
_CHAINS, _STEPS = 65536, 96


def _seconds(scene: mi.Scene, integrator: mi.Integrator, seed: int, spp: int, kept: bool) -> float:
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, kept):
        begin = time.perf_counter()
        mi.render(scene, integrator=integrator, seed=seed, spp=spp).numpy()
        return time.perf_counter() - begin


def _per_mutation(scene: mi.Scene, integrator: mi.Integrator, seed: int, kept: bool) -> float:
    """Microseconds of a mutation of a running chain."""
    times, done = [], []

    def progress(share: float) -> None:
        times.append(time.perf_counter())
        done.append(share)

    integrator.progress = progress
    pixels = 160 * 90
    _seconds(scene, integrator, seed, _CHAINS * _STEPS // pixels, kept)
    # From the second launch on, as the first one traces; without the last one, which is short
    steps = (done[-2] - done[0]) * _STEPS
    return 1e6 * (times[-2] - times[0]) / (steps * _CHAINS)


@click.command()
@click.argument("file", type=click.Path(exists=True, path_type=Path))
@click.option("--integrator", "names", multiple=True,
              default=("path", "composed_path", "auto_path", "bdpt", "mlt", "pssmlt"))
@click.option("--spp", default=1, show_default=True)
@click.option("--rounds", default=8, show_default=True)
@click.option("--mutations", is_flag=True, help="Time mutations of mlt and pssmlt instead.")
def main(file: Path, names: tuple[str, ...], spp: int, rounds: int, mutations: bool) -> None:
    """Renders FILE at 160x90."""
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(file))
    sensor = mi.traverse(scene.sensors()[0])
    sensor["film.size"] = sensor["film.crop_size"] = [160, 90]
    sensor.update()
    more = {"chains": _CHAINS} if mutations else {}
    for name in ("mlt", "pssmlt") if mutations else names:
        integrator = mi.load_dict({"type": name, "max_depth": 6, **more})
        found: dict[bool, list[float]] = {True: [], False: []}
        for seed in range(rounds):
            for kept in (False, True):
                if mutations:
                    found[kept].append(_per_mutation(scene, integrator, seed, kept))
                else:
                    found[kept].append(_seconds(scene, integrator, seed, spp, kept))
        traced, recorded = (statistics.median(found[kept][rounds // 2 :]) for kept in (False, True))
        unit = "us a mutation" if mutations else "s"
        print(f"{name}: {traced:.3f} {unit} traced, {recorded:.3f} recorded")


if __name__ == "__main__":
    main()
