"""Speed against error of our integrators and ``path``, on our scenes and on those of the papers.

``make bench`` runs all of it (about an hour on two cores); ``examples/benchmark.py open kitchen``
runs some scenes. Every table of figures in the README comes from here.
"""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from mitsuba_ext import compare

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "scenes"

INTEGRATORS = ("path", "composed_path", "neepp")

#: Our scenes, at their own size.
OURS = ("door_ajar", "rooms", "open", "cornell_box", "mirrors_and_glass", "sunny_gloss")

#: Scenes of the papers → size of their stored reference.
THEIRS = {
    "veach-ajar": (320, 180),
    "kitchen": (320, 180),
    "staircase": (180, 320),
    "bathroom": (180, 180),
}

#: Depth of the stored references, and of everything that is compared with them.
DEPTH = {"max_depth": 6}


@click.command()
@click.argument("names", nargs=-1)
@click.option("--spp", default=256, show_default=True, help="Samples per pixel of each run.")
@click.option("--seeds", default=3, show_default=True, help="Runs of each integrator.")
@click.option("--reference-spp", default=4096, show_default=True, help="Of our scenes.")
@click.option("--integrator", "integrators", multiple=True, help="Instead of the standard ones.")
@click.option("--out", type=click.Path(path_type=Path), default=ROOT / "out" / "benchmark")
def main(
    names: tuple[str, ...],
    spp: int,
    seeds: int,
    reference_spp: int,
    integrators: tuple[str, ...],
    out: Path,
) -> None:
    """Compares the integrators on the scenes NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    available = [*OURS, *(THEIRS if SHARED.is_dir() else ())]
    unknown = set(names) - set(available)
    if unknown:
        raise click.UsageError(f"no scene {', '.join(sorted(unknown))}: {', '.join(available)}")
    for name in names or available:
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        scene, reference = _load(name, folder, reference_spp)
        experiment = compare.Experiment(scene, integrators or INTEGRATORS, spp, range(seeds))
        experiment.run(reference, finished=compare.image_writer(folder, experiment))
        compare.write_results(folder / "results.json", experiment)
        Console().print(compare.table(experiment))
        print(f"{folder / 'results.json'}\n", flush=True)


def _load(
    name: str, folder: Path, reference_spp: int
) -> tuple[compare.LoadedScene, compare.Reference]:
    """The scene and what to measure it against."""
    if name in OURS:
        path = ROOT / "scenes" / f"{name}.xml"
        scene = compare.load_scene(path, parameters=DEPTH, keep_integrator=False)
        return scene, compare.render_reference(scene, reference_spp, folder)
    width, height = THEIRS[name]
    path = SHARED / name / "scene.xml"
    scene = compare.load_scene(path, THEIRS[name], DEPTH, keep_integrator=False)
    reference = SHARED / name / f"reference_path_depth6_{width}x{height}.exr"
    return scene, compare.load_reference(reference, scene.size)


if __name__ == "__main__":
    main()
