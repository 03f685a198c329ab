"""Checks whether what a trial has chosen is as good as predicted."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.coarse_film import CoarseFilm, place
from ..rendering.camera import film_extent, first_pixel
from ..rendering.pass_images import PassImages
from ..util.arrays import joined
from .evidence import gain_of, trimmed_batches
from .pixel_estimates import relative_scale


class PredictionCheck:
    """Compares the variance of the stages after a trial, which use what it has chosen, to the error
    that it has predicted for what it has not chosen. (Other pilots would be no measure of ``path``:
    the rare paths that make most of its variance may be missing in them.)

    Parameters:
        film: The film of the render.
        coarse: That of the trial.
        of_rival: The squared error of one sample of what was not chosen, in each pixel of the
            coarse film.

    Attributes:
        images: The images of the stages after the trial.
        variance: Their variance, relative to that error; ``None`` before :meth:`failed`.
        error: The standard error of its logarithm.
    """

    def __init__(self, film: mi.Film, coarse: CoarseFilm, of_rival: np.ndarray) -> None:
        self._film, self._coarse, self._of_rival = film, coarse, of_rival
        self.images = PassImages(film)
        self.variance: float | None = None
        self.error = 0.0

    def failed(self, time: float, rival: float) -> bool:
        """Whether what was chosen is less efficient than its rival, by more than the error of this
        measurement.

        Parameters:
            time: The time of a sample of it, in units of that to which ``of_rival`` belongs.
            rival: The efficiency of its rival, in the same units.
        """
        if self.images.count < 2:
            return False
        variance, mean = self._on_coarse_film(self.images.variance(), self.images.mean())
        weight = relative_scale(mean.reshape(self._coarse.height, -1), 1).ravel() ** 2
        # Pixels are left out where either is largest
        sums = trimmed_batches(variance * weight, (self._of_rival - variance) * weight)
        gain, self.error = gain_of(sums)
        self.variance = 1 - gain
        efficiency = 1 / (max(self.variance, 1e-6) * time)
        return bool(efficiency * np.exp(self.error) < rival)

    def _on_coarse_film(self, *images: mi.Float64) -> np.ndarray:
        """The means of images of the crop window over the rectangles of the coarse film, shape
        [images, rectangles]."""
        width = dr.opaque(mi.UInt32, int(self._film.crop_size().x))
        index = dr.arange(mi.UInt32, dr.width(images))
        cell = [index % width, index // width]
        corner = np.subtract(self._film.crop_offset(), first_pixel(self._film))
        parts = self._coarse.width, self._coarse.height
        for axis, size in enumerate(film_extent(self._film)):
            first, size, count = (
                dr.opaque(mi.UInt32, int(x)) for x in (corner[axis], size, parts[axis])
            )
            cell[axis] = place(cell[axis] + first, size, count)
        rectangle = cell[1] * dr.opaque(mi.UInt32, parts[0]) + cell[0]
        # In double precision: the order of the pixels changes digits that decide nothing
        sums = [dr.zeros(mi.Float64, parts[0] * parts[1]) for _ in range(len(images) + 1)]
        for total, image in zip(sums, (*images, mi.Float64(1))):
            dr.scatter_add(total, image, rectangle, mode=dr.ReduceMode.Direct)
        *sums, count = sums
        means = joined([mi.Float(x / dr.maximum(count, 1)) for x in sums])
        return means.numpy().reshape(len(sums), -1).astype(np.float64)
