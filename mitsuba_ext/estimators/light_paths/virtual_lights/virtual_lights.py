"""Virtual point lights: the vertices of light paths, in sets."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.estimator import CameraRays
from ....transport.numbers import Numbers
from ..light_numbers import LightPathRays, light_numbers
from ..light_vertices import VertexCache
from ..light_walk import LightWalk

#: The most light paths of a pass, and its least number of samples for each, beyond the first set.
MOST_PATHS, _SAMPLES_PER_PATH = 1 << 21, 4


@dataclass(frozen=True)
class Sets:
    """How the samples of a pass share sets of virtual lights: the first samples of all pixels have
    one set, the second ones another, and so on. If sets are interleaved, neighbouring pixels have
    different sets.

    Attributes:
        pixels: Number of pixels of the film.
        width: Number of pixels in a row.
        paths: Number of light paths of a set.
        interleaving: Width and height, in pixels, of the pattern that the sets of a sample form.
    """

    pixels: int
    width: int
    paths: int
    interleaving: int = 1

    def count(self, lanes: int) -> int:
        """The number of sets of a pass with one sample in each of ``lanes``."""
        wanted = self._spp(lanes) * self.interleaving**2
        most = min(MOST_PATHS, lanes // _SAMPLES_PER_PATH) // self.paths
        return max(1, min(wanted, max(self.interleaving**2, most), MOST_PATHS // self.paths))

    def of_lanes(self, rays: CameraRays) -> mi.UInt32:
        """The set of each sample."""
        lanes = dr.width(rays.ray)
        # The samples of a pixel are in neighbouring lanes
        index = dr.arange(mi.UInt32, lanes) % dr.opaque(mi.UInt32, self._spp(lanes))
        if self.interleaving > 1 and rays.pixel is not None:
            n = self.interleaving
            x, y = rays.pixel % self.width, rays.pixel // self.width
            index = index * n**2 + x % n + n * (y % n)
        return index % dr.opaque(mi.UInt32, self.count(lanes))

    def _spp(self, lanes: int) -> int:
        return max(1, lanes // self.pixels)


class VirtualLights:
    """The virtual lights of a pass.

    Parameters:
        scene: The scene.
        vertices: The vertices of all sets, set by set.
        set_count: Number of sets.
        paths: Number of light paths of a set.

    Attributes:
        scene, vertices, set_count: The parameters.
        begin, number (mi.UInt32): The first vertex of each set, and its number of vertices.
        share (mi.Float): 1 / number of light paths of a set.
    """

    def __init__(
        self, scene: mi.Scene, vertices: VertexCache, set_count: int, paths: int
    ) -> None:
        self.scene, self.vertices, self.set_count = scene, vertices, set_count
        self.share = dr.opaque(mi.Float, 1 / paths)
        first = dr.arange(mi.UInt32, set_count) * dr.opaque(mi.UInt32, paths)
        last = first + dr.opaque(mi.UInt32, paths - 1)
        self.begin = dr.gather(mi.UInt32, vertices.end, first)
        self.begin -= dr.gather(mi.UInt32, vertices.number, first)
        self.number = dr.gather(mi.UInt32, vertices.end, last) - self.begin
        dr.eval(self.begin, self.number)

    @classmethod
    def trace(
        cls,
        scene: mi.Scene,
        walk: LightWalk,
        sampler: Numbers,
        rays: CameraRays,
        set_count: int,
        paths: int,
    ) -> tuple[VirtualLights | None, mi.UInt32]:
        """Traces the light paths of a pass. ``None`` if they have met nothing. Also returns, for
        each light path, the rays traced in directions that were sampled from a BSDF."""
        lanes, count = dr.width(rays.ray), set_count * paths
        numbers = light_numbers(sampler, lanes, count)
        time = rays.ray.time
        if dr.width(time) > 1:
            # Nothing moves: any time is as good as another
            time = dr.gather(mi.Float, time, mi.UInt32(0))
        light = LightPathRays(count, numbers, time, rays.ray.wavelengths)
        vertices, scatter_count = walk.run(
            scene, light.numbers, light.time, light.wavelengths, dr.full(mi.Bool, True, count)
        )
        if vertices is None:
            return None, scatter_count
        return cls(scene, vertices, set_count, paths), scatter_count
