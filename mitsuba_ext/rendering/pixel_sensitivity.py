"""Where in an image the samples are that carry derivatives."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..images.box_filter import box_means
from ..transport.frozen import frozen, with_recordings
from ..transport.walk import Walk
from ..util.arrays import channel_mean
from .camera import PassLanes, film_extent
from .gradient_pass import GradientSamples

#: Pixels on each side, along each axis, over which samples are averaged.
_RADIUS = 1


# Not a dataclass: Dr.Jit would look for arrays in it, as an attribute of a scene's own integrator
class PixelSensitivity:
    """The mean of a sample's derivative in each pixel, over all measurements. It is measured in the
    passes 1, 2, 4, 8 and so on, so that it takes a small part of the time of an optimization.

    Attributes:
        mean (numpy.ndarray): The mean over each pixel and its neighbours, shape [y, x] in the
            film's extent.
    """

    def __init__(self) -> None:
        self.mean: np.ndarray | None = None
        self._passes, self._sums, self._samples = 0, np.zeros(()), 0

    def is_due(self) -> bool:
        """Whether it should be measured in this pass, which it counts."""
        self._passes += 1
        return self._passes & (self._passes - 1) == 0

    def measure(
        self, walk: Walk, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, spp: int
    ) -> None:
        """Takes ``spp`` samples of each pixel.

        Parameters:
            walk: Its samples are derivatives (``sensitivity.py``).
            sampler: Seeded for the samples.
        """
        width, height = film_extent(sensor.film())
        samples = GradientSamples(PassLanes.of(sensor.film(), spp, 0, None), spp)
        values = with_recordings(
            scene, sensor, lambda: _values(walk, scene, sensor, sampler.clone(), samples)
        )
        values = np.array(values, np.float64).reshape(height, width, spp)
        self._sums = self._sums + np.nan_to_num(values, nan=0, posinf=0, neginf=0).sum(axis=2)
        self._samples += spp
        self.mean = box_means(self._sums, _RADIUS) / self._samples


@frozen(any_width=True)
def _values(
    walk: Walk, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, samples: GradientSamples
) -> mi.Float:
    rays = samples.rays(sensor, sampler)
    return channel_mean(walk(scene, sampler, rays, mi.Bool(True)).L)
