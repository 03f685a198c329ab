"""Russian roulette by the expected contribution of a path.

Source: J. Vorba, J. Křivánek, *Adjoint-Driven Russian Roulette and Splitting in Light Transport
Simulation*, 2016, sections 3 and 4. Without splitting: a lane of the walk is one path. The lower
end of the weight window is not from the paper.
"""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.path_decisions import Roulette
from ...util.arrays import channel_mean

#: A path whose expected contribution is at least this share of its pixel's radiance continues with
#: certainty. With 0.3, the efficiency by rays is 0.86 of that with 0.15 (lamp in a glass ball),
#: 0.93 (veach-ajar) or the same (door_ajar, cornell_box).
_CERTAIN = 0.15

#: The least probability: where an estimate is too low, it bounds the weights of surviving paths.
_LEAST = 0.1

#: From this depth on, no path survives with certainty: some would never end.
_DEEP, _DEEP_PROBABILITY = 16, 0.95


class Regions(Protocol):
    """The regions for which mean radiances are learned."""

    def label(
        self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32 | None, active: mi.Bool
    ) -> mi.UInt32:
        """The region of a vertex."""


class AdjointRoulette(Roulette):
    """Compares the expected contribution of a path with the radiance of its pixel.

    The expected contribution is the throughput times the mean radiance that bounces find in the
    region of the vertex. (Using the density of the guided direction as well gained nothing.)
    Mirrors and glass have no such mean, and no path ends there: the expectation of the last vertex
    has not changed.

    Parameters:
        regions: Finds the region of a vertex.
        radiance: Mean incident radiance of each region, negative where it is unknown. [regions]
        scale: 1 / radiance of each pixel of the film, row by row. [pixels]
    """

    def __init__(self, regions: Regions, radiance: mi.Float, scale: mi.Float) -> None:
        self._regions, self._radiance, self._scale = regions, radiance, scale
        dr.make_opaque(self._radiance, self._scale)

    @classmethod
    def by_throughput(cls, regions: Regions, count: int, pixels: int) -> AdjointRoulette:
        """A roulette that knows nothing yet, of numbers of regions and pixels: it ends paths of low
        throughput. With it, the pilot that learns the first radiances has the kernel of the pilots
        after it."""
        return cls(regions, dr.full(mi.Float, _CERTAIN, count), dr.full(mi.Float, 1, pixels))

    def state(self) -> dict[str, np.ndarray]:
        """The tables as arrays."""
        return {"radiance": self._radiance.numpy(), "scale": self._scale.numpy()}

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> mi.Float:
        return dr.gather(mi.Float, self._scale, pixel)

    def survival(self, state, vertex, path, active):
        region = self._regions.label(vertex.si, None, active)
        radiance = dr.gather(mi.Float, self._radiance, region, active)
        expected = channel_mean(path.β) * radiance * state
        p = dr.clip(expected * (1 / _CERTAIN), _LEAST, 1)
        p = dr.select(radiance < 0, 1, p)
        if vertex.medium is not None:
            # No mean is known in media, and paths scatter there often
            by_throughput, _ = super().survival(None, vertex, path, active)
            p = dr.select(vertex.medium.scatters, by_throughput, p)
        return dr.select(path.depth >= _DEEP, dr.minimum(p, _DEEP_PROBABILITY), p), state
