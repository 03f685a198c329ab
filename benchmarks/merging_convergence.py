"""How ``vcm`` and ``sppm`` converge, what the radius costs, and what they need:

    .venv/bin/python benchmarks/merging_convergence.py passes pool
    .venv/bin/python benchmarks/merging_convergence.py radii
    .venv/bin/python benchmarks/merging_convergence.py memory pool
    .venv/bin/python benchmarks/merging_convergence.py scales pool

Each writes a table in Markdown.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from typing import Any

import click
import numpy as np
from equal_samples import load, print_header, print_row, title

import mitsuba_ext  # noqa: F401
from mitsuba_ext.planning.pixel_estimates import relative_scale

import mitsuba as mi  # isort: skip

KINDS = ("sppm", "vcm")
SIZE = (160, 90)


@click.group()
def main() -> None:
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)


def image(scene: mi.Scene, kind: str, spp: int, seed: int, depth: int, **more: Any) -> np.ndarray:
    integrator = mi.load_dict({"type": kind, "max_depth": depth, **more})
    rendered = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    return np.array(rendered)[..., :3].astype(float)


@main.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--passes", "counts", multiple=True, type=int, default=(1, 4, 16, 64, 256))
@click.option("--seeds", default=4, show_default=True)
@click.option("--reference", default=3072, show_default=True, help="Samples of each of two renders")
@click.option("--max-depth", default=8, show_default=True)
def passes(names, counts, seeds, reference, max_depth) -> None:
    """Variance and squared bias after some passes of one sample per pixel, relative as in
    equal_samples.py, and how fast they fall from count to count: the power of the number of passes.
    The reference is ``vcm`` with a radius of four pixels at first."""
    from mitsuba_ext.estimators.light_paths.merging.merging import median_footprint
    from mitsuba_ext.transport.scene_query import SceneQuery

    print_header(["scene", "", "passes", "variance", "power", "bias²", "power", "mean"])
    for name in names:
        scene = load(name, SIZE)
        radius = 4 * median_footprint(scene, scene.sensors()[0], SceneQuery())
        long = [image(scene, "vcm", reference, 5000 + k, max_depth, radius=radius) for k in (0, 1)]
        true = np.mean(long, axis=0)
        noise = np.var(long, axis=0, ddof=1) / 2
        scale = np.stack([relative_scale(x) for x in np.moveaxis(true, -1, 0)], axis=-1) ** 2
        for kind in KINDS:
            before = None
            for count in counts:
                images = np.stack([
                    image(scene, kind, count, k, max_depth, samples_per_pass=1)
                    for k in range(seeds)
                ])  # fmt: skip
                variance = images.var(axis=0, ddof=1)
                squared = (images.mean(axis=0) - true) ** 2 - variance / seeds - noise
                now = np.array([count, (variance * scale).mean(), (squared * scale).mean()])
                powers = ["", ""]
                if before is not None and (now > 0).all():
                    rates = np.log(now[1:] / before[1:]) / np.log(now[0] / before[0])
                    powers = [f"{rate:.2f}" for rate in rates]
                before = now
                print_row([
                    title(name), kind, str(count), f"{now[1]:.2g}", powers[0], f"{now[2]:.2g}",
                    powers[1], f"{images.mean() / true.mean():.4f}",
                ])  # fmt: skip


@main.command()
@click.option("--seeds", default=64, show_default=True)
def radii(seeds) -> None:
    """The bias of one pass of ``sppm`` on a floor under a spot light at height 1, right below it.
    The irradiance at distance d from there is in proportion to (1 + d²)^(-3/2); the mean over a
    disk of radius r is lower by 3/4 r², for small r."""
    print_header(["radius", "bias", "of a disk", "bias / radius²"])
    scene = mi.load_dict(floor_under_spot())
    for radius in (0.8, 0.4, 0.2, 0.1):
        # Each of the samples looks at all vertices of the disk
        spp = round(2048 / radius)
        more = {"radius": radius * spp**0.5, "radius_decay": 1.0}
        images = [image(scene, "sppm", spp, seed, 2, **more) for seed in range(seeds)]
        found = np.array(images).mean(axis=(1, 2, 3)) * 2 * np.pi - 1
        bias = 2 * (1 - (1 + radius**2) ** -0.5) / radius**2 - 1
        print_row([
            f"{radius:g}", f"{found.mean():.4f} ± {found.std(ddof=1) / seeds**0.5:.1g}",
            f"{bias:.4f}", f"{found.mean() / radius**2:.2f}",
        ])  # fmt: skip


def floor_under_spot() -> dict[str, Any]:
    """A floor of albedo 0.5 at z = 0, and a light of intensity 1 at z = 1. The only pixel sees a
    small part of the floor below it."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": T().scale(4), "bsdf": {"type": "diffuse"}},
        "light": {
            "type": "spot", "cutoff_angle": 40.0, "beam_width": 39.9, "intensity": 1.0,
            "to_world": T().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]),
        },
        "sensor": {
            "type": "perspective", "fov": 0.5,
            "to_world": T().look_at([0, -2, 0.8], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}},
        },
    }  # fmt: skip


@main.command()
@click.argument("name")
@click.option("--size", type=(int, int), default=(1920, 1080), show_default=True)
@click.option("--integrator", "kinds", multiple=True,
              default=("path", "bdpt", "vcm", "sppm", "photon_map"))  # fmt: skip
@click.option("--inside", is_flag=True, hidden=True)
def memory(name, size, kinds, inside) -> None:
    """The peak memory of a process that renders two samples per pixel."""
    if inside:
        image(load(name, size), kinds[0], 2, 1, 8)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
        return
    print_header(["", "GiB"])
    for kind in kinds:
        command = [sys.executable, __file__, "memory", name, "--size", *map(str, size)]
        command += ["--integrator", kind, "--inside"]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        print_row([kind, f"{float(printed.split()[-1]):.2f}"])


@main.command()
@click.argument("name")
@click.option("--spp", default=128, show_default=True)
@click.option("--max-depth", default=8, show_default=True)
def scales(name, spp, max_depth) -> None:
    """The mean of the image of a scene that is made smaller or larger."""
    print_header(["", "scale", "mean"])
    for kind in KINDS:
        for scale in (1e-3, 1.0, 1e4):
            scene = load(name, SIZE)
            enlarge(scene, scale)
            means = [image(scene, kind, spp, seed, max_depth).mean() for seed in range(4)]
            spread = np.std(means, ddof=1) / 2
            print_row([kind, f"{scale:g}", f"{np.mean(means):.4f} ± {spread:.1g}"])


def enlarge(scene: mi.Scene, scale: float) -> None:
    """Scales the shapes and the camera of a scene."""
    parameters = mi.traverse(scene)
    camera = next(k for k in parameters.keys() if k.endswith(".near_clip")).split(".")[0]
    for key in list(parameters.keys()):
        owner, _, name = key.rpartition(".")
        if name == "vertex_positions" or (owner == camera and name in ("near_clip", "far_clip")):
            parameters[key] = parameters[key] * scale
        elif name == "to_world" and owner == camera:
            offset = (scale - 1) * parameters[key].translation()
            parameters[key] = mi.Transform4f().translate(offset) @ parameters[key]
        elif name == "to_world":
            parameters[key] = mi.Transform4f().scale(scale) @ parameters[key]
    parameters.update()


if __name__ == "__main__":
    main()
