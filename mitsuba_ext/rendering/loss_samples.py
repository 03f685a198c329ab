"""More samples for gradients in the pixels on which the loss depends most."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.box_filter import box_sums
from ..util.arrays import from_numpy
from .camera import PixelLanes, film_extent
from .filter_weights import mean_weights
from .gradient_pass import GradientSamples

#: The share of the samples that is the same for all pixels on which the loss depends. If each of
#: these pixels is certain to be sampled (from three samples per pixel on), none has more than twice
#: its variance with even samples, except for rounding to whole groups.
_EVEN = 0.5


def loss_samples(
    sensor: mi.Sensor, spp: int, grad_in: mi.TensorXf, seed: int, sensitivity: np.ndarray
) -> GradientSamples:
    """Samples for a pass that computes gradients. A pixel gets half of its samples in proportion to
    what a sample contributes to gradients, which is the derivative of the loss with respect to the
    pixel's value times the derivative of the sample. The other half is even, but there are no
    samples where none has an effect. Each sample is weighted by the inverse of the number of
    samples that its pixel has, or is expected to have, so that the expected gradient does not
    change.

    A pixel gets its samples in groups of at most half of ``spp``, so that each pixel that has an
    effect gets a group. With one or two samples per pixel, a group is all of them, and some pixels
    get none.

    Parameters:
        sensor: The sensor, whose film is prepared.
        spp: Samples per pixel, on average.
        grad_in: The derivative of the loss with respect to the image.
        seed: Places the groups.
        sensitivity: About the mean derivative of a sample of each pixel, shape [y, x] in the film's
            extent.
    """
    film = sensor.film()
    share = _shares(film, grad_in, sensitivity)
    # Even groups hold whole pairs (``mirrored_directions.py``)
    size = spp // 2 if spp % 4 == 0 else math.gcd(spp, 2)
    number = share.size * spp // size
    places = (np.arange(number) + np.random.default_rng(seed).random()) / number
    pixels = np.searchsorted(np.cumsum(share), places * share.sum(), side="right")
    pixels = np.minimum(pixels, np.flatnonzero(share)[-1])
    # A pixel that is certain to be sampled has the mean of its groups, whatever their number
    counts = np.bincount(pixels, minlength=share.size)
    expected = share / share.sum() * number
    weights = spp / size / np.where(expected < 1, expected, counts)[pixels]
    group = dr.arange(mi.UInt32, number * size) // dr.opaque(mi.UInt32, size)
    lanes = PixelLanes(dr.gather(mi.UInt32, from_numpy(mi.UInt32, pixels), group))
    # The film divides by the mean sums of weights: where samples are few, sums vary too much
    sums = mean_weights(film)[..., None] * spp
    sums = np.repeat(sums, film.create_block().channel_count(), axis=2)
    return GradientSamples(
        lanes, spp, dr.gather(mi.Float, from_numpy(mi.Float, weights), group),
        mi.TensorXf(sums.astype(np.float32)),
    )  # fmt: skip


def _shares(film: mi.Film, grad_in: mi.TensorXf, sensitivity: np.ndarray) -> np.ndarray:
    """The share of the samples of each pixel, row by row in the film's extent."""
    derivative = np.abs(np.array(grad_in, np.float64)).sum(axis=2)
    derivative[~np.isfinite(derivative)] = 0  # no gradient there, as with "prb"
    # A sample has an effect on all pixels that the filter reaches
    border = (film_extent(film)[0] - derivative.shape[1]) // 2
    derivative = np.pad(derivative, border)
    reach = 0 if film.rfilter().is_box_filter() else film.rfilter().border_size()
    has_effect = box_sums((derivative > 0).astype(np.int64), reach) > 0
    if not has_effect.any():
        return np.full(derivative.size, 1 / derivative.size)
    even = has_effect / has_effect.sum()
    share = np.where(has_effect, np.maximum(box_sums(derivative, reach), 0), 0) * sensitivity
    total = share.sum()
    if not 0 < total < np.inf:
        return even.ravel()
    return ((1 - _EVEN) * share / total + _EVEN * even).ravel()
