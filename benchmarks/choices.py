"""Is what learns at least as efficient as ``path``, in renders of a given time?

    python benchmarks/choices.py scenes/window.xml scenes/open.xml --seconds 5 --seeds 3

All integrators take the same number of samples. Error: the variance of a pixel between the seeds /
(mean² + 0.01 · (mean of the image)²), without the largest 0.1 % of the pixels (and, in brackets,
with them). Time: the median over the seeds but the first, which compiles; learning and what other
seeds compile included.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

#: The first one is that to which the others are compared.
INTEGRATORS = ("path", "neepp", "pss_guided", "auto_path")


def _render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int):
    begin = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
    return image[..., :3].astype(float), time.perf_counter() - begin


def _kept(learned: str) -> str:
    """What was kept, in a word for each decision."""
    words = {"guide:": "guide", "light map:": "light map"}
    kept = [word for text in learned.split("; ") for start, word in words.items()
            if text.startswith(start)]  # fmt: skip
    kept += [text for text in learned.split("; ") if text.startswith("light paths pay")]
    return " and ".join(kept) or "nothing"


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--seconds", default=5.0, show_default=True, help="Of a render with path.")
@click.option("--seeds", default=4, show_default=True)
@click.option("--size", default=(320, 180), type=(int, int), show_default=True)
@click.option("--integrator", "names", multiple=True, default=INTEGRATORS, help="The first: path.")
def main(
    files: tuple[Path, ...],
    seconds: float,
    seeds: int,
    size: tuple[int, int],
    names: tuple[str, ...],
) -> None:
    """Compares on the scenes FILES."""
    mi.set_variant("llvm_ad_rgb")
    for file in files:
        scene = mi.load_file(str(file))
        sensor = mi.traverse(scene.sensors()[0])
        sensor["film.size"] = sensor["film.crop_size"] = list(size)
        sensor.update()
        made = {name: mi.load_dict({"type": name, "max_depth": 6}) for name in names}
        for _ in range(2):
            speed = 16 / _render(scene, made["path"], 16, 1)[1]
        spp = max(8, round(seconds * speed))
        images, times = {name: [] for name in made}, {name: [] for name in made}
        outcomes = {name: [] for name in made}
        for seed in range(seeds):
            for name, integrator in made.items():
                image, taken = _render(scene, integrator, spp, 1000 * seed + 3)
                images[name].append(image)
                times[name].append(taken)
                if name != "path":
                    outcomes[name].append(_kept(integrator.statistics.learned))
        mean = np.mean([np.mean(some, axis=0) for some in images.values()], axis=0)
        scale = mean**2 + 0.01 * mean.mean() ** 2
        cost = {}
        for name in made:
            error = np.sort((np.var(images[name], axis=0, ddof=1) / scale).mean(axis=2), axis=None)
            trimmed = error[: int(0.999 * len(error))].mean()
            taken = statistics.median(times[name][1:])
            cost[name] = trimmed * taken, error.mean() * taken
        gains = {name: np.divide(cost["path"], cost[name]) for name in made}
        ratios = ", ".join(f"{name} {few:.2f} ({all_:.2f})" for name, (few, all_) in gains.items())
        print(f"{file.parent.name}/{file.stem}, {spp} spp: {ratios}", flush=True)
        for name in names[1:]:
            print(f"    {name} kept, by seed: {' | '.join(outcomes[name])}", flush=True)


if __name__ == "__main__":
    main()
