"""Finds the paths behind the pixels of a render, by taking its samples again."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..images.image_files import film_channels, to_rgb
from ..rendering.camera import film_extent, find_sensor, first_pixel
from ..rendering.staged import is_staged
from ..scene.media import may_have_media
from ..scene.nesting import with_nested
from ..transport.heroes import disperses
from .bright_pixels import BrightPixelsJob
from .passes_of_mitsuba import InOnePass, InPasses
from .path_log import KINDS
from .paths import FoundLight, PixelPaths, SamplePath, brightest_first, luminance
from .reading import PathReader
from .replay_job import PixelRecord, Recorded, ReplayJob

#: The number of rows of each kind in a log at first. A replay that needs more starts again.
_CAPACITY = 1 << 16

#: The least share of a sample that is reported as light of unknown origin: sums of the log and of
#: the walk differ by rounding.
_LEAST_REST = 1e-3

#: Integrators of Mitsuba whose samples ``composed_path`` takes with the same numbers.
_PATHS = ("PathIntegrator", "VolumetricPathIntegrator")

#: Integrators that only add channels to the image of the integrator that is nested in them.
_AROUND = ("AOVIntegrator", "MomentIntegrator")


def paths_of_pixels(
    scene: mi.Scene,
    pixels: Sequence[tuple[int, int]],
    integrator: mi.Integrator | None = None,
    sensor: int | mi.Sensor = 0,
    seed: int = 0,
    spp: int = 0,
    top: int = 3,
    in_passes: bool = False,
) -> list[PixelPaths]:
    """The brightest samples of some pixels, with all vertices of their paths. They are the samples
    that ``mi.render`` takes with the same arguments, drawn with the same random numbers. The film
    of the sensor is empty afterwards.

    Parameters:
        scene: The scene.
        pixels: Column and row of each pixel in the image (of the crop window, if there is one),
            counted from 0 in the upper left corner. At most 64.
        integrator: The integrator; the scene's own by default. Any of ours that has samples, and
            Mitsuba's ``path`` and ``volpath`` (without media), whose samples ``composed_path``
            takes.
        sensor, seed, spp: As for ``mi.render``.
        top: The number of samples that are returned of each pixel.
        in_passes: Whether Mitsuba's integrators render in the passes of ``mitsuba-ext render``, and
            not in the single one of ``mi.render``.

    Raises:
        ValueError: A pixel is not in the image, or an argument is out of range.
        NotImplementedError: The integrator has no samples that could be taken again.
    """
    sensor = find_sensor(scene, sensor)
    if not 1 <= len(pixels) <= 64:
        raise ValueError(f"1 to 64 pixels can be replayed, found {len(pixels)}")
    if top < 1:
        raise ValueError(f"top is {top}; it must be 1 or more")
    indices = [_index(sensor.film(), pixel) for pixel in pixels]
    render = _Render(scene, integrator, sensor, seed, spp, in_passes)
    capacities = [_CAPACITY] * len(KINDS)
    while (job := render.run(ReplayJob, indices, top, capacities)).needed != capacities:
        capacities = job.needed
    reader = PathReader(scene)
    return [_paths(record, pixel, reader) for record, pixel in zip(job.records, pixels)]


def bright_pixels(
    scene: mi.Scene,
    count: int,
    integrator: mi.Integrator | None = None,
    sensor: int | mi.Sensor = 0,
    seed: int = 0,
    spp: int = 0,
    in_passes: bool = False,
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """The pixels that a single sample brightens most: by the difference between the mean of all
    samples of a pixel and the mean without the brightest one. Renders the image. The parameters,
    and what is raised, are as for :func:`paths_of_pixels`.

    Returns:
        Up to ``count`` pixels, the pixel with the largest difference first, and the image as linear
        RGB [height, width, 3]. Pixels whose samples are all equally bright are left out.
    """
    sensor = find_sensor(scene, sensor)
    job = _Render(scene, integrator, sensor, seed, spp, in_passes).run(BrightPixelsJob)
    film = sensor.film()
    return job.brightest(count), to_rgb(film.develop(), film_channels(film))


class _Render:
    """A render that is to be taken again. For its parameters, see :func:`paths_of_pixels`."""

    def __init__(
        self, scene: mi.Scene, integrator: mi.Integrator | None, sensor: mi.Sensor, seed: int,
        spp: int, in_passes: bool,
    ) -> None:  # fmt: skip
        chosen = scene.integrator() if integrator is None else integrator
        if chosen is None:
            raise ValueError("the scene has no integrator: give one")
        self._integrator, self._is_of_mitsuba = replayable(chosen)
        if self._is_of_mitsuba:
            for is_in_scene, what in (
                (may_have_media(scene), "participating media"),
                (mi.is_spectral and disperses(scene.shapes()), "dispersion"),
            ):
                if is_in_scene:
                    raise NotImplementedError(
                        f'"{chosen.class_name()}" cannot be replayed in a scene with {what}, where '
                        f'"composed_path" takes other samples: render and replay "composed_path"'
                    )
        self._in_passes = in_passes
        self._scene, self._sensor, self._seed, self._spp = scene, sensor, seed, spp

    def run(self, job: type, *arguments: Any) -> Any:
        """Renders with a job of this class, whose further arguments these are, and returns it."""
        made = []
        if self._is_of_mitsuba:
            layout = InPasses if self._in_passes else InOnePass
            job = type(job.__name__, (layout, job), {})

        def make(integrator, request):
            made.append(job(integrator, request, *arguments))
            return made[-1]

        self._integrator.render(
            self._scene, self._sensor, self._seed, self._spp, develop=False, job=make
        )
        return made[-1]


def replayable(integrator: mi.Integrator) -> tuple[mi.Integrator, bool]:
    """The integrator that takes the samples of ``integrator`` again, and whether that is one of
    Mitsuba's.

    Raises:
        NotImplementedError: There is none.
        ValueError: The number of samples depends on the time that a render takes, or it is saved.
    """
    kind = integrator.class_name()
    nested = [each for each in with_nested(integrator) if each is not integrator]
    if kind in _AROUND and len(nested) == 1:
        if kind == _AROUND[0] or nested[0].class_name() in _PATHS:
            return replayable(nested[0])
    if kind in _PATHS:
        return _composed(integrator), True
    name = getattr(integrator, "name", kind)
    if not is_staged(integrator):
        raise NotImplementedError(
            f'"{name}" cannot be replayed: only "path", "volpath" and integrators of mitsuba_ext '
            f'can, which must not be nested in another one (except in "aov")'
        )
    if reason := getattr(integrator, "missing_in_samples", ""):
        raise NotImplementedError(
            f'"{name}" cannot be replayed: its image is not the mean of camera samples ({reason})'
        )
    for key, is_set in (("timeout", integrator.timeout > 0), ("checkpoint", integrator.checkpoint)):
        if is_set:
            raise ValueError(
                f'"{name}": a render with "{key}" cannot be replayed: leave it out, and give the '
                f"number of samples"
            )
    return integrator, False


def _composed(path: mi.Integrator) -> mi.Integrator:
    """``composed_path`` with the parameters of ``path`` or ``volpath``."""
    found = dict(re.findall(r"(\w+) = (\d+)", str(path)))
    depth = int(found["max_depth"])
    return mi.load_dict({
        "type": "composed_path", "max_depth": -1 if depth == 0xFFFFFFFF else depth,
        "rr_depth": int(found["rr_depth"]), "hide_emitters": path.hide_emitters,
    })  # fmt: skip


def _index(film: mi.Film, pixel: tuple[int, int]) -> int:
    """The index of a pixel of the image, row by row in the film's extent.

    Raises:
        ValueError: The image has no such pixel.
    """
    (x, y), (width, height) = pixel, film.crop_size()
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(
            f"the pixel {x},{y} is not in the image, which has {width}x{height} pixels: columns 0 "
            f"to {width - 1}, rows 0 to {height - 1}"
        )
    first, offset = first_pixel(film), film.crop_offset()
    return (y + int(offset[1]) - first[1]) * film_extent(film)[0] + x + int(offset[0]) - first[0]


def _paths(record: PixelRecord, pixel: tuple[int, int], reader: PathReader) -> PixelPaths:
    number = sum(map(len, record.contributions))
    by_weight = 1 / record.weights if record.weights else 0.0
    by_number = 1 / number if number else 0.0
    contributions = np.concatenate([
        *(values * by_weight for values in record.contributions),
        *(values * by_number for values in record.splats), np.zeros((0, 3)),
    ])  # fmt: skip
    value = contributions.sum(axis=0)
    order = brightest_first(contributions)
    whole = float(luminance(value))
    paths = []
    for one in record.brightest:
        factor = by_number if one.sample is None else by_weight
        paths.append(_path(one, factor, whole, reader))
    return PixelPaths(
        (int(pixel[0]), int(pixel[1])), tuple(map(float, value)), number, contributions[order],
        tuple(paths),
    )  # fmt: skip


def _path(one: Recorded, factor: float, whole: float, reader: PathReader) -> SamplePath:
    radiance = one.rgb / one.weight if one.weight else one.rgb
    contribution = one.rgb * factor
    vertices, lights = ((), ()) if one.rows is None else reader.path(one.rows)
    known = [light.radiance for vertex in vertices for light in vertex.lights]
    known += [light.radiance for light in lights]
    rest = radiance - np.sum(known, axis=0) if known else radiance
    if one.sample is None:
        lights = (FoundLight("light image", tuple(map(float, radiance))),)
    elif abs(luminance(rest)) > _LEAST_REST * abs(luminance(radiance)):
        lights += (FoundLight("other", tuple(map(float, rest))),)
    return SamplePath(
        one.sample, one.stage, tuple(map(float, radiance)), tuple(map(float, contribution)),
        float(luminance(contribution)) / whole if whole else 0.0,
        tuple(map(float, one.wavelengths)), vertices, lights,
    )  # fmt: skip
