"""Camera rays for the pixels of a film, and adding their radiance to the film."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.decisions import CameraSamples
from ..transport.estimator import CameraRays, Sample, Splats
from ..transport.numbers import Numbers
from ..util.spectra import film_colours, to_rgb


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """The sensor for the argument ``sensor`` of ``render``: an index in the scene, or a sensor.

    Raises:
        ValueError: There is no sensor of this index.
    """
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise ValueError(f"there is no sensor {sensor}: the scene has {len(sensors)} sensor(s)")
    return sensors[sensor]


def film_extent(film: mi.Film) -> tuple[int, int]:
    """Width and height of the sampled pixels: the crop window, plus the filter's border if the
    film's ``sample_border`` is set."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    width, height = film.crop_size()
    return int(width) + border, int(height) + border


def first_pixel(film: mi.Film) -> tuple[int, int]:
    """The first of the sampled pixels (:func:`film_extent`)."""
    border = film.rfilter().border_size() if film.sample_border() else 0
    x, y = film.crop_offset()
    return int(x) - border, int(y) - border


def tell_film(sampler: mi.Sampler, film: mi.Film, first: int = 0) -> None:
    """Tells a sampler which pixels its lanes stand for, if it has the method ``set_film`` (as
    ``sobol_owen``): the pixels of the film row by row, from index ``first`` on."""
    if hasattr(sampler, "set_film"):
        sampler.set_film(film_extent(film)[0], first)


def forget_state(sensor: mi.Sensor) -> None:
    """Resets the state of the sensor's sampler after a render, as ``mi.render`` does. The state is
    not evaluated: a recorded kernel would evaluate it, and with it the whole render a second
    time."""
    sensor.sampler().seed(0, 1)


def own_sampler(sensor: mi.Sensor) -> mi.Sampler:
    """A copy of the sensor's sampler, or the sampler itself if it cannot be copied (samplers
    written in Python need not have ``clone``)."""
    try:
        sampler = sensor.sampler().clone()
    except RuntimeError:
        return sensor.sampler()
    forget_state(sensor)
    return sampler


@contextmanager
def film_told(sensor: mi.Sensor) -> Iterator[None]:
    """A context that calls :func:`tell_film` for the sensor's sampler. It is for Mitsuba's own
    integrators, which do not call it."""
    sampler = sensor.sampler()
    tell_film(sampler, sensor.film())
    try:
        yield
    finally:
        if hasattr(sampler, "set_film"):
            sampler.set_film(None)
        forget_state(sensor)


@dataclass
class Lanes:
    """The sample that each lane of a pass takes.

    Attributes:
        pixel: The index of the pixel, row by row in the film's extent.
        corner: Its corner on the film.
        index: The index of the sample among all samples of the render in this pixel.
    """

    pixel: mi.UInt32
    corner: mi.Vector2i
    index: mi.UInt32


def lanes_of(
    film: mi.Film, spp_per_pass: int, first: int = 0, pixels: range | None = None
) -> Lanes:
    """The lanes of a pass of ``spp_per_pass`` samples for each of the ``pixels``, row by row in the
    film's extent (all of them by default). Earlier passes took ``first`` samples of each pixel."""
    return PassLanes.of(film, spp_per_pass, first, pixels).lanes(film)


@dataclass
class PassLanes:
    """The data from which the lanes of a pass are computed. Numbers that differ from pass to pass
    are opaque arrays.

    Attributes:
        count: Samples of all pixels.
        spp: Samples of each pixel.
        first: Samples of each pixel in earlier passes.
        start: The first pixel; ``None`` if it is the first of the film.
    """

    count: int
    spp: mi.UInt32
    first: mi.UInt32
    start: mi.UInt32 | None

    @classmethod
    def of(cls, film: mi.Film, spp: int, first: int, pixels: range | None) -> PassLanes:
        """The data for :func:`lanes_of`, which has the same parameters."""
        width, height = film_extent(film)
        pixel_count = width * height if pixels is None else len(pixels)
        # Opaque, so that passes share a kernel
        numbers = (dr.opaque(mi.UInt32, n) for n in (spp, first))
        start = None if pixels is None else dr.opaque(mi.UInt32, pixels.start)
        return cls(pixel_count * spp, *numbers, start)

    def lanes(self, film: mi.Film) -> Lanes:
        """The lanes."""
        lane = dr.arange(mi.UInt32, self.count)
        pixel = lane // self.spp
        index = lane - pixel * self.spp + self.first
        if self.start is not None:
            pixel += self.start
        return lanes_at(film, pixel, index)


