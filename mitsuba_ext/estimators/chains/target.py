"""The target function of chains: it maps random numbers to their contribution to the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ...rendering.camera import Lanes, camera_rays, draw_numbers, film_extent
from ...transport.decisions import CameraSamples
from ...transport.estimator import CameraRays, Estimator, Sample
from ...transport.frozen import frozen
from ...transport.numbers import Numbers, copied, go_to, reached
from ...util.spectra import to_rgb


@dataclass
class Contribution:
    """The contribution of a vector of random numbers to the image at one position.

    Attributes:
        position: The position on the film.
        value: The contribution as a colour, as if the film were one pixel.
        target: The luminance of ``value`` (of the absolute values of its components, which can be
            negative in spectral variants), times the weight of the film position.
    """

    position: mi.Point2f
    value: mi.Color3f
    target: mi.Float


@dataclass
class Found:
    """All contributions of vectors of random numbers, one vector in each lane.

    Attributes:
        target: The target function: the sum of the ``target`` of all contributions of a lane, or
            its part beyond the bound if :class:`ImageTarget` has one.
        parts: The contributions, in arrays of any width.
        lanes: For each part, the lanes to which its contributions belong.
        sample: The sample of the estimator.
    """

    target: mi.Float
    parts: list[Contribution]
    lanes: list[mi.UInt32]
    sample: Sample


class PlaceWeights(Protocol):
    """Weights of film positions in the target function."""

    def at(self, position: mi.Point2f) -> mi.Float:
        """The weight of a film position, larger than zero."""


@dataclass
class ImageTarget:
    """The target function of an estimator. The first random numbers make a camera ray, anywhere on
    the film; the others make an estimate of its radiance.

    Parameters:
        scene, sensor: The rendered scene and the sensor.
        estimator: The estimator of the radiance. The sample in a lane must not depend on other
            lanes.
        spp: Samples per pixel of the whole render, for ray differentials.
        has_light_paths: Whether the estimator traces light paths, which draw separate numbers.
        weights: Weights of film positions; ``None`` if all have the same weight.
        bound: A bound on the sum of luminances; the target function is the part beyond it.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    estimator: Estimator
    spp: int
    has_light_paths: bool = False
    weights: PlaceWeights | None = None
    bound: float = 0.0

    def __call__(self, numbers: Numbers) -> tuple[Contribution, Sample]:
        """The contribution of the camera path, with the target function, and the whole sample."""
        camera, sample = self._camera(numbers, mi.Bool(True))
        camera.target = beyond_bound(camera.target, self.bound)
        return camera, sample

    def evaluate(self, numbers: Numbers, active: mi.Bool | bool = True) -> Found:
        """All contributions. Evaluates them and the state of ``numbers``."""
        camera, sample = self._found(numbers, mi.Bool(active))
        lane = dr.arange(mi.UInt32, dr.width(camera.target))
        parts, lanes = [camera], [lane]
        for splats in sample.splats:
            value = to_rgb(splats.value, splats.wavelengths)
            parts.append(self._contribution(splats.position, dr.select(splats.active, value, 0)))
            lanes.append(splats.sample)
        dr.eval(numbers, parts, lanes, sample)
        target = camera.target
        if sample.splats:
            target = mi.Float(target)
            for part, lane in zip(parts[1:], lanes[1:]):
                dr.scatter_add(target, part.target, lane)
        target = beyond_bound(target, self.bound)
        dr.eval(target)
        return Found(target, parts, lanes, sample)

    def _found(self, numbers: Numbers, active: mi.Bool) -> tuple[Contribution, Sample]:
        if not getattr(self.estimator, "can_be_frozen", False):
            return self._camera(numbers, active)
        *found, place = self._recorded(numbers, active)
        go_to(numbers, place)
        return tuple(found)

    @frozen
    def _recorded(self, numbers: Numbers, active: mi.Bool) -> tuple:
        numbers = copied(numbers)
        return *self._camera(numbers, active), reached(numbers)

    def _camera(self, numbers: Numbers, active: mi.Bool) -> tuple[Contribution, Sample]:
        rays = self._rays(numbers)
        sample = self.estimator(self.scene, numbers, rays, active)
        value = to_rgb(sample.L * rays.importance, rays.ray.wavelengths)
        return self._contribution(rays.position, dr.select(active, value, 0)), sample

    def learn(self, seed: int) -> None:
        """Does nothing: only the target function of paths learns."""

    def _contribution(self, position: mi.Point2f, value: mi.Color3f) -> Contribution:
        """A contribution. Values that are not finite become black, so no chain stays there."""
        target = mi.luminance(dr.abs(value))
        is_sound = dr.isfinite(target)
        if self.weights is not None:
            target *= self.weights.at(position)
        return Contribution(position, dr.select(is_sound, value, 0), dr.select(is_sound, target, 0))

    def _rays(self, numbers: Numbers) -> CameraRays:
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
        return camera_rays(self.sensor, lanes, drawn, self.spp)


def beyond_bound(luminance: mi.Float, bound: float) -> mi.Float:
    """The part of a luminance beyond a bound; all of it if the bound is 0."""
    if bound == 0:
        return luminance
    return dr.maximum(luminance - dr.opaque(mi.Float, bound), 0)
