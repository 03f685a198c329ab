"""More samples for gradients in the pixels on which the loss depends most."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.box_filter import box_sums
from ..transport.decisions import CameraSamples
from ..transport.estimator import CameraRays, Sample
from ..util.arrays import from_numpy
from .camera import PixelLanes, camera_rays, draw_numbers, film_extent, put
from .filter_weights import mean_weights

#: The share of the samples that is the same for all pixels on which the loss depends.
_EVEN = 0.25


class LossSamples:
    """Camera rays for a pass that computes gradients. A pixel gets samples in proportion to the
    derivative of the loss with respect to its value (and a quarter of them evenly), and none where
    no sample has an effect. Each sample is weighted by the inverse of the number of samples that
    its pixel has, or is expected to have, so that the expected gradient does not change.

    A pixel gets its samples in groups of ``spp``, so that structured samplers stay stratified.

    Parameters:
        sensor: The sensor, whose film is prepared.
        sampler: Seeded for ``spp`` samples of each pixel.
        spp: Samples per pixel, on average.
        grad_in: The derivative of the loss with respect to the image.
        seed: Places the groups.
    """

    def __init__(
        self, sensor: mi.Sensor, sampler: mi.Sampler, spp: int, grad_in: mi.TensorXf, seed: int
    ) -> None:
        self._film, self._spp, self._grad = sensor.film(), spp, grad_in
        share = _shares(self._film, grad_in)
        places = (np.arange(share.size) + np.random.default_rng(seed).random()) / share.size
        pixels = np.searchsorted(np.cumsum(share), places * share.sum(), side="right")
        pixels = np.minimum(pixels, np.flatnonzero(share)[-1])
        # A pixel that is certain to be sampled has the mean of its groups, whatever their number
        counts = np.bincount(pixels, minlength=share.size)
        expected = share / share.sum() * share.size
        weights = 1 / np.where(expected < 1, expected, counts)[pixels]

        group = dr.arange(mi.UInt32, len(pixels) * spp) // dr.opaque(mi.UInt32, spp)
        lanes = PixelLanes(dr.gather(mi.UInt32, from_numpy(mi.UInt32, pixels), group))
        numbers = draw_numbers(sensor, sampler, None, CameraSamples())
        self.rays: CameraRays = camera_rays(sensor, lanes.lanes(self._film), numbers, spp)
        self._weight = dr.gather(mi.Float, from_numpy(mi.Float, weights), group)

    def derivatives(self) -> mi.Spectrum:
        """The derivative of the loss with respect to the radiance of each sample."""
        of_film, rays = self._derivatives_of_film(), self.rays
        with dr.resume_grad():
            L = dr.full(mi.Spectrum, 1, dr.width(self._weight))
            dr.enable_grad(L)
            block = self._film.create_block()
            block.set_coalesce(block.coalesce() and self._spp >= 4)
            put(self._film, block, rays, Sample(L, mi.Bool(True)), [], self._weight)
            _propagate(block.tensor(), of_film)
            return dr.grad(L)

    def _derivatives_of_film(self) -> mi.TensorXf:
        """The derivative of the loss with respect to the sums of the film, which it divides by the
        filter weights. Here these are their means: where samples are few, they vary too much."""
        film = self._film
        weights = mean_weights(film)[..., None] * self._spp
        weights = np.repeat(weights, film.create_block().channel_count(), axis=2)
        with dr.resume_grad():
            sums = mi.TensorXf(weights.astype(np.float32))
            dr.enable_grad(sums)
            film.put_block(mi.ImageBlock(sums, offset=film.crop_offset()))
            _propagate(film.develop(), self._grad)
            film.clear()
            return dr.grad(sums)


def _propagate(result: mi.TensorXf, derivative: mi.TensorXf) -> None:
    dr.set_grad(result, derivative)
    dr.enqueue(dr.ADMode.Backward, result)
    dr.traverse(dr.ADMode.Backward)


def _shares(film: mi.Film, grad_in: mi.TensorXf) -> np.ndarray:
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
    share = np.where(has_effect, np.maximum(box_sums(derivative, reach), 0), 0)
    share = (1 - _EVEN) * share / share.sum() + _EVEN * has_effect / has_effect.sum()
    return share.ravel()