@dataclass
class PixelLanes:
    """As :class:`PassLanes`, for samples that belong to no pass.

    Attributes:
        pixel: The pixel of each sample.
    """

    pixel: mi.UInt32

    @property
    def count(self) -> int:
        """Number of samples."""
        return dr.width(self.pixel)

    def lanes(self, film: mi.Film) -> Lanes:
        """The lanes."""
        return lanes_at(film, self.pixel, dr.opaque(mi.UInt32, 0))


def lanes_at(film: mi.Film, pixel: mi.UInt32, index: mi.UInt32) -> Lanes:
    """Lanes for these samples of these pixels."""
    width, _height = film_extent(film)
    y = pixel // width
    corner = mi.Vector2i(mi.Int32(pixel - y * width), mi.Int32(y))
    corner += mi.Vector2i(first_pixel(film))
    return Lanes(pixel, corner, index)


@dataclass
class CameraNumbers:
    """The random numbers, in [0, 1), that make a camera ray.

    Attributes:
        film: Position of the ray in its pixel.
        aperture, time, wavelength: The numbers that choose the point of the aperture, the time in
            the shutter interval, and the wavelengths.
        weight, hero_weight, distance: See :class:`CameraRays`.
    """

    film: mi.Point2f
    aperture: mi.Point2f
    time: mi.Float
    wavelength: mi.Float
    weight: mi.Float | float = 1.0
    hero_weight: mi.Float | float = 1.0
    distance: mi.Float | None = None


def draw_numbers(
    sensor: mi.Sensor, sampler: Numbers, lanes: Lanes | None, samples: CameraSamples
) -> CameraNumbers:
    """Draws the numbers in the order in which ``mi.SamplingIntegrator`` does, so that the same seed
    gives the same rays as Mitsuba's own integrators. Numbers for which ``samples`` has a source are
    drawn from there; only these depend on the ``lanes``."""
    numbers = CameraNumbers(sampler.next_2d(), mi.Point2f(0.5), mi.Float(0), mi.Float(0))
    if sensor.needs_aperture_sample():
        if samples.aperture is None:
            numbers.aperture = sampler.next_2d()
        else:
            numbers.aperture, numbers.weight = samples.aperture.draw(
                sampler, lanes.pixel, lanes.index
            )
    if sensor.shutter_open_time() > 0:
        if samples.time is None:
            numbers.time = sampler.next_1d()
        else:
            numbers.time, weight = samples.time.draw(sampler, lanes.pixel, lanes.index)
            numbers.weight *= weight
    if mi.is_spectral:
        if samples.wavelength is None:
            numbers.wavelength = sampler.next_1d()
        else:
            numbers.wavelength, hero, all_four = samples.wavelength.draw(
                sampler, lanes.pixel, lanes.index
            )
            numbers.weight *= all_four
            numbers.hero_weight = hero / all_four
    if samples.distance is not None:
        numbers.distance, weight = samples.distance.draw(sampler, lanes.pixel, lanes.index)
        numbers.weight *= weight
    return numbers


def camera_rays(
    sensor: mi.Sensor, lanes: Lanes, numbers: CameraNumbers, spp: int
) -> CameraRays:
    """The camera rays of these numbers. ``spp``, the samples per pixel of the whole render, scales
    the ray differentials."""
    film = sensor.film()
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    position = mi.Point2f(lanes.corner) + numbers.film
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += numbers.time * sensor.shutter_open_time()
    ray, importance = sensor.sample_ray_differential(
        time, numbers.wavelength, dr.fma(position, scale, offset), numbers.aperture
    )
    if ray.has_differentials:
        ray.scale_differential(dr.opaque(mi.Float, spp**-0.5))
    # A box filter ignores the offset inside the pixel: it would only add rounding errors
    if film.rfilter().is_box_filter():
        position = mi.Point2f(lanes.corner)
    if dr.width(ray.o) == 1:
        # A "radiancemeter" has one ray; light paths need a lane for each sample
        ray.o = ray.o + dr.zeros(mi.Vector3f, dr.width(position))
    return CameraRays(
        ray, lanes.pixel, importance, position, numbers.weight, numbers.hero_weight,
        sensor.get_medium(), numbers.distance,
    )  # fmt: skip


