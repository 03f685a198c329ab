"""Measures the error of an image against a reference.

All functions take linear RGB of shape (height, width, 3) and compute in double precision. If the
variance of the reference's mean is known, it is subtracted from the squared errors: the reference's
noise would otherwise add to every error. If the difference is zero or negative, the error of the
image is too small to be measured with this reference.

σ/μ and FLIP include the reference's noise. They take absolute values, so the amount to subtract
would depend on the correlation of the noise between channels, which is not stored. A reference by
the same method with K times the samples of the image raises σ/μ by a factor of √(1 + 1/K), 3 % at K
= 16.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from .box_filter import box_means
from .flip import mean_flip

#: The term ε in the relative error, as a multiple of the reference's squared mean.
RELATIVE_FLOOR = 1e-2

#: The percentile of the pixels' relative errors that represents the worst pixels.
_WORST = 99

#: The fraction of pixels, with the largest errors, that the trimmed relMSE omits.
TRIMMED_SHARE = 1e-3

#: The minimum number of images that :func:`errors_between_seeds` can measure.
MIN_SEEDS = 3

#: The channels' weights in a colour difference: their contributions to luminance [Cline 2007].
COLOR_WEIGHTS = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class Errors:
    """The figures of one image. All except ``relmse_worst``, ``sigma_mu`` and ``flip`` are means
    over pixels and channels.

    Attributes:
        relmse: (I−R)² / (R² + ε), with ε = 10⁻² · mean(R)².
        relmse_trimmed: The same without the 0.1 % of pixels with the largest errors. It is much
            smaller than ``relmse`` if a few fireflies cause most of the error.
        relmse_worst: The 99th percentile of (I−R)² / (R² + ε) over the pixels (means over their
            channels), which measures the errors of the worst pixels.
        mse: (I−R)².
        rmse: √mse; NaN if ``mse`` is not positive after the subtraction.
        sigma_mu: σ/μ, the coefficient of variation: the root of the mean squared colour difference,
            divided by the mean luminance of the reference (Cline, *Sampling Methods in Ray-Based
            Global Illumination*, 2007, Eq. 4.13). NaN if that luminance is not positive.
        flip: The perceived difference, from 0 to 1, see :func:`~.flip.mean_flip`. NaN if it was not
            requested, or if ``flip-evaluator`` is not installed.
    """

    relmse: float
    relmse_trimmed: float
    relmse_worst: float
    mse: float
    rmse: float
    sigma_mu: float
    flip: float


def errors(
    image: np.ndarray,
    reference: np.ndarray,
    reference_variance: np.ndarray | None = None,
    flip: bool = True,
) -> Errors:
    """All figures of ``image``, see :class:`Errors`.

    Args:
        image: The image to measure.
        reference: The reference.
        reference_variance: Variance of ``reference``; ``None`` if unknown.
        flip: ``False`` skips FLIP, which takes more than 20 times as long as the others together
            (on two cores 0.3 s at 320x180, 10 s at 1920x1080).

    Raises:
        ValueError: The shapes differ, the reference is black, or a value is not finite.
    """
    squared, weight = _squared_and_weight(image, reference, reference_variance)
    # Trim the pixels with the largest errors before the variance is subtracted
    seen = (np.asarray(image, np.float64) - reference) ** 2 * weight
    return _errors(
        squared, weight, seen.mean(axis=2), _coefficient_of_variation(image, reference),
        mean_flip(image, reference) if flip else math.nan,
    )  # fmt: skip


def errors_between_seeds(images: Sequence[np.ndarray], scale: np.ndarray) -> list[Errors]:
    """The figures of images of one integrator that differ in their seeds, without a reference.

    For each image, the mean of the others takes its place, and the variance of this mean is
    subtracted: (n (I − M)² − V) / (n − 2), where M is the mean of all n images and V their
    variance. The mean of ``mse`` over the images is then the mean of V, which does not include
    bias. The trimmed relMSE omits the pixels with the largest V. FLIP is unknown, as are all
    figures of fewer than three images.

    Args:
        images: The images.
        scale: The image whose mean over 9x9 pixels is the R of relative errors. (In the mean of
            its own pixel, a firefly would reduce its own relative error.)
    """
    stack = np.asarray(images, np.float64)
    count = len(stack)
    if count < MIN_SEEDS or not np.any(scale):
        return [Errors(*[math.nan] * len(fields(Errors)))] * count
    mean, variance = stack.mean(axis=0), stack.var(axis=0, ddof=1)
    weight = _weight(np.stack([box_means(x) for x in np.moveaxis(scale, 2, 0)], axis=2))
    seen = (variance * weight).mean(axis=2)
    # Differences from the mean of all images, which includes the image itself, are too small
    correction = math.sqrt(count / (count - 1))
    return [
        _errors(
            (count * (image - mean) ** 2 - variance) / (count - 2), weight, seen,
            correction * _coefficient_of_variation(image, mean), math.nan,
        )
        for image in stack
    ]  # fmt: skip


def _errors(
    squared: np.ndarray, weight: np.ndarray, seen: np.ndarray, sigma_mu: float, flip: float
) -> Errors:
    """The figures of an image from its squared errors, and their weights in relative errors. The
    trimmed relMSE omits the pixels with the largest values of ``seen``."""
    mse = float(squared.mean())
    relative = (squared * weight).mean(axis=2)
    return Errors(
        relmse=float(relative.mean()),
        relmse_trimmed=_trimmed_mean(relative, seen),
        relmse_worst=float(np.percentile(relative, _WORST)),
        mse=mse,
        rmse=float(np.sqrt(mse)) if mse >= 0 else math.nan,
        sigma_mu=sigma_mu,
        flip=flip,
    )


def relative_mse(
    image: np.ndarray, reference: np.ndarray, reference_variance: np.ndarray | None = None
) -> float:
    """relMSE, see :class:`Errors`."""
    return errors(image, reference, reference_variance, flip=False).relmse


def reference_noise(reference: np.ndarray, reference_variance: np.ndarray) -> float:
    """The relMSE of the reference itself, as subtracted from every ``relmse``."""
    return float((np.asarray(reference_variance, np.float64) * _weight(reference)).mean())


def describe_non_finite(image: np.ndarray) -> str:
    """Says how many pixels hold NaN or infinity, and where the first one is; empty if none do."""
    bad = ~np.isfinite(image).all(axis=2)
    count = int(bad.sum())
    if count == 0:
        return ""
    y, x = np.argwhere(bad)[0]
    return f"{count} of {bad.size} pixels not finite (first at x={x}, y={y})"


def _squared_and_weight(
    image: np.ndarray, reference: np.ndarray, reference_variance: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    if image.shape != reference.shape:
        raise ValueError(f"an image of shape {image.shape} and a reference of {reference.shape}")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"an image of shape {image.shape}: expected (height, width, 3)")
    for name, values in (("image", image), ("reference", reference)):
        if fault := describe_non_finite(values):
            raise ValueError(f"{name}: {fault}")
    squared = (np.asarray(image, np.float64) - reference) ** 2
    if reference_variance is not None:
        if reference_variance.shape != reference.shape:
            raise ValueError(
                f"a reference of shape {reference.shape}, its variance {reference_variance.shape}"
            )
        squared = squared - reference_variance
    return squared, _weight(reference)


def _weight(reference: np.ndarray) -> np.ndarray:
    """1 / (R² + ε)."""
    reference = np.asarray(reference, np.float64)
    floor = RELATIVE_FLOOR * reference.mean() ** 2
    if floor == 0:
        raise ValueError("the reference is black: relative errors are undefined")
    return 1 / (reference**2 + floor)


def _coefficient_of_variation(image: np.ndarray, reference: np.ndarray) -> float:
    difference = np.abs(np.asarray(image, np.float64) - reference) @ COLOR_WEIGHTS  # Eq. 4.11
    variance = np.mean(difference**2)  # Eq. 4.12
    luminance = np.mean(np.asarray(reference, np.float64) @ COLOR_WEIGHTS)
    return float(np.sqrt(variance) / luminance) if luminance > 0 else math.nan  # Eq. 4.13


def _trimmed_mean(values: np.ndarray, seen: np.ndarray) -> float:
    dropped = int(np.ceil(TRIMMED_SHARE * seen.size)) if seen.size > 1 else 0
    kept = np.argsort(seen, axis=None, kind="stable")[: seen.size - dropped]
    return float(values.reshape(-1)[kept].mean())
