"""What the albedo that guides a denoiser is worth: the errors of denoised images.

    python benchmarks/denoiser_guides.py mirrors_and_glass /work/shared/scenes/kitchen/scene.xml
    python benchmarks/denoiser_guides.py rooms --integrator composed_path:clamp_indirect=10

The table has FLIP, and relMSE in brackets, the means over seeds: of the image, and of the image
denoised by Open Image Denoise with no guides, with Mitsuba's ``eval_diffuse_reflectance`` (clipped)
as the albedo, and with the albedo of ``render_guides``. The last column is the mean of the image,
divided by the mean of the reference. Scenes of the papers have their references beside them
(``max_depth`` 6); the references of our scenes are rendered by ``auto`` first and kept in
``out/denoiser_guides``. ``--picture`` writes the two albedos of the last scene, side by side.
"""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import click
import numpy as np
from equal_samples import load, title

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.compare.references import Reference, load_reference, render_reference
from mitsuba_ext.images.denoising import denoise
from mitsuba_ext.images.metrics import errors
from mitsuba_ext.inputs.scenes import load_scene
from mitsuba_ext.inputs.specifications import make_named
from mitsuba_ext.rendering import guides
from mitsuba_ext.rendering.scene_guides import render_guides

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
SPP = 2048
DEPTH = 8


def reference_of(name: str) -> tuple[Reference, tuple[int, int], int]:
    """The reference of a scene, its size, and the longest paths in it."""
    for file in Path(name).parent.glob("reference_path_depth6_*.exr"):
        return (reference := load_reference(file)), reference.size, 6
    folder, size = ROOT / "out" / "denoiser_guides", (320, 180)
    folder.mkdir(parents=True, exist_ok=True)
    file = ROOT / "scenes" / f"{name}.xml"
    scene = load_scene(file, size, {"rfilter": "box", "max_depth": DEPTH})
    return render_reference(scene, SPP, folder, "auto"), size, DEPTH


def mitsubas_albedo(
    si: mi.SurfaceInteraction3f, weight: mi.UnpolarizedSpectrum, active: mi.Bool
) -> mi.UnpolarizedSpectrum:
    """What took the place of the albedo before."""
    value = mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si, active))
    return dr.clip(value, 0, 1)


def images(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
    """The images of albedo and normal."""
    found = render_guides(scene, scene.sensors()[0])
    albedo, normal = np.split(np.stack(list(found.values()), axis=2), 2, axis=2)
    return albedo, normal


@click.command()
@click.argument("scenes", nargs=-1, required=True)
@click.option("--spp", default="16,64", show_default=True)
@click.option("--seeds", default=3, show_default=True)
@click.option("--integrator", "specification", default="path", show_default=True)
@click.option("--picture", metavar="FILE")
def main(
    scenes: tuple[str, ...], spp: str, seeds: int, specification: str, picture: str | None
) -> None:
    """Compares on SCENES."""
    mi.set_variant("llvm_ad_rgb")
    columns = ("image", "no guides", "Mitsuba's albedo", "albedo")
    print(f"| scene | spp | {' | '.join(columns)} | mean |\n|---|---|---|{'---|' * len(columns)}")
    for name in scenes:
        reference, size, max_depth = reference_of(name)
        scene = load(name, size)
        with mock.patch.object(guides, "_albedo", mitsubas_albedo):
            before = images(scene)
        ways = ((), before, images(scene))
        integrator = make_named(specification, {"max_depth": max_depth}).integrator
        for count in map(int, spp.split(",")):
            found: list[list] = [[] for _ in columns]
            means = []
            for seed in range(seeds):
                image = mi.render(scene, integrator=integrator, seed=100 + seed, spp=count)
                image = np.array(image)[..., :3]
                means.append(image.mean() / reference.mean.mean())
                made = (image, *(denoise(image, *way) for way in ways))
                for column, result in zip(found, made):
                    column.append(errors(result, reference.mean, reference.variance))
            cells = (
                f"{np.mean([e.flip for e in es]):.4f} ({np.mean([e.relmse for e in es]):.2g})"
                for es in found
            )
            row = [title(name), str(count), *cells, f"{np.mean(means):.3f}"]
            print(f"| {' | '.join(row)} |", flush=True)
    if picture:
        both = np.concatenate([before[0], np.ones_like(before[0][:, :8]), ways[2][0]], axis=1)
        mi.util.write_bitmap(picture, mi.TensorXf(both), write_async=False)


if __name__ == "__main__":
    main()
