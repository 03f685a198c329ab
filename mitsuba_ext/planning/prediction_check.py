"""Checks whether what a trial has chosen is as good as predicted."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..images.coarse_film import CoarseFilm
from ..rendering.camera import film_extent, first_pixel
from ..rendering.pass_images import PassImages
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
        least: The least variance of what was chosen, in the same pixels: some may be due to paths
            that are too rare to be seen in the images.
        weight: The weight of squared errors in these pixels; ``None`` for that which follows from
            the images. There, a rare bright sample makes its own pixel bright, and weigh little.

    Attributes:
        images: The images of the stages after the trial.
        variance: Their variance, relative to that error; ``None`` before :meth:`failed`.
        error: The standard error of its logarithm.
    """

    def __init__(
        self,
        film: mi.Film,
        coarse: CoarseFilm,
        of_rival: np.ndarray,
        least: np.ndarray | float = 0.0,
        weight: np.ndarray | None = None,
    ) -> None:
        self._film, self._coarse, self._of_rival, self._least = film, coarse, of_rival, least
        self._weight, self.images = weight, PassImages(film)
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
        variance = np.maximum(self._on_coarse_film(self.images.variance()), self._least)
        weight = self._weight
        if weight is None:
            mean = self._on_coarse_film(self.images.mean()).reshape(self._coarse.height, -1)
            weight = relative_scale(mean, 1).ravel() ** 2
        # Pixels are left out where either is largest
        sums = trimmed_batches(variance * weight, (self._of_rival - variance) * weight)
        gain, self.error = gain_of(sums)
        self.variance = 1 - gain
        efficiency = 1 / (max(self.variance, 1e-6) * time)
        return bool(efficiency * np.exp(self.error) < rival)

    def _on_coarse_film(self, image: np.ndarray) -> np.ndarray:
        """The means of an image of the crop window over the rectangles of the coarse film."""
        height, width = image.shape
        place = np.arange(self._coarse.pixel_count)
        if self._coarse.of_pixel is not None:
            place = self._coarse.of_pixel
        x, y = np.subtract(self._film.crop_offset(), first_pixel(self._film))
        place = place.reshape(-1, film_extent(self._film)[0])[y : y + height, x : x + width].ravel()
        count = self._coarse.width * self._coarse.height
        sums = np.bincount(place, image.ravel(), count)
        return sums / np.maximum(np.bincount(place, minlength=count), 1)
