"""The errors of renders with other techniques, as a pilot predicts them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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

#: The least part of an error that is left without a group of paths.
_LEAST_LEFT = 0.1

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
        missed: The share of the light that is missing in ``variances``.
        uncertainty: The standard error of the logarithm of ``variances``, as contrast between
            pixels or between groups of paths shows it, whichever is larger.
        of_path: The squared error of each pixel with ``path``, for one sample: the squared error of
            the render, times the number of samples.
    """

    variances: np.ndarray
    missed: np.ndarray
    uncertainty: np.ndarray
    of_path: np.ndarray
    _scale: np.ndarray
    _trimmed: list[np.ndarray]
    _of_samples: list[np.ndarray]
    _misses: np.ndarray

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
        moments = estimate.moments_of_groups(scale)
        if photons is not None:
            whole, trimmed, variances = (
                [*x, photons.variance] for x in (whole, trimmed, variances)
            )
            missed, never_found = (np.append(x, 0) for x in (missed, never_found))
            # Photons have samples of their own
            moments = np.vstack([moments, np.ones(moments.shape[1])])
        by_pixels = _relative_to(0, whole, scale)[1]
        by_groups = _errors_by_groups(np.array([x @ scale**2 for x in whole]), moments)
        relative, _ = _relative_to(1, whole, scale)
        return cls(
            relative / relative[0], missed, np.maximum(by_pixels, by_groups), whole[0], scale,
            trimmed, variances, never_found > _NOTHING,
        )  # fmt: skip

    @cached_property
    def trimmed(self) -> np.ndarray:
        """``variances`` without the brightest contributions, which one pixel in a thousand
        holds."""
        relative, _ = _relative_to(1, self._trimmed, self._scale)
        return relative / relative[0]

    @cached_property
    def long_run(self) -> np.ndarray:
        """The variance: the error of long renders. It is infinite for a candidate that cannot find
        some light; if ``path`` cannot, it is 0 for all others."""
        if self._misses[0]:
            return np.where(self._misses, 1.0, 0.0)
        relative, _ = _relative_to(1, self._of_samples, self._scale)
        return np.where(self._misses, np.inf, relative / relative[0])

    @property
    def of_image(self) -> tuple[float, float]:
        """The mean of ``of_path`` over the image, relative to the squared radiance of the pixels;
        and the same without the brightest contributions."""
        whole, trimmed = (x * self._scale**2 for x in (self.of_path, self._trimmed[0]))
        return float(whole.mean()), float(trimmed.mean())


def _relative_to(
    reference: int, squared_errors: list[np.ndarray], scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The relative squared error of each candidate, divided by that of the ``reference``; and the
    standard error of the logarithm of this ratio, from batches of pixels."""
    weight = scale**2
    known = squared_errors[reference] * weight
    found = [
        gain_of(trimmed_batches(known, error * weight - known)) for error in squared_errors
    ]
    gains, uncertainty = np.array(found).T
    return 1 / np.maximum(1 - gains, 1e-6), uncertainty


def _errors_by_groups(squared_errors: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """The standard error of the logarithm of ``squared_errors``, relative to the first candidate,
    from the second moments that groups of paths have found, [candidate, group].

    Jackknife: each group is left out, and the others stand for it. Pixels would not show this
    error, because a light path may bring light to many of them."""
    count = moments.shape[1]
    changes = (moments.sum(axis=1, keepdims=True) - count * moments) / (count - 1)
    left = 1 + changes / np.maximum(squared_errors, 1e-30)[:, None]
    deviations = np.log(np.maximum(left, _LEAST_LEFT))
    squares = np.square(deviations - deviations[0]).sum(axis=1)
    return np.sqrt((count - 1) / count * squares)
