"""The image of instant radiosity, by the ways in which the light was found."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.estimator import CameraRays, Sample, Splats
from ....transport.observer import Observer
from ....transport.walk import Walk
from ....util.arrays import add_own
from ..light_image import LightImage
from ..sensor import ConnectableSensor
from .virtual_light_bound import Bound
from .virtual_lights import VirtualLights

#: The parts, in the order in which their sums are stored. They add up to the image.
PARTS = ("direct", "virtual", "compensation")

#: A picture beside the parts: the virtual lights themselves.
LIGHTS = "lights"


class LightParts(Observer):
    """Adds up the light of each camera path in three parts: what came from virtual lights, what
    camera paths found with a weight below one (the compensation of the bound), and what they found
    with full weight, since no virtual light could have.

    Parameters:
        bound: The weights.
    """

    # It has new sums in each pass
    can_be_frozen = False

    def __init__(self, bound: Bound) -> None:
        self._bound, self._lanes = bound, 0
        self._lane, self._sums = mi.UInt32(0), mi.Spectrum(0)

    def camera(self, rays):
        self._lanes = dr.width(rays.ray)
        self._lane = dr.arange(mi.UInt32, self._lanes)
        self._sums = dr.zeros(mi.Spectrum, len(PARTS) * self._lanes)

    def emission(self, path, ds, value, mis, pdf, active):
        self._add_found(path.history.share, value, active)

    def connection(self, choice, vertex, ds, contribution, value, pdf, visible, tested):
        share = self._bound.share(vertex.path.history, vertex.bsdf, pdf)
        self._add_found(share, value, visible)

    def virtual(self, value: mi.Spectrum, active: mi.Bool) -> None:
        """A vertex of the camera path in each lane gathered ``value`` from virtual lights."""
        self._add("virtual", value, active)

    def _add_found(self, share: mi.Float, value: mi.Spectrum, active: mi.Bool) -> None:
        self._add("compensation", value, active & (share < 1))
        self._add("direct", value, active & (share >= 1))

    def _add(self, part: str, value: mi.Spectrum, active: mi.Bool) -> None:
        place = PARTS.index(part) * self._lanes + self._lane
        add_own(self._sums, value, place, active)

    def values(self) -> list[mi.Spectrum]:
        """The parts of each camera path."""
        return [
            dr.gather(mi.Spectrum, self._sums, index * self._lanes + self._lane)
            for index in range(len(PARTS))
        ]


class PictureOfLights:
    """Shows where virtual lights lie: each one that the sensor sees adds the radiance that it sends
    there to its pixel, divided by the number of light paths. With many of them, it is the image of
    a light tracer.

    Parameters:
        sensor: The sensor; ``None`` if points cannot be connected to it, and the picture is black.
        pixels, width: Number of pixels of the film, and of a row.
        offset: The crop window's offset.
    """

    def __init__(
        self, sensor: ConnectableSensor | None, pixels: int, width: int, offset: mi.ScalarVector2u
    ) -> None:
        self._sensor, self._pixels, self._width = sensor, pixels, width
        self._offset = mi.Vector2f(mi.ScalarVector2f(offset))

    def values(
        self, scene: mi.Scene, lights: VirtualLights | None, walk: Walk, numbers, rays: CameraRays
    ) -> mi.Spectrum:
        """The value that each camera sample adds to the mean of its pixel."""
        total = dr.zeros(mi.Spectrum, dr.width(rays.ray))
        if self._sensor is None or lights is None:
            return total
        paths = lights.vertices.paths / self._pixels
        image = LightImage(
            scene, self._sensor, numbers, rays, query=walk.query, light_paths=paths
        )
        self._add(total, image.splats(lights.vertices), rays)
        dr.eval(total)
        return total

    def _add(self, total: mi.Spectrum, splats: Splats, rays: CameraRays) -> None:
        """Adds the splats to the first samples of their pixels, if the pass has any there."""
        place = mi.Point2u(splats.position - self._offset)
        pixel = place.y * self._width + place.x
        begin, end = (_lane_of(rays.pixel, pixel + after) for after in (0, 1))
        # The film divides the sum by the number of the pixel's samples; this factor cancels that
        value = splats.value * mi.Float(end - begin)
        dr.scatter_add(total, value, begin, splats.active & (end > begin))


def _lane_of(pixels: mi.UInt32, pixel: mi.UInt32) -> mi.UInt32:
    """The first lane whose pixel is not before ``pixel``; lanes are in the order of pixels."""
    return dr.binary_search(
        0, len(pixels), lambda lane: dr.gather(mi.UInt32, pixels, lane) < pixel
    )


class AllDirect:
    """A walk without virtual lights: all light is direct. It is an :class:`Estimator`.

    Parameters:
        walk: The walk.
    """

    def __init__(self, walk: Walk) -> None:
        self._walk = walk

    def __call__(self, scene, sampler, rays, active) -> Sample:
        sample = self._walk(scene, sampler, rays, active)
        nothing = [mi.Float(0)] * (len(PARTS) * len(mi.Spectrum()))
        sample.aovs = [*(sample.L * rays.importance), *nothing]
        return sample
