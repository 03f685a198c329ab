"""Do light paths keep what their trial has promised?"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..images.coarse_film import CoarseFilm
from ..learning.benefit import gain_of, trimmed_batches
from ..learning.pixel_estimates import relative_scale
from ..rendering.camera import film_extent, first_pixel
from ..rendering.pass_images import PassImages


class LightPathPromise:
    """Compares the variance of stages with light paths to the error that the trial has predicted
    for ``path``. (The pilots without light paths would be no measure: the rare paths that make most
    of the variance of ``path`` may be missing in them.)

    Parameters:
        film: The film of the render.
        coarse: That of the trial.
        of_path: The squared error of one sample of ``path``, in each pixel of the coarse film.

    Attributes:
        images: The images of the stages with light paths.
        variance: Their variance, relative to that error; ``None`` before :meth:`is_broken`.
        error: The standard error of its logarithm.
    """

    def __init__(self, film: mi.Film, coarse: CoarseFilm, of_path: np.ndarray) -> None:
        self._film, self._coarse, self._of_path = film, coarse, of_path
        self.images = PassImages(film)
        self.variance: float | None = None
        self.error = 0.0

    def is_broken(self, time: float, rival: float) -> bool:
        """Are light paths less efficient than what they replaced, by more than the error of this
        measurement?

        Parameters:
            time: The time of a sample with light paths, in units of that of ``path``.
            rival: The efficiency of what they replaced, in the same units.
        """
        if self.images.count < 2:
            return False
        mean = self._on_coarse_film(self.images.mean())
        variance = self._on_coarse_film(self.images.variance())
        weight = relative_scale(mean.reshape(self._coarse.height, -1), 1).ravel() ** 2
        # Pixels are left out where either is largest
        sums = trimmed_batches(variance * weight, (self._of_path - variance) * weight)
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
