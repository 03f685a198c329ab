"""Does ``auto`` choose well between photons and camera paths in fog?

    python benchmarks/fog.py                                # all scenes
    python benchmarks/fog.py fog sun --seeds 3 --integrator sppm --integrator auto

Renders each scene with each integrator and with so many seeds, in turns, at equal samples, and
writes a row of Markdown for each integrator: efficiency in units of the first one (in brackets with
the largest 0.1 % of the squared errors), squared error and CPU time of a render, the mean of the
image in units of the reference's, and of ``auto`` what it chose and what it says about photons.

Errors are relative as in ``equal_samples.py``, against a reference in ``out/fog``, which is
rendered where it is missing. The noise of the reference is subtracted. The time contains all
learning; the first render of each integrator compiles and does not count.
"""

from __future__ import annotations

import collections
import time
from pathlib import Path

import click
import numpy as np
from equal_samples import SCENES, TRIMMED, load, print_header, print_row
from fog_scenes import FOGS

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)
from mitsuba_ext.planning.pixel_estimates import relative_scale

import mitsuba as mi  # isort: skip

FOLDER = Path(__file__).parents[1] / "out" / "fog"

#: Our scenes, and samples per pixel of a render of each scene.
FILES = ("fog", "volume_caustic")
SPP = {"fog": 160, "bulb": 146, "dark_room": 146}

#: Samples per pixel of a reference, and how many batches of them there are. Photons render some.
_REFERENCE_SPP, _BATCHES = {"bulb": 256, "volume_caustic": 512}, 4
_BY_PHOTONS = ("fog", "volume_caustic", "bulb")


def make(kind: str) -> mi.Integrator:
    return mi.load_dict({"type": kind, "max_depth": 8})


def image_of(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), dtype=float)


def reference(name: str, scene: mi.Scene, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean of so many samples of each pixel, and its variance."""
    size = "x".join(map(str, scene.sensors()[0].film().crop_size()))
    file = FOLDER / f"{name}_{size}_{spp}spp.npz"
    if not file.exists():
        integrator = make("sppm" if name in _BY_PHOTONS else "composed_path")
        batches = [
            image_of(scene, integrator, spp // _BATCHES, 90001 + 101 * k) for k in range(_BATCHES)
        ]
        file.parent.mkdir(parents=True, exist_ok=True)
        variance = np.var(batches, axis=0, ddof=1) / _BATCHES
        np.savez(file, mean=np.mean(batches, axis=0), variance=variance)
    stored = np.load(file)
    return stored["mean"], stored["variance"]


def errors(images: list[np.ndarray], mean: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """The relative squared error of a render, without the largest 0.1 % of the values and with
    them. The noise of the reference is left out as a whole, since those of single pixels are
    known badly."""
    scale = np.stack([relative_scale(x) for x in np.moveaxis(mean, -1, 0)], axis=-1) ** 2
    found = [np.sort(((image - mean) ** 2 * scale).ravel()) for image in images]
    kept = round((1 - TRIMMED) * mean.size)
    noise = np.sort((variance * scale).ravel())
    trimmed = np.mean([x[:kept].mean() for x in found]) - noise[:kept].mean()
    return float(trimmed), float(np.mean(found) - noise.mean())


def chosen(effects: dict[str, dict]) -> str:
    """What was kept, in a few words."""
    words = {"light_paths": "photons", "next_event": "lights", "directions": "guide"}
    return " + ".join(words.get(x, x) for x, effect in effects.items() if effect["is_kept"])


@click.command()
@click.argument("names", nargs=-1)
@click.option("--integrator", "kinds", multiple=True, default=("composed_path", "sppm", "auto"))
@click.option("--spp", default=0, help="Samples per pixel; 0 for those of the table.")
@click.option("--seeds", default=3, help="Renders of each integrator.")
@click.option("--size", type=(int, int), default=(160, 90), help="Of the film.")
@click.option("--reference-spp", default=1024, help="Samples per pixel of references.")
def main(
    names: tuple[str, ...], kinds: tuple[str, ...], spp: int, seeds: int, size: tuple[int, int],
    reference_spp: int,
) -> None:  # fmt: skip
    """Compares integrators in the scenes of these NAMES (all by default)."""
    mi.set_variant("llvm_ad_rgb")
    columns = ["scene", "integrator", "efficiency", "error", "seconds", "mean", "chosen", "photons"]
    print_header(columns)
    for name in names or (*FILES, *FOGS):
        is_file = (SCENES / f"{name}.xml").exists()
        scene = load(name, size) if is_file else mi.load_dict(FOGS[name](*size))
        mean, variance = reference(name, scene, _REFERENCE_SPP.get(name, reference_spp))
        images, seconds = collections.defaultdict(list), collections.defaultdict(list)
        choices, photons = collections.defaultdict(list), {}
        integrators = {kind: make(kind) for kind in kinds}
        for seed in range(seeds + 1):
            for kind, integrator in integrators.items():
                begin = time.process_time()
                image = image_of(scene, integrator, spp or SPP.get(name, 256), 1 + 7919 * seed)
                if seed == 0:
                    continue
                seconds[kind].append(time.process_time() - begin)
                images[kind].append(image)
                if kind == "auto":
                    choices[kind].append(chosen(integrator.statistics.effects) or "path")
                    photons[kind] = integrator.statistics.effects.get("light_paths", {})
        found = {kind: errors(images[kind], mean, variance) for kind in kinds}
        taken = {kind: float(np.median(seconds[kind])) for kind in kinds}
        for kind in kinds:
            gain, gain_of_all = (
                found[kinds[0]][k] * taken[kinds[0]] / (found[kind][k] * taken[kind])
                for k in range(2)
            )
            counts = collections.Counter(choices[kind])
            print_row([
                name, kind, f"{gain:.3g} ({gain_of_all:.3g})", f"{found[kind][0]:.3g}",
                f"{taken[kind]:.1f}", f"{np.mean(images[kind]) / mean.mean():.4f}",
                ", ".join(f"{choice} ({count})" for choice, count in counts.items()),
                ", ".join(f"{key} {x:.3g}" for key, x in photons.get(kind, {}).items()),
            ])  # fmt: skip


if __name__ == "__main__":
    main()
