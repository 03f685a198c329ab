"""Variance and CPU time of a sample with ``manifold`` and ``bounded_manifold`` (the slot
``caustics``), beside ``path`` and ``vcm``.

    python benchmarks/caustics.py

Writes a row of Markdown for each scene. The integrators render in turns; the efficiency is 1 /
(variance · CPU time), relative to ``path``. The variance is relative to the squared brightness of
the pixels around; in brackets: without the 0.1 % of pixels that vary most. To measure an earlier
version, run this file with the Python of its environment.
"""

from __future__ import annotations

import re
import tempfile
import time
from pathlib import Path

import click
import mitsuba as mi
import numpy as np
from equal_samples import print_header, print_row

from mitsuba_ext.planning.pixel_estimates import relative_scale

SCENES = ("pool", "glass_lamp", "caustic", "ring", "water_glass")

#: The integrators, and the share of the samples that each one takes.
CONTENDERS = {
    "path": ({"type": "path"}, 1.0),
    "manifold": ({"type": "composed_path", "caustics": "manifold"}, 1.0),
    "bounded": ({"type": "composed_path", "caustics": "bounded_manifold"}, 1.0),
    "vcm": ({"type": "vcm"}, 0.25),
    "auto_path": ({"type": "auto_path"}, 1.0),
    "automatic": ({"type": "auto_path", "caustics": "automatic"}, 1.0),
}


def loaded(file: Path, roughness: float) -> mi.Scene:
    """The scene; with this roughness of all its smooth glass and metal, if it is not 0."""
    size = {"width": 192, "height": 108}
    if roughness == 0:
        return mi.load_file(str(file), **size)

    def rough(tag: re.Match) -> str:
        alpha = f'<float name="alpha" value="{roughness}"/>'
        end = "</bsdf>" if tag[3] else ""
        return f'type="rough{tag[1]}"{tag[2]}>{alpha}{end}'

    text = re.sub(r'type="(dielectric|conductor)"([^>/]*)(/?)>', rough, file.read_text())
    # In the same folder, where the scene finds its meshes and textures
    with tempfile.NamedTemporaryFile("w", suffix=".xml", dir=file.parent) as changed:
        changed.write(text)
        changed.flush()
        return mi.load_file(changed.name, **size)


def relative(variance: np.ndarray, mean: np.ndarray) -> tuple[float, float]:
    """The mean relative variance of the pixels; the same without the 0.1 % that vary most. The mean
    is taken over 9x9 pixels: a spike would hide in the mean of its own pixel."""
    ratio = np.sort((variance * relative_scale(mean) ** 2).ravel())
    return float(ratio.mean()), float(ratio[: -(len(ratio) // 1000 + 1)].mean())


def measured(
    scene: mi.Scene, spp: int, seeds: int, names: list[str]
) -> dict[str, tuple[float, float, float]]:
    """Variance of a sample (all pixels; the others) and CPU time of a sample, by integrator."""
    chosen = {name: CONTENDERS[name] for name in names}
    made = {name: mi.load_dict({**plugin, "max_depth": 8}) for name, (plugin, _) in chosen.items()}
    images: dict[str, list[np.ndarray]] = {name: [] for name in made}
    seconds: dict[str, list[float]] = {name: [] for name in made}
    for seed in range(seeds + 1):  # the first renders compile
        for name, integrator in made.items():
            samples = round(spp * chosen[name][1])
            start = time.process_time()
            image = np.array(mi.render(scene, integrator=integrator, spp=samples, seed=seed))
            seconds[name].append((time.process_time() - start) / samples)
            images[name].append(image.mean(-1))
    mean = np.mean(images[names[1]][1:], 0)
    result = {}
    for name in made:
        samples = round(spp * chosen[name][1])
        variance = np.var(images[name][1:], axis=0, ddof=1) * samples
        result[name] = (*relative(variance, mean), float(np.median(seconds[name][1:])))
    return result


@click.command()
@click.argument("scenes", nargs=-1)
@click.option("--spp", default=64, help="Samples per pixel of a render.")
@click.option("--seeds", default=4, help="Renders of each integrator.")
@click.option("--integrators", default="path,manifold,bounded,vcm", help="The first: the unit.")
@click.option("--roughness", default=0.0, help="Of all smooth glass and metal.")
@click.option("--variant", default="llvm_ad_rgb")
def main(
    scenes: tuple[str, ...], spp: int, seeds: int, integrators: str, roughness: float, variant: str
) -> None:
    """Compares ``caustics=manifold`` with ``path`` and ``vcm``."""
    mi.set_variant(variant)
    folder = Path(__file__).parents[1] / "scenes"
    names = integrators.split(",")
    titles = [f"{what}, {name}" for name in names for what in ("variance", "time")]
    print_header(["scene", *titles, *(f"efficiency of {name}" for name in names[1:])])
    for scene in scenes or SCENES:
        found = measured(loaded(folder / f"{scene}.xml", roughness), spp, seeds, names)
        whole, trimmed, seconds = found[names[0]]
        cells = []
        for name in names:
            cells += [f"{found[name][0]:.3g} ({found[name][1]:.3g})",
                      f"{found[name][2] / seconds:.2f}"]  # fmt: skip
        for name in names[1:]:
            a, b, t = found[name]
            cells.append(f"{whole * seconds / (a * t):.3g} ({trimmed * seconds / (b * t):.3g})")
        print_row([scene, *cells])


if __name__ == "__main__":
    main()
