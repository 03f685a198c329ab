"""How the radius of merging shrinks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass
class MergingRadius:
    """The radius of merging. It shrinks from pass to pass, so that bias vanishes, and suits the
    number of light paths of a pass: a disk, or a ball, holds about as many vertices whatever that
    is. In short passes, such a disk would be wide, and its bias would outweigh the noise of all
    passes together; ``widest`` limits the radius by the number of samples so far, in however many
    passes.

    Source: C. Knaus, M. Zwicker, *Progressive Photon Mapping: A Probabilistic Approach*, ACM
    Transactions on Graphics 30(3), 2011: the area of the disk of pass i is proportional to
    i^(α − 1) (in the limit of their Eq. 15), and so is the volume of its ball in a medium (their
    section 6).

    Parameters:
        first: The radius of a first pass that has one light path per pixel.
        decay: α, in (0, 1]; 1 for a constant radius.
        pixels: Number of pixels.
        footprint: The width of a pixel, where the camera sees the scene. 0 if all samples of a
            pixel see the same point (a radiance meter): a narrower disk for each of them would then
            make their common error larger, and the disks of passes of any size have the same area
            after the same number of samples.
        before: Light paths per pixel of passes that other renders have made before.
        widest: The largest radius after one light path per pixel; it shrinks with their number as
            that of passes of one.
        dimensions: 2 for disks, 3 for balls.
    """

    first: float
    decay: float
    pixels: int
    footprint: float
    before: int = 0
    widest: float = math.inf
    dimensions: int = 2
    _passes: int = 0

    def of_coarse_film(self, pixel_width: float) -> MergingRadius:
        """That of a render of a film with fewer pixels, each as wide as ``pixel_width`` of them:
        its disks are wider, and hold as many vertices."""
        return replace(
            self,
            first=self.first * pixel_width ** (2 / self.dimensions),
            widest=self.widest * pixel_width ** (2 / self.dimensions),
            footprint=self.footprint * pixel_width,
            pixels=max(1, round(self.pixels / pixel_width**2)),
        )

    def next(self, paths: int, groups: int = 1) -> float:
        """The radius of the next pass, of so many light paths; or of so many groups, of so many
        light paths each, whose vertices are not merged with those of other groups."""
        per_pixel = paths / self.pixels
        number = self._passes + 1 + self.before / per_pixel
        self._passes += groups
        return self._radius(per_pixel, number)

    def samples_per_vertex(self, light_paths: float, spp: float, passes: int = 1) -> float:
        """So many samples of a pixel, of the ``spp`` of a pass, find the same vertex, where any of
        them does: their errors are the same. The mean over the first ``passes``.

        Parameters:
            light_paths: Number of light paths for each camera path.
        """
        total = 0.0
        for number in range(1, passes + 1):
            disk = math.pi * self._radius(light_paths * spp, number) ** 2
            total += max(1.0, spp * disk / (disk + self.footprint**2))
        return total / passes

    def _radius(self, per_pixel: float, number: float) -> float:
        """That of the pass of this number, with so many light paths per pixel."""
        by_samples = (number * per_pixel) ** (self.decay - 1)
        shrinks = by_samples if self.footprint == 0 else number ** (self.decay - 1) / per_pixel
        power = 1 / self.dimensions
        return min(self.first * shrinks**power, self.widest * by_samples**power)
