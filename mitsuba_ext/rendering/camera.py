"""From pixels to rays, and from radiance back to the film: the two ends of every render."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .camera_samples import CameraSamples


@dataclass
class CameraRays:
    """The rays of a pass.

    Attributes:
        ray: The rays themselves.
        importance: What the sensor makes of the radiance that they bring back.
        weight: By how much a sample counts; 1.0 where all count the same.
        hero_weight: The same where one of the four wavelengths is left, relative to ``weight``.
        position: Where on the film (in pixels) to put it.
        pixel: The number of the ray's pixel, row by row in the film's extent.
    """

    ray: mi.RayDifferential3f
    importance: mi.Spectrum
    weight: mi.Float | float
    hero_weight: mi.Float | float
    position: mi.Point2f
    pixel: mi.UInt32


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """The sensor that ``render(sensor=…)`` means.

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
    """Width and height of the sampled pixels: the crop window, plus the filter's border where the
    film wants it sampled."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    width, height = film.crop_size()
    return int(width) + border, int(height) + border


def sample_rays(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    spp_per_pass: int,
    spp: int,
    samples: CameraSamples,
    first: int = 0,
) -> CameraRays:
    """Camera rays of one pass: ``spp_per_pass`` for each pixel of the film.

    The random numbers are drawn in the order in which ``mi.SamplingIntegrator`` draws them, so that
    the same seed gives the same rays as Mitsuba's own integrators.

    Parameters:
        sensor, sampler: The sampler is seeded for ``width · height · spp_per_pass`` lanes.
        spp_per_pass: Samples per pixel of this pass.
        spp: Samples per pixel of the whole render; it scales the ray differentials.
        samples: Which numbers choose aperture, time and wavelengths.
        first: Samples per pixel that earlier passes took.
    """
    film = sensor.film()
    width, height = film_extent(film)

    # The divisor is opaque, so that passes of different length share a kernel
    lane = dr.arange(mi.UInt32, width * height * spp_per_pass)
    pixel = lane // dr.opaque(mi.UInt32, spp_per_pass)
    y = pixel // width
    corner = mi.Vector2i(mi.Int32(pixel - y * width), mi.Int32(y))
    if film.sample_border():
        corner -= film.rfilter().border_size()
    corner += mi.Vector2i(film.crop_offset())

    position = mi.Point2f(corner) + sampler.next_2d()
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    film_sample = dr.fma(position, scale, offset)

    index = lane - pixel * dr.opaque(mi.UInt32, spp_per_pass) + dr.opaque(mi.UInt32, first)
    weight, hero_weight = 1.0, 1.0
    aperture_sample = mi.Point2f(0.5)
    if sensor.needs_aperture_sample():
        if samples.aperture is None:
            aperture_sample = sampler.next_2d()
        else:
            aperture_sample, weight = samples.aperture.draw(pixel, index)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        if samples.time is None:
            time_sample = sampler.next_1d()
        else:
            time_sample, time_weight = samples.time.draw(pixel, index)
            weight *= time_weight
        time += time_sample * sensor.shutter_open_time()
    wavelength_sample = mi.Float(0)
    if mi.is_spectral:
        if samples.wavelength is None:
            wavelength_sample = sampler.next_1d()
        else:
            wavelength_sample, hero, all_four = samples.wavelength.draw(pixel, index)
            weight *= all_four
            hero_weight = hero / all_four

    ray, importance = sensor.sample_ray_differential(
        time, wavelength_sample, film_sample, aperture_sample
    )
    if ray.has_differentials:
        ray.scale_differential(dr.opaque(mi.Float, spp**-0.5))

    # A box filter ignores the offset inside the pixel: it would only add rounding errors
    if film.rfilter().is_box_filter():
        position = mi.Point2f(corner)
    return CameraRays(ray, importance, weight, hero_weight, position, pixel)


def splat(
    film: mi.Film,
    block: mi.ImageBlock,
    rays: CameraRays,
    L: mi.Spectrum,
    valid: mi.Bool,
    aovs: list[mi.Float],
) -> None:
    """Puts samples into an image block, in the channels that the film asks for.

    Parameters:
        L: Radiance that the rays bring back.
        valid: Did the ray meet something? (alpha)
        aovs: One value per channel that the integrator announced to ``film.prepare``.
    """
    L = L * rays.importance * rays.weight
    alpha = dr.select(valid, mi.Float(rays.weight), 0)
    aovs = [value * rays.weight for value in aovs]
    position, wavelengths = rays.position, rays.ray.wavelengths
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        values = film.prepare_sample(
            L, wavelengths, block.channel_count(), weight=1, alpha=alpha, active=valid
        )
        block.put(position, values)
        return
    if mi.is_spectral:
        rgb = mi.spectrum_to_srgb(L, wavelengths)
    else:
        rgb = mi.Color3f(L.x) if mi.is_monochromatic else L
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    block.put(position, [rgb.x, rgb.y, rgb.z, *([alpha] if has_alpha else []), 1.0, *aovs])


def develop(film: mi.Film, develop: bool, evaluate: bool) -> mi.TensorXf:
    """What ``render(develop=…, evaluate=…)`` returns, once the film holds the image."""
    image = film.develop() if develop else mi.TensorXf()
    if not develop:
        film.schedule_storage()
    if evaluate:
        dr.eval(image) if develop else dr.eval()
        dr.sync_thread()
    return image
