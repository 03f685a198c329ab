"""The errors of renders with other techniques, as a pilot predicts them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....planning.evidence import gain_of, trimmed_batches
from ....planning.pixel_estimates import relative_scale
from .path_moments import Estimate
from .photon_samples import PhotonEstimate

#: Light is missing if this number of its contributions, or fewer, is expected in all pixels of a
#: render: one render in a thousand holds one.
_LEAST = 1e-3

#: The pixels that ``trimmed`` leaves out, as comparisons do.
_LEFT_OUT = 1e-3

#: Less light than this share is not missing: densities of paths become too small for floats.
_NOTHING = 1e-6


@dataclass(frozen=True)
class PredictedErrors:
    """For each candidate, figures relative to ``path``, [candidate] each.

    The error of a pixel is divided by the square of the mean radiance of the pixel and its
    neighbours.

    Attributes:
        variances: The expected squared error of a render of this length. Light that a candidate
            cannot find counts as missing, by its square; so does light that hardly any render
            finds.
        trimmed: The same, without the brightest contributions, which one pixel in a thousand holds.
        long_run: The variance: the error of long renders. It is infinite for a candidate that
            cannot find some light; if ``path`` cannot, it is 0 for all others.
        missed: The share of the light that is missing in ``variances``.
        uncertainty: The standard error of the logarithm of ``variances``.
        of_path: The squared error of each pixel with ``path``, for one sample: the squared error of
            the render, times the number of samples.
        of_image: The mean of ``of_path`` over the image, relative to the squared radiance of the
            pixels; and the same without the brightest contributions.
    """

    variances: np.ndarray
    trimmed: np.ndarray
    long_run: np.ndarray
    missed: np.ndarray
    uncertainty: np.ndarray
    of_path: np.ndarray
    of_image: tuple[float, float]

    @classmethod
    def of(
        cls,
        estimate: Estimate,
        width: int,
        spp: int,
        pixel_count: int,
        photons: PhotonEstimate | None = None,
    ) -> PredictedErrors:
        """The predicted errors of a render.

        Parameters:
            estimate: What the pilot has found.
            width: Pixels of a row of the pilot's film.
            spp, pixel_count: Samples per pixel of the render, and its number of pixels.
            photons: What photons have found, which are then the last candidate.
        """
        # Wider neighbourhoods would judge the pixels of a lamp by the wall behind it
        mean = estimate.mean if photons is None else photons.mean
        scale = relative_scale(mean.reshape(-1, width), 1).ravel()
        shares = _LEAST / pixel_count, _LEFT_OUT
        (whole, missed), (trimmed, _) = estimate.errors_of_render(scale, spp, shares)
        variances, never_found = estimate.variances, estimate.never_found()
        if photons is not None:
            whole, trimmed, variances = (
                [*x, photons.variance] for x in (whole, trimmed, variances)
            )
            missed, never_found = (np.append(x, 0) for x in (missed, never_found))
        of_image = tuple(float((x[0] * scale**2).mean()) for x in (whole, trimmed))
        long_run, _ = _relative_to_all(variances, scale)
        variances, uncertainty = _relative_to_all(whole, scale)
        trimmed, _ = _relative_to_all(trimmed, scale)
        misses = never_found > _NOTHING
        if misses[0]:
            long_run = np.where(misses, 1.0, 0.0)
        else:
            long_run = np.where(misses, np.inf, long_run / long_run[0])
        variances, trimmed = variances / variances[0], trimmed / trimmed[0]
        return cls(variances, trimmed, long_run, missed, uncertainty, whole[0], of_image)


def _relative_to_all(
    squared_errors: list[np.ndarray], scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The relative squared error of each candidate, divided by the one with all techniques; and the
    standard error of the logarithm of this ratio."""
    weight = scale**2
    everything = squared_errors[1] * weight
    # Here the batches are of pixels, not of paths
    found = [
        gain_of(trimmed_batches(everything, error * weight - everything))
        for error in squared_errors
    ]
    gains, uncertainty = np.array(found).T
    return 1 / np.maximum(1 - gains, 1e-6), uncertainty
