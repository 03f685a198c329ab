"""Renders that take turns, and errors that are the variance between seeds, for benchmarks that
compare more than integrators in one scene (``mitsuba-ext compare --no-reference`` does this)."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np

from mitsuba_ext.planning.pixel_estimates import relative_scale

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"

#: Share of the largest values that :func:`error` leaves out.
TRIMMED = 0.001


def options(command: Callable) -> Callable:
    """The arguments of a comparison: ``names``, ``max_depth``, ``spp``, ``seeds``, ``size``."""
    for option in (
        click.option("--size", type=(int, int), default=(128, 72), help="Of the film."),
        click.option("--seeds", default=6, help="Renders of each integrator."),
        click.option("--spp", default=64, help="Samples per pixel."),
        click.option("--max-depth", default=8),
        click.argument("names", nargs=-1, required=True),
    ):
        command = option(command)
    return command


def load(
    name: str, size: tuple[int, int], sampler: str = "", optimize: bool = True
) -> mi.Scene:
    """A file, or one of our scenes by its name, also with parameters ("pool:lamp=0.1"), with
    another sampler than its own if that is given: "sobol_owen", or with parameters
    "sobol_owen:dimensions=2:blue_noise=true". Scenes made elsewhere call the film's size resx and
    resy."""
    name, *given = name.split(":")
    file = Path(name) if name.endswith(".xml") else SCENES / f"{name}.xml"
    text, (width, height) = file.read_text(), size
    parameters = {"width": width, "height": height, "rfilter": "box"}
    if "$resx" in text:
        parameters = {"resx": width, "resy": height}
    elif "$rfilter" not in text:
        del parameters["rfilter"]
    parameters |= dict(parameter.split("=") for parameter in given)
    if not sampler:
        return mi.load_file(str(file), optimize=optimize, **parameters)
    mi.file_resolver().prepend(str(file.parent))
    kind, *parameters_of_sampler = sampler.split(":")
    children = ""
    for parameter in parameters_of_sampler:
        key, value = parameter.split("=")
        tag = "boolean" if value in ("true", "false") else "integer"
        children += f'<{tag} name="{key}" value="{value}"/>'
    text = re.sub(r'<sampler type="\w+"\s*>', f'<sampler type="{kind}">{children}', text)
    return mi.load_string(text, **{k: str(v) for k, v in parameters.items()})


def title(name: str) -> str:
    """What a table calls a scene."""
    file, *given = name.split(":")
    path = Path(file)
    found = path.parent.name if path.name == "scene.xml" else path.stem
    return " ".join([found, *given])


@dataclass
class Renders:
    """Renders of one job.

    Attributes:
        images: [seed, height, width, channel].
        seconds: CPU time of each.
        learned: What the integrator said each time that it learned (Mitsuba's: nothing).
    """

    images: list[np.ndarray] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    learned: list[str] = field(default_factory=list)

    @property
    def mean(self) -> np.ndarray:
        return np.mean(self.images, axis=0)

    @property
    def variance(self) -> np.ndarray:
        return np.var(self.images, axis=0, ddof=1)

    @property
    def time(self) -> float:
        """Median of the CPU times."""
        return float(np.median(self.seconds))


def render_in_turns(
    jobs: dict[str, tuple[mi.Scene, dict | mi.Integrator, int]], seeds: int
) -> dict[str, Renders]:
    """Renders each job (scene, integrator, samples per pixel) with ``seeds`` seeds. The first
    render of each compiles the kernels, and does not count."""
    made = {
        job: (scene, mi.load_dict(integrator) if isinstance(integrator, dict) else integrator, spp)
        for job, (scene, integrator, spp) in jobs.items()
    }
    renders = {job: Renders() for job in jobs}
    for seed in range(seeds + 1):
        for job, (scene, integrator, spp) in made.items():
            start = time.process_time()
            image = mi.render(scene, integrator=integrator, seed=1 + 7919 * seed, spp=spp)
            image = np.array(image, dtype=np.float64)[..., :3]
            seconds = time.process_time() - start
            if seed > 0:
                renders[job].images.append(image)
                renders[job].seconds.append(seconds)
                statistics = getattr(integrator, "statistics", None)
                renders[job].learned.append(statistics.learned if statistics else "")
    return renders


def camera_rays(scene: mi.Scene, count: int) -> mi.RayDifferential3f:
    """Random rays of the camera, ``count`` of each pixel: [height, width, count]."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    lane = dr.arange(mi.UInt32, width * height * count)
    numbers, pixel = mi.PCG32(size=dr.width(lane)), lane // count
    u = [numbers.next_float32() for _ in range(4)]
    position = mi.Point2f(pixel % width + u[0], pixel // width + u[1]) / mi.Point2f(width, height)
    return sensor.sample_ray_differential(0.0, 0.5, position, mi.Point2f(u[2], u[3]))[0]


def error(
    variance: np.ndarray,
    image: np.ndarray,
    pixels: np.ndarray | slice = slice(None),
) -> float:
    """The variance of a pixel, divided by mean² + 0.01 · (mean of the image)², without the largest
    0.1 % of the values, on average over pixels and channels.

    The mean is that of ``image`` over 9x9 pixels: a spike would hide in the mean of its own pixel,
    and the integrator whose images make the mean would have less error than the others.

    Parameters:
        variance, image: [height, width, channel].
        pixels: Which of them count: [height, width].
    """
    scale = np.stack([relative_scale(x) for x in np.moveaxis(image, -1, 0)], axis=-1)
    values = np.sort((variance * scale**2)[pixels].ravel())
    return float(values[: len(values) - int(np.ceil(TRIMMED * len(values)))].mean())


def print_header(columns: Sequence[str]) -> None:
    print_row(columns)
    print("|" + "---|" * len(columns))


def print_row(cells: Sequence[str]) -> None:
    """Of a table in Markdown."""
    print(f"| {' | '.join(cells)} |", flush=True)