def sample_rays(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    spp_per_pass: int,
    spp: int,
    samples: CameraSamples,
    first: int = 0,
    pixels: range | None = None,
) -> CameraRays:
    """Camera rays of one pass: ``spp_per_pass`` for each pixel.

    Parameters:
        sensor, sampler: The sampler is seeded for as many lanes as there are rays.
        spp_per_pass: Samples per pixel of this pass.
        spp: Samples per pixel of the whole render.
        samples: The sources of the numbers that choose aperture, time and wavelengths.
        first: Samples per pixel that earlier passes took.
        pixels: The pixels, row by row in the film's extent; all of them by default.
    """
    lanes = lanes_of(sensor.film(), spp_per_pass, first, pixels)
    return camera_rays(sensor, lanes, draw_numbers(sensor, sampler, lanes, samples), spp)


def put(
    film: mi.Film,
    block: mi.ImageBlock,
    rays: CameraRays,
    sample: Sample,
    aovs: list[mi.Float],
    count: mi.Float | float = 1.0,
) -> None:
    """Puts samples, without their splats, into an image block, in the channels of the film.
    ``aovs`` has one value per channel that the integrator announced to ``film.prepare``. ``count``
    is the weight of each sample: the film divides by the sum of the weights."""
    weight = rays.weight * count
    L = sample.L * rays.importance * weight
    alpha = dr.select(sample.valid, mi.Float(weight), 0)
    aovs = [value * weight for value in aovs]
    wavelengths = rays.ray.wavelengths
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        values = film.prepare_sample(
            L, wavelengths, block.channel_count(), weight=count, alpha=alpha, active=sample.valid
        )
        block.put(rays.position, values)
    else:
        block.put(
            rays.position, [*_channels(film, L, wavelengths, alpha), mi.Float(count), *aovs]
        )


def check_takes_splats(film: mi.Film) -> None:
    """Checks that splats can be added to a film.

    Raises:
        NotImplementedError: Splats cannot be added to this film.
    """
    if film.sample_border() or mi.has_flag(film.flags(), mi.FilmFlags.Special):
        remedy = (
            ' with a sampled border: set its "sample_border" to False'
            if film.sample_border()
            else ': use "hdrfilm"'
        )
        raise NotImplementedError(
            f'light that reaches other pixels cannot be added to the film "{film.class_name()}"'
            f"{remedy}"
        )


def put_splats(
    film: mi.Film, block: mi.ImageBlock, splats: Splats, count: mi.Float | float = 1.0
) -> None:
    """Puts splats into a block of their own, without filter weights (``filter_weights.py``).

    Parameters:
        count: The weight of their samples.
    """
    check_takes_splats(film)
    values = _channels(film, splats.value, splats.wavelengths, mi.Float(0))
    values.append(mi.Float(0))
    for part in splats.channels:
        values += film_colours(part, splats.wavelengths)
    values += [mi.Float(0)] * (block.channel_count() - len(values))
    block.put(splats.position, [value * count for value in values], splats.active)


def _channels(
    film: mi.Film, L: mi.Spectrum, wavelengths: mi.Spectrum | None, alpha: mi.Float
) -> list[mi.Float]:
    """The colour channels of a film, and alpha if it has that channel."""
    rgb = to_rgb(L, wavelengths)
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    return [rgb.x, rgb.y, rgb.z, *([alpha] if has_alpha else [])]


def develop(film: mi.Film, develop: bool, evaluate: bool) -> mi.TensorXf:
    """The return value of ``render(develop=…, evaluate=…)``, once the film holds the image."""
    image = film.develop() if develop else mi.TensorXf()
    if not develop:
        film.schedule_storage()
    if evaluate:
        dr.eval(image) if develop else dr.eval()
        dr.sync_thread()
    return image
