"""The random numbers of light paths."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.estimator import CameraRays
from ...transport.numbers import BothEnds, Numbers


@dataclass
class LightPathRays:
    """What the light paths of a pass begin with.

    Attributes:
        count: Number of light paths.
        numbers: Their random numbers.
        time, wavelengths: Time and wavelengths of each path.
    """

    count: int
    numbers: Numbers
    time: mi.Float
    wavelengths: mi.Spectrum

    @classmethod
    def of(cls, sampler: Numbers, rays: CameraRays, per_camera_path: float = 1.0) -> LightPathRays:
        """``per_camera_path`` light paths for each of the camera ``rays``. With one for each, a
        light path has the time and the wavelengths of the ray in its lane."""
        lanes = dr.width(rays.ray)
        count = max(1, round(lanes * per_camera_path))
        time, wavelengths = rays.ray.time, rays.ray.wavelengths
        if count != lanes:
            ray = dr.arange(mi.UInt32, count) % dr.opaque(mi.UInt32, lanes)
            time = time if dr.width(time) == 1 else dr.gather(mi.Float, time, ray)
        return cls(count, light_numbers(sampler, lanes, count), time, wavelengths)

    def emits(self, active: mi.Bool) -> mi.Bool:
        """Which light paths are traced, if the camera rays ``active`` are traced."""
        every = dr.full(mi.Bool, True, self.count)
        return active & every if dr.width(active) in (1, self.count) else every

    def by_camera_path(self, count: mi.UInt32, lanes: int) -> mi.UInt32:
        """Converts a count per light path to ``lanes`` of camera paths. If there is not one light
        path for each lane, the first lane has the whole count."""
        if self.count == lanes:
            return count
        return dr.select(dr.arange(mi.UInt32, lanes) == 0, dr.sum(count), 0)


def light_numbers(sampler: Numbers, lanes: int, count: int) -> Numbers:
    """The random numbers of light paths. They come from ``sampler``, which has ``lanes``, with two
    exceptions: if the number of light paths differs from ``lanes``, and with Mitsuba 3.9.1's
    ``ldsampler``. Light paths then draw independent numbers, whose seed comes from the sampler. The
    pairs of numbers of ``ldsampler`` depend on each other: some points of a lamp would be combined
    with some directions more often than with others (up to 6 % too bright in a quarter of an
    image). Markov chains have separate numbers for light paths (``BothEnds``).

    Parameters:
        count: Number of light paths.
    """
    if isinstance(sampler, BothEnds):
        return sampler.light
    if not isinstance(sampler, mi.Sampler):
        return sampler
    if count == lanes and sampler.class_name() != "LowDiscrepancySampler":
        return sampler
    numbers = mi.load_dict({"type": "independent"})
    # A random number has 24 bits
    seed = mi.UInt32(sampler.next_1d() * float(1 << 24))
    numbers.seed(dr.gather(mi.UInt32, seed, 0), count)
    return numbers
