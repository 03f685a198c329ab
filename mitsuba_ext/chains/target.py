"""The function that chains sample: from random numbers to what they add to the image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..rendering.camera import Lanes, camera_rays, draw_numbers, film_extent, to_rgb
from ..rendering.camera_samples import CameraSamples
from ..transport.estimator import Estimator, Sample
from ..transport.numbers import Numbers


@dataclass
class Contribution:
    """What a vector of numbers adds to the image.

    Attributes:
        position: Where on the film.
        value: The colour, if the film were one pixel.
        target: What chains sample in proportion to: the luminance of ``value``. Negative
            components, which spectral variants have, count by their absolute value.
    """

    position: mi.Point2f
    value: mi.Color3f
    target: mi.Float


@dataclass
class ImageTarget:
    """Makes a camera ray of the first numbers, anywhere on the film, and an estimate of its
    radiance of the others.

    Parameters:
        scene, sensor: What is rendered.
        estimator: Of the radiance. It must not need pixels of its own for each lane.
        spp: Samples per pixel of the whole render, for ray differentials.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    estimator: Estimator
    spp: int

    def __call__(self, numbers: Numbers) -> tuple[Contribution, Sample]:
        film = self.sensor.film()
        width, height = film_extent(film)
        drawn = draw_numbers(self.sensor, numbers, None, CameraSamples())
        place = drawn.film * mi.ScalarPoint2f(width, height)
        corner = mi.Point2i(
            dr.minimum(mi.Int32(place.x), width - 1), dr.minimum(mi.Int32(place.y), height - 1)
        )
        drawn.film = place - mi.Point2f(corner)
        pixel = mi.UInt32(corner.y * width + corner.x)
        lanes = Lanes(pixel, corner + mi.Point2i(film.crop_offset()), mi.UInt32(0))
        rays = camera_rays(self.sensor, lanes, drawn, self.spp)
        sample = self.estimator(self.scene, numbers, rays, mi.Bool(True))
        value = to_rgb(sample.L * rays.importance, rays.ray.wavelengths)
        target = mi.luminance(dr.abs(value))
        # A path that cannot be evaluated is no place to stay
        is_sound = dr.isfinite(target)
        return Contribution(
            rays.position, dr.select(is_sound, value, 0), dr.select(is_sound, target, 0)
        ), sample
