"""What maps of samples cost where they are of little use: ``swarm_path`` with all maps on beside
``composed_path``, on the scenes of ``make bench``:
``nice .venv/bin/python benchmarks/swarm_bench.py`` (an hour), or with names of scenes.

Of independent seeds: relMSE (the variance of pixels over their squared mean, with a hundredth of
the squared mean of the image added), all of it and without the largest 0.1 %; CPU time of all
threads, learning included, kernels compiled beforehand, medians of turns; and the efficiency,
1 / (relMSE · time), relative to ``composed_path``. ``benchmarks/benchmark.py --integrator path
--integrator swarm_path:direction_map=true`` measures the same by wall-clock time and against
references.
"""

from __future__ import annotations

import click
import numpy as np
from benchmark import DEPTH, OURS, ROOT, SHARED, THEIRS
from swarming import MAPS, cpu_seconds, trimmed

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from mitsuba_ext.inputs.scenes import load_scene


def errors(images: list[np.ndarray]) -> tuple[float, float]:
    """relMSE of images of independent seeds: all of it, and without the largest values."""
    mean = np.mean(images, axis=0)
    relative = np.var(images, axis=0, ddof=1) / (np.square(mean) + 1e-2 * mean.mean() ** 2)
    return float(relative.mean()), trimmed(relative)


def scene_of(name: str) -> mi.Scene:
    """The scene at the size of the benchmark."""
    if name in OURS:
        return load_scene(ROOT / "scenes" / f"{name}.xml").scene
    return load_scene(SHARED / name / "scene.xml", size=THEIRS[name]).scene


@click.command()
@click.argument("names", nargs=-1, type=click.Choice([*OURS, *THEIRS]))
@click.option("--spp", default=32, show_default=True)
@click.option("--seeds", default=4, show_default=True)
@click.option("--maps", default="all", type=click.Choice(["all", "default"]), show_default=True)
def main(names: tuple[str, ...], spp: int, seeds: int, maps: str) -> None:
    """Measures the scenes NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    on = dict.fromkeys(MAPS, True) if maps == "all" else {}
    for name in names or [*OURS, *THEIRS]:
        scene = scene_of(name)
        integrators = {
            "composed_path": mi.load_dict({"type": "composed_path", **DEPTH}),
            "swarm_path": mi.load_dict({"type": "swarm_path", **DEPTH, **on}),
        }
        images: dict[str, list[np.ndarray]] = {kind: [] for kind in integrators}
        times: dict[str, list[float]] = {kind: [] for kind in integrators}
        for turn in range(seeds + 1):
            for kind, integrator in integrators.items():
                dr.sync_thread()
                begin = cpu_seconds()
                image = mi.render(scene, integrator=integrator, seed=7919 * turn + 1, spp=spp)
                image = np.array(image, np.float64)[..., :3]
                if turn > 0:  # The first turn compiles
                    times[kind].append(cpu_seconds() - begin)
                    images[kind].append(image)
        (whole, cut), (own_whole, own_cut) = map(errors, images.values())
        seconds, own_seconds = map(np.median, times.values())
        print(
            f"{name}: {seconds:.2f} CPU s, time {own_seconds / seconds:.2f}, relMSE "
            f"{own_whole / whole:.3f} (trimmed {own_cut / cut:.3f}), efficiency "
            f"{whole * seconds / own_whole / own_seconds:.2f} (trimmed "
            f"{cut * seconds / own_cut / own_seconds:.2f}); "
            f"{integrators['swarm_path'].statistics.learned}",
            flush=True,
        )


if __name__ == "__main__":
    main()
