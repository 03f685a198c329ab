"""The variance that ``path`` would have, estimated from samples of bidirectional path tracing."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.estimator import CameraRays, Sample
from ..transport.mis import power_heuristic
from .technique_observer import TechniqueObserver


class Estimate(NamedTuple):
    """Estimates of mean and variance for each pixel, [pixel] each.

    Attributes:
        mean: Radiance.
        bidirectional, by_camera: Variance of one sample of each pixel, with all techniques, and
            with those of ``path`` alone. They may be negative if there are few samples.
    """

    mean: np.ndarray
    bidirectional: np.ndarray
    by_camera: np.ndarray


class PathMoments(TechniqueObserver):
    """Estimates the variance of ``path`` from the samples of all techniques.

    Light that camera paths find rarely is hardly ever in their samples. Their sample variance would
    therefore be too small where the true variance is largest. But the second moment of ``path`` is
    an integral over paths, and light paths find these often. Let ``path`` find a path of
    contribution f with the densities q₀ and q₁ (s = 0 and 1). With the power heuristic, the second
    moment of ``path`` is the integral of f² (q₀³ + q₁³) / (q₀² + q₁²)². A technique of density p
    that finds such a path adds the integrand / p, times its MIS weight, to the estimate of this
    integral. Products of the contributions at different vertices of a camera path, and squared
    means, are estimated from camera paths alone.

    Source: P. Grittmann, I. Georgiev, P. Slusallek, *Efficiency-Aware Multiple Importance Sampling
    for Bidirectional Rendering Algorithms*, ACM TOG 41(4), 2022 (second moments of one set of
    techniques from samples of another).

    Parameters:
        film: Film of the sensor.
        width, height: Its sampled pixels.

    Attributes:
        samples: Number of camera samples.
        unreachable: Number of samples of paths that ``path`` cannot find.
        rays: Rays traced for all techniques, and for those of ``path``.
    """

    compares_with_camera = True

    def __init__(self, film: mi.Film, width: int, height: int) -> None:
        self._width, self._pixels = width, width * height
        self._offset = mi.Vector2f(mi.ScalarVector2f(film.crop_offset()))
        self.samples = self.unreachable = 0
        self.rays = np.zeros(2)
        # For each pixel: number of samples; sums of the samples' values, of their squares, and of
        # the second moment of ``path``; sums of splats, and of their squares
        self._sums = np.zeros((6, self._pixels))

    # ---- Observer ----

    def start(self, rays: CameraRays) -> None:
        self._pixel, self._importance = rays.pixel, rays.importance
        lanes = dr.width(rays.pixel)
        self._lane = dr.arange(mi.UInt32, lanes)
        # For each camera path: its value with the techniques of ``path`` alone, the squares of the
        # terms of this sum, and the second moment
        self._path, self._squares, self._moment = (dr.zeros(mi.Float, lanes) for _ in range(3))
        self._shadow_count = dr.zeros(mi.UInt32, lanes)
        self._missed = dr.zeros(mi.UInt32, 1)
        self._splats = dr.zeros(mi.Float, 3 * self._pixels)
        dr.eval(
            self._path, self._squares, self._moment, self._shadow_count, self._missed,
            self._splats, self._importance,
        )  # fmt: skip

    def emission(self, path, ds, value, mis, pdf, active) -> None:
        brought = self._brightness(value)
        found = path.arrival.pdf
        other = dr.select(path.arrival.is_delta | (path.depth == 0), 0, pdf / found)
        self._add_own(brought, mis, other, active)

    def connection(
        self, choice, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        brought = self._brightness(value)
        whole = self._brightness(vertex.path.β * contribution)
        mis = dr.select(whole > 0, brought / whole, 0)
        other = dr.select(ds.delta, 0, pdf / ds.pdf)
        self._add_own(brought, mis, other, visible)
        dr.scatter_add(self._shadow_count, mi.UInt32(1), self._lane, tested)

    def _add_own(self, brought, mis, other, active) -> None:
        """Adds a contribution that ``path`` finds too, by BSDF sampling or by next event
        estimation. ``other`` is the density of the other of these two, divided by that of the one
        that found it."""
        active = active & (mis > 0)
        whole = brought / mis
        part = whole * power_heuristic(mi.Float(1), other)
        dr.scatter_add(self._path, part, self._lane, active)
        dr.scatter_add(self._squares, dr.square(part), self._lane, active)
        moment = brought * whole * _share(mi.Vector2f(1, other))
        dr.scatter_add(self._moment, moment, self._lane, active)

    def joined(self, s, t, value, mis, by_camera, active) -> None:
        brought = self._brightness(value)
        active = active & (brought > 0)
        moment = self._seen_by_path(dr.square(brought) / mis, by_camera, active)
        dr.scatter_add(self._moment, moment, self._lane, active)

    def splatted(self, s, position, value, mis, by_camera, active) -> None:
        brought = dr.mean(value)
        active = active & (brought > 0)
        place = mi.Point2u(position - self._offset)
        pixel = 3 * (place.y * self._width + place.x)
        moment = self._seen_by_path(dr.square(brought) / mis, by_camera, active)
        dr.scatter_add(self._splats, brought, pixel, active)
        dr.scatter_add(self._splats, dr.square(brought), pixel + 1, active)
        dr.scatter_add(self._splats, moment, pixel + 2, active)

    def _seen_by_path(self, square, by_camera, active) -> mi.Float:
        can_be = dr.max(by_camera) > 0
        dr.scatter_add(self._missed, mi.UInt32(1), mi.UInt32(0), active & ~can_be)
        return dr.select(can_be, square * _share(by_camera), 0)

    def _brightness(self, value: mi.Spectrum) -> mi.Float:
        return dr.mean(value * self._importance)

    def traced(self, camera: Sample, whole: Sample) -> None:
        brought = self._brightness(camera.L)
        # The whole sample, since the film reads it too
        dr.eval(camera, brought)
        pixel = self._pixel.numpy()

        def per_pixel(values: np.ndarray) -> np.ndarray:
            # NumPy adds in a fixed order: equal seeds give equal sums
            values = np.where(np.isfinite(values), values, 0).astype(np.float64)
            return np.bincount(pixel, values, self._pixels)

        values = brought.numpy().astype(np.float64)
        by_path = self._path.numpy().astype(np.float64)
        moment = self._moment.numpy() + by_path**2 - self._squares.numpy()
        splats = self._splats.numpy().astype(np.float64).reshape(self._pixels, 3)
        self._sums += (
            np.bincount(pixel, minlength=self._pixels), per_pixel(values), per_pixel(values**2),
            per_pixel(moment) + splats[:, 2], splats[:, 0], splats[:, 1],
        )  # fmt: skip
        self.unreachable += int(self._missed[0])
        lanes = len(pixel)
        self.samples += lanes
        tested = int(dr.sum(self._shadow_count)[0])
        self.rays += (
            2 * lanes + _total(whole.scatter_count) + _total(whole.shadow_count),
            lanes + _total(camera.scatter_count) + tested,
        )

    # ---- After the passes ----

    def estimate(self) -> Estimate:
        """The estimate from all passes."""
        n, x, x2, moment, splats, splats2 = self._sums
        n = np.maximum(n, 1)
        # The unbiased estimate: with few samples, the square of the sample mean is too large, by
        # the variance of the mean
        of_camera = np.where(n > 1, (x2 - x**2 / n) / np.maximum(n - 1, 1), x2)
        # Few of all light paths splat to a pixel: the sum of their squares is about their variance
        bidirectional = of_camera + splats2 / n
        mean = (x + splats) / n
        squared_mean = np.where(n > 1, mean**2 - bidirectional / n, 0)
        return Estimate(mean, bidirectional, moment / n - squared_mean)


def _share(q: mi.Vector2f) -> mi.Float:
    """(q₀³ + q₁³) / (q₀² + q₁²)²."""
    larger = dr.max(q)
    r = dr.min(q) / larger
    return (1 + r**3) / dr.square(1 + dr.square(r)) / larger


def _total(count: mi.UInt32) -> int:
    return int(dr.sum(mi.UInt64(count))[0])
