"""Compares ``path``, ``light_tracer``, ``bdpt``, and ``bdpt`` with ``light_paths = auto`` (with its
pilot) at equal samples, by variance and CPU time:

    .venv/bin/python examples/bidirectional.py caustic scenes/corridor.xml /somewhere/scene.xml

Writes one row of Markdown for each scene. The error is the variance of a pixel between seeds,
divided by mean² + 0.01 · (mean of the image)², without the largest 0.1 % of the values; the mean is
that of all images of ``bdpt``. The efficiency, 1 / (error · seconds), is relative to ``path``.
``light_tracer`` is judged by the pixels in which it can see everything: those that show no smooth
mirror, smooth glass, mask or null surface.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import numpy as np

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"
INTEGRATORS = {
    "path": {"type": "path"},
    "light_tracer": {"type": "light_tracer"},
    "bdpt": {"type": "bdpt"},
    "auto": {"type": "bdpt", "light_paths": "auto"},
}

#: Share of the largest values that the error leaves out.
TRIMMED = 0.001

COLUMNS = ["scene", "`path`: seconds", "error", "`light_tracer`: time", "error", "efficiency"]
COLUMNS += ["`bdpt`: time", "error", "efficiency", "all values", "mean"]
COLUMNS += ["`auto`: time", "error", "efficiency"]


def load(name: str, width: int, height: int) -> mi.Scene:
    """A file, or one of our scenes by its name. Scenes made elsewhere call the film's size resx and
    resy."""
    file = Path(name) if name.endswith(".xml") else SCENES / f"{name}.xml"
    if "$resx" in file.read_text():
        return mi.load_file(str(file), resx=width, resy=height)
    return mi.load_file(str(file), width=width, height=height, rfilter="box")


def seen(scene: mi.Scene) -> np.ndarray:
    """The pixels in which ``light_tracer`` can see everything, by 16 rays each: [height, width]."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, width * height * 16)
    sampler = mi.PCG32(size=width * height * 16)
    pixel, offset = index // 16, mi.Point2f(sampler.next_float32(), sampler.next_float32())
    position = mi.Point2f(pixel % width, pixel // width) + offset
    lens = mi.Point2f(sampler.next_float32(), sampler.next_float32())
    ray, _ = sensor.sample_ray(0.0, 0.5, position / mi.Point2f(width, height), lens)
    si = scene.ray_intersect(ray)
    flags = si.bsdf(mi.RayDifferential3f(ray)).flags()
    hidden = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
    black = si.is_valid() & ((flags & hidden) != 0)
    return ~np.array(black).reshape(height, width, 16).any(axis=2)


def error(variance: np.ndarray, mean: np.ndarray, trimmed: float = TRIMMED) -> float:
    """Mean relative variance of pixels, [pixel, channel] each."""
    values = np.sort((variance / (mean**2 + 0.01 * mean.mean() ** 2)).ravel())
    return float(values[: len(values) - int(np.ceil(trimmed * len(values)))].mean())


@click.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--max-depth", default=8)
@click.option("--spp", default=64)
@click.option("--seeds", default=6)
@click.option("--size", type=(int, int), default=(128, 72), help="Width and height of the film.")
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares the integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for name in names:
        scene = load(name, *size)
        integrators = {
            kind: mi.load_dict({**plugin, "max_depth": max_depth})
            for kind, plugin in INTEGRATORS.items()
        }
        images: dict[str, list] = {kind: [] for kind in INTEGRATORS}
        seconds: dict[str, list] = {kind: [] for kind in INTEGRATORS}
        for seed in range(seeds + 1):  # the first compiles the kernels
            for kind, integrator in integrators.items():
                start = time.process_time()
                image = mi.render(scene, integrator=integrator, seed=1 + 7919 * seed, spp=spp)
                image = np.array(image, dtype=np.float64)
                if seed > 0:
                    images[kind].append(image)
                    seconds[kind].append(time.process_time() - start)
        print(row(name, images, seconds, seen(scene)), flush=True)


def row(name: str, images: dict, seconds: dict, visible: np.ndarray) -> str:
    means = {kind: np.mean(images[kind], axis=0) for kind in images}
    variances = {kind: np.var(images[kind], axis=0, ddof=1) for kind in images}
    times = {kind: np.median(seconds[kind]) / np.median(seconds["path"]) for kind in images}
    mean, everywhere = means["bdpt"], np.ones_like(visible)

    def ratio(kind: str, pixels: np.ndarray, trimmed: float = TRIMMED) -> float:
        each = [error(variances[k][pixels], mean[pixels], trimmed) for k in (kind, "path")]
        return each[0] / each[1]

    path = error(variances["path"].reshape(-1, 3), mean.reshape(-1, 3))
    cells = [Path(name).parent.name if Path(name).name == "scene.xml" else Path(name).stem]
    cells += [f"{np.median(seconds['path']):.1f}", f"{path:.2g}"]
    for kind, pixels in (("light_tracer", visible), ("bdpt", everywhere), ("auto", everywhere)):
        e = ratio(kind, pixels)
        cells += [f"{times[kind]:.2f}", f"{e:.2g}", f"{1 / e / times[kind]:.2g}"]
        if kind == "bdpt":
            cells.append(f"{1 / ratio(kind, pixels, 0.0) / times[kind]:.2g}")
            cells.append(f"{means['path'].mean() / mean.mean():.3f}")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
