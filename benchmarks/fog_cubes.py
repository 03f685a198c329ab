"""The noise of cubes of fog, grey and coloured, per sample and per second.

    python benchmarks/fog_cubes.py

Writes a row of Markdown for each scene (a cube of the medium above a floor, 2 units wide): variance
and CPU time of a sample in units of ``composed_path``. Without the 0.1 % of pixels that vary most;
in brackets with all of them. In coloured media, ``volpath`` divides by the density of one colour:
the more samples it takes, the rarer and brighter are the samples that it lacks.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import click
import mitsuba as mi
import numpy as np
from equal_samples import print_header, print_row

ROOT = Path(__file__).parents[1]


def scenes() -> dict[str, dict[str, Any]]:
    """The scenes, by name."""
    sys.path.insert(0, str(ROOT))
    from tests.support.fogs import fog, fog_around_the_camera, grid, homogeneous
    from tests.support.stage import rgb

    density = np.random.default_rng(3).random((6, 5, 7, 1), dtype=np.float32)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)

    def smoke(*colours: float) -> dict[str, Any]:
        values = mi.VolumeGrid((density * np.array(colours, dtype=np.float32)).astype(np.float32))
        volume = {"type": "gridvolume", "grid": values, "raw": True, "to_world": place}
        return {"type": "heterogeneous", "sigma_t": volume, "albedo": rgb(0.9, 0.9, 0.9)}

    return {
        "0.5; a lamp": fog("area", homogeneous(0.5, 0.9)),
        "0.5; the sky": fog("environment", homogeneous(0.5, 0.9)),
        "20; a lamp": fog("area", homogeneous(20.0, 0.9)),
        "0.1, around the camera; a lamp": fog_around_the_camera("area", homogeneous(0.1, 0.9)),
        "grid, up to 2; a lamp": fog("area", grid(1.0, 0.9)),
        "0.2, 0.5, 0.9; a lamp": fog("area", homogeneous([0.2, 0.5, 0.9], 0.9)),
        "0.1, 1, 10; a lamp": fog("area", homogeneous([0.1, 1.0, 10.0], 0.9)),
        "0.1, 1, 10; the sky": fog("environment", homogeneous([0.1, 1.0, 10.0], 0.9)),
        "grid, up to 2, 5, 9; a lamp": fog("area", smoke(2.0, 5.0, 9.0)),
        "grid, up to 0.3, 3, 9; a lamp": fog("area", smoke(0.3, 3.0, 9.0)),
        "grid, up to 0.3, 3, 9; the sky": fog("environment", smoke(0.3, 3.0, 9.0)),
    }


def measured(scene: mi.Scene, kind: str, spp: int, seeds: int) -> tuple[float, float, float]:
    """The variance of a sample without and with the pixels that vary most, and its CPU time."""
    integrator = mi.load_dict({"type": kind, "max_depth": 12})
    images, seconds = [], []
    for seed in range(seeds + 1):
        start = time.process_time()
        images.append(np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed)))
        seconds.append(time.process_time() - start)
    variance = np.sort(np.var(images[1:], axis=0, ddof=1).mean(axis=-1).ravel()) * spp
    return variance[: -(len(variance) // 1000 + 1)].mean(), variance.mean(), np.mean(seconds[1:])


@click.command()
@click.option("--spp", default=512, help="Samples per pixel of a render.")
@click.option("--seeds", default=8, help="Renders of each integrator.")
@click.option("--variant", default="llvm_ad_rgb")
def main(spp: int, seeds: int, variant: str) -> None:
    """Compares ``volpath`` and ``volpathmis`` with ``composed_path``."""
    mi.set_variant(variant)
    import mitsuba_ext  # noqa: F401  (registers the plugins)

    print_header(["extinction; light from", *("volpath", "volpathmis")])
    for name, content in scenes().items():
        scene = mi.load_dict(content)
        ours = measured(scene, "composed_path", spp, seeds)
        cells = []
        for kind in ("volpath", "volpathmis"):
            trimmed, whole, cost = (a / b for a, b in zip(measured(scene, kind, spp, seeds), ours))
            cells.append(f"{trimmed:.3g} ({whole:.3g}), {cost:.2f}")
        print_row([name, *cells])
        del scene


if __name__ == "__main__":
    main()
