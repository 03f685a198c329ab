"""Finds the pixels that a single sample brightens most."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..rendering.camera import film_extent, first_pixel
from ..rendering.render import Job
from ..rendering.request import Request
from ..rendering.staged import Staged
from ..rendering.stages import Stage
from ..transport.estimator import CameraRays, Sample
from ..util.spectra import to_rgb


class BrightPixelsJob(Job):
    """Renders the image, and keeps the brightness of all samples of a pixel, and of the brightest
    one."""

    freezes_passes = False

    def __init__(self, integrator: Staged, request: Request) -> None:
        super().__init__(integrator, request)
        self._left_out = 0
        self._clear()

    def _clear(self) -> None:
        count = self.plan.pixel_count
        self._sums, self._peaks = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
        self._weights = dr.zeros(mi.Float, count)
        dr.eval(self._sums, self._peaks, self._weights)

    def _sample(
        self, stage: Stage, sampler: mi.Sampler, rays: CameraRays, count: mi.Float | float = 1.0
    ) -> Sample:
        if self._left_out != self.forgotten:
            self._left_out = self.forgotten
            self._clear()
        sample = super()._sample(stage, sampler, rays, count)
        rgb = to_rgb(sample.L * rays.importance * rays.weight, rays.ray.wavelengths)
        self._add(mi.luminance(mi.Color3f(rgb)) * count, rays.pixel, mi.Bool(True))
        dr.scatter_add(self._weights, mi.Float(count), rays.pixel)
        for splats in sample.splats:
            width, height = film_extent(self.film)
            x, y = first_pixel(self.film)
            column = mi.Int32(dr.floor(splats.position.x)) - x
            row = mi.Int32(dr.floor(splats.position.y)) - y
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            rgb = mi.Color3f(to_rgb(splats.value, splats.wavelengths))
            self._add(mi.luminance(rgb), mi.UInt32(row * width + column), splats.active & inside)
        # With the image, as reading them alone would launch the walk a second time
        dr.schedule(self._sums, self._peaks, self._weights)
        return sample

    def _add(self, brightness: mi.Float, pixel: mi.UInt32, active: mi.Bool) -> None:
        # An infinite or undefined sample comes before all others
        brightness = dr.select(dr.isfinite(brightness), dr.abs(brightness), 1e30)
        dr.scatter_add(self._sums, brightness, pixel, active)
        dr.scatter_reduce(dr.ReduceOp.Max, self._peaks, brightness, pixel, active)

    def brightest(self, count: int) -> list[tuple[int, int]]:
        """Up to ``count`` pixels of the image, by the difference between the mean of all samples
        and the mean without the brightest one."""
        sums, peaks, weights = (
            array.numpy().astype(np.float64) for array in (self._sums, self._peaks, self._weights)
        )
        others = np.maximum(sums - peaks, 0) / np.maximum(weights - 1, 1)
        # Sums are exact to about 7 digits: less is no difference
        differs = peaks - others > 1e-5 * peaks
        excess = np.where(differs, (peaks - others) / np.maximum(weights, 1), 0)
        width, height = film_extent(self.film)
        border = (width - int(self.film.crop_size()[0])) // 2
        image = excess.reshape(height, width)
        image = image[border : height - border, border : width - border]
        order = np.argsort(-image, axis=None, kind="stable")[:count]
        places = [divmod(int(index), image.shape[1]) for index in order]
        return [(x, y) for y, x in places if image[y, x] > 0]
