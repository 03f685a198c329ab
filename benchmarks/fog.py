"""Does ``auto`` choose well between light paths, photons and camera paths in fog?

    python benchmarks/fog.py                                # all scenes
    python benchmarks/fog.py fog sun --seeds 3 --integrator sppm --integrator auto

Compares integrators at equal samples, as ``mitsuba-ext compare --cpu``, and writes a row of
Markdown for each: efficiency in units of the first one without the largest 0.1 % of the squared
errors (in brackets with them), relMSE and CPU time of a render, the mean of the image in units of
the first one's, and what it learned. Runs and references are kept in ``out/fog``.
"""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

import click
from equal_samples import SCENES, print_header, print_row
from fog_scenes import FOGS

from mitsuba_ext import compare

import mitsuba as mi  # isort: skip

FOLDER = Path(__file__).parents[1] / "out" / "fog"

#: Our scenes, and samples per pixel of a render of each scene.
FILES = ("fog", "volume_caustic")
SPP = {"fog": 160, "bulb": 146, "dark_room": 146}

#: Samples per pixel of references, and the scenes in which photons render them.
_REFERENCE_SPP = {"bulb": 256, "volume_caustic": 512}
_BY_PHOTONS = ("fog", "volume_caustic", "bulb")


def cells(integrator: dict[str, Any]) -> list[str]:
    """Of the row of an integrator."""
    level = integrator["levels"][-1]
    figures, ratios = level["figures"], level["ratios"]
    gain, of_all, mean, error = (
        f"{found['value']:.3g}" if found else "–"
        for found in (ratios["efficiency_trimmed"], ratios["efficiency"], ratios["mean"],
                      figures["relmse"])
    )  # fmt: skip
    learned = collections.Counter(run["learned"] for run in integrator["runs"])
    return [
        f"{gain} ({of_all})", error, f"{figures['seconds']['value']:.1f}", mean,
        ", ".join(f"{what} ({count})" for what, count in learned.items() if what),
    ]  # fmt: skip


@click.command()
@click.argument("names", nargs=-1)
@click.option("--integrator", "kinds", multiple=True, default=("composed_path", "sppm", "auto"))
@click.option("--spp", default=0, help="Samples per pixel; 0 for those of the table.")
@click.option("--seeds", default=3, help="Renders of each integrator.")
@click.option("--size", type=(int, int), default=(160, 90), help="Of the film.")
@click.option("--reference-spp", default=1024, help="Samples per pixel of references.")
@click.option("--reference", default="", help="Their integrator; none for variances.")
def main(
    names: tuple[str, ...], kinds: tuple[str, ...], spp: int, seeds: int, size: tuple[int, int],
    reference_spp: int, reference: str,
) -> None:  # fmt: skip
    """Compares integrators in the scenes of these NAMES (all by default)."""
    mi.set_variant("llvm_ad_rgb")
    print_header(["scene", "integrator", "efficiency", "relMSE", "seconds", "mean", "learned"])
    for name in names or (*FILES, *FOGS):
        source = FOGS[name](*size) if name in FOGS else SCENES / f"{name}.xml"
        rendered = {"with_reference": False} if reference == "none" else {
            "reference_spp": (
                reference_spp if reference else _REFERENCE_SPP.get(name, reference_spp)
            ),
            "reference_integrator": reference or (
                "sppm" if name in _BY_PHOTONS else "composed_path"
            ),
        }  # fmt: skip
        comparison = compare.Comparison(
            compare.SceneSetup(source, size, changes=compare.SceneChanges(None, "box", 8)),
            kinds, compare.equal_samples(spp or SPP.get(name, 256)), seeds, FOLDER / name,
            cpu_time=True, **rendered,
        )  # fmt: skip
        for integrator in comparison.run()["scenes"][0]["integrators"]:
            print_row([name, integrator["label"], *cells(integrator)])


if __name__ == "__main__":
    main()
