"""Caches and virtual lights beside the modern answer to the same wish: few paths, and a denoiser.

    python benchmarks/denoised.py                                  # rooms, window, cornell_box
    python benchmarks/denoised.py /work/shared/scenes/kitchen/scene.xml --seconds 1,3,10

Each integrator renders with a timeout, and once more for the denoised image, with the time of
denoising taken off. The table has FLIP, and relMSE in brackets, the means over seeds. Kernels are
compiled before. Scenes of the papers have their references beside them (``max_depth`` 6); those of
our scenes are rendered first and kept in ``out/denoised``.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import numpy as np
from equal_samples import load, title

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.compare.references import Reference, load_reference, render_reference
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.images.metrics import errors
from mitsuba_ext.inputs.scenes import load_scene
from mitsuba_ext.rendering.scene_guides import render_guides

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
INTEGRATORS = ("composed_path", "auto", "irradiance_cache", "instant_radiosity")
OURS = {"rooms": 2048, "window": 1024, "cornell_box": 4096}


def reference_of(name: str, size: tuple[int, int]) -> tuple[Reference, int]:
    """The reference of a scene, and the longest paths in it."""
    beside = Path(name).parent / "reference_path_depth6_320x180.exr"
    if name.endswith(".xml") and beside.exists():
        return load_reference(beside, size), 6
    folder = ROOT / "out" / "denoised"
    folder.mkdir(parents=True, exist_ok=True)
    file = ROOT / "scenes" / f"{name}.xml"
    scene = load_scene(file, size, {"rfilter": "box", "max_depth": 8})
    return render_reference(scene, OURS[name], folder, "auto_path"), 8


def denoised(scene: mi.Scene, image: np.ndarray) -> np.ndarray:
    guides = render_guides(scene, scene.sensors()[0])
    albedo, normal = np.split(np.stack(list(guides.values()), axis=2), 2, axis=2)
    return np.array(denoise(image, albedo, normal))


def rendered(scene: mi.Scene, name: str, max_depth: int, seconds: float, seed: int) -> np.ndarray:
    integrator = mi.load_dict({"type": name, "max_depth": max_depth, "timeout": seconds})
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=1 << 16))[..., :3]


@click.command()
@click.argument("scenes", nargs=-1)
@click.option("--seconds", default="1,3,10,30", show_default=True)
@click.option("--seeds", default=1, show_default=True)
@click.option("--references", "only_references", is_flag=True, help="Render references alone.")
def main(scenes: tuple[str, ...], seconds: str, seeds: int, only_references: bool) -> None:
    """Compares on SCENES."""
    mi.set_variant("llvm_ad_rgb")
    times = [float(s) for s in seconds.split(",")]
    for name in scenes or OURS:
        size = (216, 180) if name == "cornell_box" else (320, 180)
        reference, max_depth = reference_of(name, size)
        if only_references:
            continue
        scene = load(name, size)
        for integrator in INTEGRATORS:  # compiles
            for seed in (100, 101):
                image = rendered(scene, integrator, max_depth, 2.0, seed)
        cost = []
        for _ in range(3):
            begin = time.perf_counter()
            denoised(scene, image)
            cost.append(time.perf_counter() - begin)
        cost = min(cost)
        print(f"\n{title(name)}, {size[0]}x{size[1]}: denoising takes {cost:.2f} s\n")
        columns = [f"{i}{after}" for i in INTEGRATORS for after in ("", ", denoised")]
        print(f"| seconds | {' | '.join(columns)} |\n|{'---|' * (len(columns) + 1)}", flush=True)
        for limit in times:
            found: dict[str, list] = {column: [] for column in columns}
            for seed in range(seeds):
                for integrator in INTEGRATORS:
                    image = rendered(scene, integrator, max_depth, limit, seed)
                    found[integrator].append(_errors(image, reference))
                    if limit < 20 * cost:  # else, it makes no difference
                        image = rendered(scene, integrator, max_depth, limit - cost, seed)
                    smooth = denoised(scene, image)
                    found[f"{integrator}, denoised"].append(_errors(smooth, reference))
            cells = (
                f"{np.mean([e.flip for e in es]):.3f} ({np.mean([e.relmse for e in es]):.2g})"
                for es in found.values()
            )
            print(f"| {limit:g} | {' | '.join(cells)} |", flush=True)


def _errors(image: np.ndarray, reference: Reference):
    return errors(image, reference.mean, reference.variance)


if __name__ == "__main__":
    main()
