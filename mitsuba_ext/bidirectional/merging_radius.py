"""How the radius of merging shrinks."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class MergingRadius:
    """The radius of merging. It shrinks from pass to pass, so that bias vanishes, and suits the
    number of light paths of a pass: a disk holds about as many vertices whatever that is.

    Source: C. Knaus, M. Zwicker, *Progressive Photon Mapping: A Probabilistic Approach*, ACM
    Transactions on Graphics 30(3), 2011: the squared radius of pass i is proportional to i^(α − 1)
    (in the limit of their Eq. 15).

    Parameters:
        first: The radius of a first pass that has one light path per pixel.
        decay: α, in (0, 1]; 1 for a constant radius.
        pixels: Number of pixels.
        footprint: The width of a pixel, where the camera sees the scene.
        before: Light paths per pixel of passes that other renders have made before.
    """

    first: float
    decay: float
    pixels: int
    footprint: float
    before: int = 0
    _passes: int = 0

    def next(self, paths: int, groups: int = 1) -> float:
        """The radius of the next pass, of so many light paths; or of so many groups, of so many
        light paths each, whose vertices are not merged with those of other groups."""
        share = self.pixels / paths
        number = self._passes + 1 + self.before * share
        self._passes += groups
        return self.first * (share * number ** (self.decay - 1)) ** 0.5

    def samples_per_vertex(self, light_paths: float, spp: float) -> float:
        """So many samples of a pixel, of the ``spp`` of a first pass, find the same vertex, where
        any of them does: their errors are the same. ``light_paths`` is the number of these for each
        camera path."""
        disk = math.pi * self.first**2 / (light_paths * spp)
        return max(1.0, spp * disk / (disk + self.footprint**2))
