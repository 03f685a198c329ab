"""How the radius of merging shrinks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass
class MergingRadius:
    """The radius of merging. It shrinks from pass to pass, so that bias vanishes. It also depends
    on the number of light paths of a pass: a disk, or a ball, holds about the same number of
    vertices in passes of any size. In short passes, such a disk would be wide, and its bias would
    outweigh the noise of all passes together; ``widest`` limits the radius by the number of samples
    so far, whatever the number of passes.

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
        widest: The largest radius after one light path per pixel. It shrinks with the number of
            light paths per pixel, as the radius does in passes of one light path per pixel.
        dimensions: 2 for disks, 3 for balls.
        free_path: The mean free path in a ball, where it is known.
    """

    first: float
    decay: float
    pixels: int
    footprint: float
    before: int = 0
    widest: float = math.inf
    dimensions: int = 2
    free_path: float = 0.0
    _passes: int = 0

    def of_coarse_film(self, pixel_width: float) -> MergingRadius:
        """The radius for a render with fewer pixels, each as wide as ``pixel_width`` pixels of the
        film: its disks are wider, and hold the same number of vertices."""
        return replace(
            self,
            first=self.first * pixel_width ** (2 / self.dimensions),
            widest=self.widest * pixel_width ** (2 / self.dimensions),
            footprint=self.footprint * pixel_width,
            pixels=max(1, round(self.pixels / pixel_width**2)),
        )

    def next(self, paths: int, groups: int = 1) -> float:
        """The radius of the next pass, which has ``groups`` groups of ``paths`` light paths each.
        Vertices of different groups are not merged."""
        per_pixel = paths / self.pixels
        number = self._passes + 1 + self.before / per_pixel
        self._passes += groups
        return self._radius(per_pixel, number)

    def samples_per_vertex(self, light_paths: float, spp: float, passes: int = 1) -> float:
        """Of the ``spp`` samples that a pixel has in a pass: how many find the same vertex, where
        any sample does, and thus have the same error. The mean over the first ``passes``. A sample
        that passes through a ball finds the vertex if it scatters there.

        Parameters:
            light_paths: Number of light paths for each camera path.
        """
        total = 0.0
        for number in range(1, passes + 1):
            radius = self._radius(light_paths * spp, number)
            disk = math.pi * radius**2
            finds = disk / (disk + self.footprint**2)
            if self.free_path > 0:  # 4/3 r is the mean chord of a ball
                finds *= 1 - math.exp(-4 / 3 * radius / self.free_path)
            total += max(1.0, spp * finds)
        return total / passes

    def _radius(self, per_pixel: float, number: float) -> float:
        """The radius of pass ``number``, with ``per_pixel`` light paths per pixel."""
        by_samples = (number * per_pixel) ** (self.decay - 1)
        shrinks = by_samples if self.footprint == 0 else number ** (self.decay - 1) / per_pixel
        power = 1 / self.dimensions
        return min(self.first * shrinks**power, self.widest * by_samples**power)


@dataclass
class MergingRadii:
    """Where vertices are merged: at least one of the two is not ``None``.

    Attributes:
        disk: The radius on surfaces; ``None`` if none are merged there.
        ball: The radius in participating media; ``None`` if none are merged there.
    """

    disk: MergingRadius | None
    ball: MergingRadius | None = None

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return (self.disk or self.ball).pixels

    def of_coarse_film(self, pixel_width: float) -> MergingRadii:
        """:meth:`MergingRadius.of_coarse_film` of both."""
        return MergingRadii(
            self.disk and self.disk.of_coarse_film(pixel_width),
            self.ball and self.ball.of_coarse_film(pixel_width),
        )

    def samples_per_vertex(
        self, light_paths: float, spp: float, passes: int = 1
    ) -> tuple[float, float]:
        """:meth:`MergingRadius.samples_per_vertex` of disks and balls; 1 where none are merged."""
        disk, ball = (
            radius.samples_per_vertex(light_paths, spp, passes) if radius else 1.0
            for radius in (self.disk, self.ball)
        )
        return disk, ball
