"""What it costs that the chains of a long render begin anew in each batch.

    python benchmarks/chains_in_batches.py [INTEGRATOR…]

Renders a scene in one piece and in eight, and compares errors and CPU times. The image is small,
and pieces are so short that a chain has 64 mutations in each, as in the batches of a long render.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import mitsuba_ext  # noqa: F401
from mitsuba_ext.images import metrics
from mitsuba_ext.inputs.chosen import LastScene
from mitsuba_ext.rendering.batches import batch_seeds

import mitsuba as mi  # isort: skip

SCENE = Path(__file__).parents[1] / "scenes" / "cornell_box.xml"
SIZE, SPP, PIECES = (32, 24), 1024, 8


def _reference() -> np.ndarray:
    chosen = LastScene().choose(SCENE, SIZE, {"rfilter": "box"}, "bdpt", 0)
    integrator, scene = chosen.named.integrator, chosen.scene
    parts = [integrator.render(scene, chosen.sensor, s, 1024) for s in batch_seeds(99, 12)]
    return np.mean([np.array(part, dtype=np.float64)[..., :3] for part in parts], axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("integrators", nargs="*",
                        default=["erpt", "mlt:chains=1536", "pssmlt:chains=1536"],
                        help="luminance_samples=1000 is added: a quarter of the mutations, as in "
                             "batches of usual size")
    parser.add_argument("--seeds", type=int, default=12)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    scenes = LastScene()

    def rendered(integrator: str, seed: int, spp: int) -> np.ndarray:
        few = "," if ":" in integrator else ":"
        specification = f"{integrator}{few}luminance_samples=1000"
        chosen = scenes.choose(SCENE, SIZE, {"rfilter": "box"}, specification, 0)
        image = chosen.named.integrator.render(chosen.scene, chosen.sensor, seed, spp)
        return np.array(image, dtype=np.float64)[..., :3]

    truth = _reference()
    for integrator in options.integrators:
        ways = {
            1: lambda seed, name=integrator: rendered(name, seed, SPP),
            PIECES: lambda seed, name=integrator: np.mean(
                [rendered(name, s, SPP // PIECES) for s in batch_seeds(seed, PIECES)], axis=0),
        }  # fmt: skip
        errors, seconds = ({count: [] for count in ways} for _ in range(2))
        for render in ways.values():  # compiles
            render(1 << 20)
        for seed in range(options.seeds):
            for count, render in ways.items():
                begin = time.process_time()
                image = render(seed)
                seconds[count].append(time.process_time() - begin)
                errors[count].append(metrics.relative_mse(image, truth))
        error = {count: np.mean(found) for count, found in errors.items()}
        spread = sum((np.std(found) / np.mean(found)) ** 2 for found in errors.values())
        ratio = error[PIECES] / error[1]
        deviation = ratio * (spread / options.seeds) ** 0.5
        whole, pieces = (np.median(found) for found in (seconds[1], seconds[PIECES]))
        print(
            f"{integrator}: {ratio:.2f} +- {deviation:.2f} of the error of one piece, which takes "
            f"{whole:.2f} s of CPU time for {SPP * SIZE[0] * SIZE[1] / 1e6:.2f} million mutations; "
            f"each piece takes {(pieces - whole) / (PIECES - 1):.2f} s besides", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
