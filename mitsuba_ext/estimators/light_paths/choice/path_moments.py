"""The variance that other sets of techniques would have, estimated from samples of bidirectional
path tracing with all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from ....images.box_filter import box_means, squares_by_neighbours
from ....images.coarse_film import CoarseFilm
from ....transport.estimator import CameraRays, Sample
from ....transport.mis import power_heuristic
from ....util.arrays import add_own, channel_mean, from_numpy, to_host
from ..merging.merging import PHOTONS_PER_DISK
from ..merging.merging_in_media import PHOTONS_PER_SAMPLE
from ..partial_sums import CompetingDensities
from .candidate_moments import GROUPS, CandidateMoments, add_to
from .candidates import Available, Candidate, candidates
from .rare_contributions import BINS, Rare, error_of_render, rare
from .technique_observer import TechniqueObserver

#: The approximate largest number of blocks of pixels for which there are sums by value.
_BLOCKS = 1 << 14

#: The vertices that MIS weights count as one sample of merging, on surfaces and in media.
_PER_SAMPLE = PHOTONS_PER_DISK, PHOTONS_PER_SAMPLE


@dataclass
class Counts:
    """What takes time in the samples of all techniques.

    Attributes:
        camera_rays, light_rays: Rays that continue camera paths, and rays that continue light
            paths.
        tested: Shadow rays to lights, of camera paths.
        connected: Shadow rays between vertices of camera paths and of light paths.
        looked: Vertices, and rows of cells, that were looked at for merging.
    """

    camera_rays: int = 0
    tested: int = 0
    light_rays: int = 0
    connected: int = 0
    looked: int = 0

    def add(self, *counts: int) -> None:
        """Adds ``counts`` to the fields, in their order."""
        for field, count in zip(fields(self), counts):
            setattr(self, field.name, getattr(self, field.name) + count)


@dataclass(frozen=True)
class Estimate:
    """Estimates of mean and variance for each pixel, [pixel] each.

    Attributes:
        mean: Radiance.
        variances: Variance of one sample of each pixel, for each candidate. They may be negative if
            there are few samples.
        by_value: Light and second moment of one sample, by the value of contributions (see
            :func:`rare`), [candidate, block, bin, 2].
        by_group: The second moment of one sample, as groups of paths have found it, [candidate,
            group, block].
        blocks: The film whose pixels are the blocks of ``by_value`` and ``by_group``.
    """

    mean: np.ndarray
    variances: list[np.ndarray]
    by_value: np.ndarray
    by_group: np.ndarray
    blocks: CoarseFilm

    def errors_of_render(
        self, scale: np.ndarray, spp: float, shares: Sequence[float]
    ) -> list[tuple[list[np.ndarray], np.ndarray]]:
        """For each of ``shares`` and each candidate, :func:`error_of_render` without the
        contributions that are :func:`rare`; and the share of the light that these make up.

        Parameters:
            scale: 1 / radiance of each pixel.
            spp: Samples per pixel of the render.
            shares: Parts of the pixels that may hold rare contributions.
        """
        of_pixel, width = self.blocks.of_pixel, self.blocks.width
        scale = self._of_blocks(scale)
        errors: list[list[np.ndarray]] = [[] for _ in shares]
        missed: list[list[float]] = [[] for _ in shares]
        whole = max(self.mean.sum(), 1e-30)
        for variance, found in zip(self.variances, self.by_value):
            for i, lacks in enumerate(rare(found, scale, width, spp, shares)):
                if of_pixel is not None:
                    lacks = Rare(*(x[of_pixel] for x in lacks))
                errors[i].append(error_of_render(variance, self.mean, lacks, spp))
                missed[i].append(lacks.light.sum() / whole)
        return [(some, np.array(share)) for some, share in zip(errors, missed)]

    def moments_of_groups(self, scale: np.ndarray) -> np.ndarray:
        """The second moments that groups of paths have found in the whole image, relative to the
        squared radiance of the pixels, [candidate, group]. ``scale``: see
        :meth:`errors_of_render`."""
        sizes = 1 if self.blocks.of_pixel is None else np.bincount(self.blocks.of_pixel)
        return self.by_group @ (self._of_blocks(scale) ** 2 * sizes)

    def _of_blocks(self, scale: np.ndarray) -> np.ndarray:
        """1 / radiance of each block."""
        of_pixel = self.blocks.of_pixel
        if of_pixel is None:
            return scale
        return np.bincount(of_pixel) / np.bincount(of_pixel, 1 / scale)

    def never_found(self) -> np.ndarray:
        """For each candidate, the share of the light of paths that it cannot find."""
        return self.by_value[:, :, -1, 0].sum(axis=1) / max(self.by_value[1, :, :, 0].sum(), 1e-30)


class PathMoments(TechniqueObserver):
    """Estimates the variance of each candidate from the samples of all techniques.

    Light that camera paths find rarely is hardly ever in their samples. Their sample variance would
    therefore be too small where the true variance is largest. But the second moment of ``path`` is
    an integral over paths, and light paths find these often. Let ``path`` find a path of
    contribution f with the densities q₀ and q₁ (s = 0 and 1). With the power heuristic, the second
    moment of ``path`` is the integral of f² (q₀³ + q₁³) / (q₀² + q₁²)². A technique of density p
    that finds such a path adds the integrand / p, times its MIS weight, to the estimate of this
    integral. Products of the contributions at different vertices of a camera path, and squared
    means, are estimated from camera paths alone.

    The variance of another candidate is the variance of all techniques together, plus the
    difference between the second moments (:class:`CandidateMoments`). Where there are fewer light
    paths, camera paths bring more of the light: their squared mean, and products of their
    contributions, grow as the square of their share.

    Several connections of a vertex are independent given the camera path. The mean of their
    products is the square of what one is expected to bring to that vertex. Single connections do
    not show it; it is estimated as the squared mean over a pixel's first vertices. This estimate is
    too small because it leaves out later vertices, and the contrast within a pixel. (It is 0.65 to
    0.95 of the true value in veach-bidir, many_lamps, glass_lamp, kitchen, cornell_box and rooms,
    and 0.1 in corridor and keyhole, where products are a hundredth of the squares.)

    Source: P. Grittmann, I. Georgiev, P. Slusallek, *Efficiency-Aware Multiple Importance Sampling
    for Bidirectional Rendering Algorithms*, ACM TOG 41(4), 2022 (second moments of one set of
    techniques from samples of another).

    The samples may belong to a coarse film, whose pixels are rectangles of pixels: all arrays then
    have one entry for each of these rectangles.

    Parameters:
        coarse: The film.
        corner: The first of its sampled pixels, on the sensor's film.
        film_width: Number of sampled pixels in a row of the sensor's film.
        spp: Samples per pixel of the render.

    Attributes:
        candidates: See :func:`candidates`. The samples are taken with the second one.
        samples: Number of camera samples.
        counts: What takes time (:class:`Counts`).
    """

    compares = can_be_frozen = True

    def __init__(
        self, coarse: CoarseFilm, corner: tuple[int, int], film_width: int, spp: int
    ) -> None:
        self._spp, self._film_pixels = spp, coarse.pixel_count
        #: How many samples of a pixel find the same vertex of a light path, and c of merging, if
        #: merging adds its own term: on surfaces, and in media
        self._shared = 1.0, 1.0
        self._own: list[mi.Float | None] = [None, None]
        self._width, self._pixels = coarse.width, coarse.width * coarse.height
        self._corner, self._film_width = mi.Vector2f(corner), film_width
        self._of_pixel: mi.UInt32 | None = None
        if coarse.of_pixel is not None:
            self._of_pixel = from_numpy(mi.UInt32, coarse.of_pixel)
        # Of a film with many pixels
        self._blocks = CoarseFilm.of(coarse.width, coarse.height, 2 * _BLOCKS)
        self._block_of: mi.UInt32 | None = None
        if self._blocks.of_pixel is not None:
            self._block_of = from_numpy(mi.UInt32, self._blocks.of_pixel)
        self.candidates: list[Candidate] = []
        self.samples = 0
        self.counts = Counts()
        # For each pixel: number of samples; sums of the samples' values, of their squares, and of
        # products of what ``path`` finds at different vertices; sums of splats, and of their
        # squares, and of connections of first vertices
        self._sums = np.zeros((7, self._pixels))
        # The squares of what was merged on surfaces, and in media
        self._squares_merged = np.zeros((2, self._pixels))
        # The second moment and the light image of each candidate
        self._found = np.zeros((0, self._pixels, 2))
        self._by_value = np.zeros((0, self._block_count, BINS, 2))
        self._by_group = np.zeros((0, GROUPS, self._block_count))
        # In scenes with media, for each candidate that merges: what photons bring to camera paths,
        # and products of the photons of a camera path, [candidate, 2, pixel]
        self._photons: np.ndarray | None = None

    # ---- Observer ----

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``). What ``weighed`` and
        ``found_by`` remember is part of the kernel itself."""
        return (
            self._pixel, self._importance, self._lane, self._path, self._squares, self._merged,
            self._joined, self._shadow_count, self._looked, self._splats, self._moments,
            self._of_pixel, self._corner, self._film_width, self._own,
        )  # fmt: skip

    def start(self, rays: CameraRays, available: Available) -> None:
        if not self.candidates:
            self.candidates = candidates(available)
            count = len(self.candidates)
            self._found = np.zeros((count, self._pixels, 2), np.float32)
            self._by_value = np.zeros((count, self._block_count, BINS, 2), np.float32)
            self._by_group = np.zeros((count, GROUPS, self._block_count), np.float32)
            self._shared = available.samples_per_vertex(self._spp, self._film_pixels)
        # MIS weights count these vertices as one sample, but the samples of a pixel share vertices
        merging = [x / y for x, y in zip(self._shared, _PER_SAMPLE)]
        in_media = available.merges_in_media
        self._own = [dr.opaque(mi.Float, x) if in_media else None for x in merging]
        self._pixel, self._importance = self._place(rays.pixel), rays.importance
        lanes = dr.width(rays.pixel)
        self._lane = dr.arange(mi.UInt32, lanes)
        # For each camera path: its value with the techniques of ``path`` alone, and the squares of
        # the terms of this sum
        self._path, self._squares = (dr.zeros(mi.Float, lanes) for _ in range(2))
        # The squares of what was merged, and the connections of the first vertex
        self._merged = [dr.zeros(mi.Float, lanes) for _ in range(1 + in_media)]
        self._joined = dr.zeros(mi.Float, lanes)
        self._shadow_count, self._looked = (dr.zeros(mi.UInt32, lanes) for _ in range(2))
        self._splats = dr.zeros(mi.Float, 2 * self._pixels)
        self._moments = CandidateMoments(
            self.candidates, self._pixels, None if in_media else merging[0],
            lanes, self._block_count, self._block_of,
        )
        dr.eval(
            self._path, self._squares, self._merged, self._joined, self._shadow_count,
            self._looked, self._splats, self._importance,
        )  # fmt: skip
        self._by_kind, self._light_path = mi.Vector2f(0), self._lane

    def weighed(self, by_kind: mi.Vector2f) -> None:
        self._by_kind = by_kind

    def found_by(self, light_path: mi.UInt32) -> None:
        self._light_path = light_path

    def searched(self, count: mi.UInt32) -> None:
        add_own(self._looked, count, self._lane)

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
        add_own(self._shadow_count, mi.UInt32(1), self._lane, tested)

    def _add_own(self, brought, mis, other, active) -> None:
        """Adds a contribution that ``path`` finds too, by BSDF sampling or by next event
        estimation. ``other`` is the density of the other technique of these two, divided by the
        density of the one that found it."""
        active = active & (mis > 0)
        whole = brought / mis
        part = whole * power_heuristic(mi.Float(1), other)
        add_own(self._path, part, self._lane, active)
        add_own(self._squares, dr.square(part), self._lane, active)
        competing = CompetingDensities(mi.Vector2f(1, other), self._by_kind)
        self._moments.add(brought, mis, competing, self._pixel, self._lane, active)

    def joined(self, s, t, value, mis, competing, active) -> None:
        own = CompetingDensities(competing.by_camera, competing.by_kind + mi.Vector2f(1, 0))
        self._add_other(value, mis, own, active, is_joined=True)
        is_found = active & (t == 2) & dr.isfinite(mis)
        add_own(self._joined, self._brightness(value), self._lane, is_found)

    def merged(self, value, mis, competing, active, in_medium=False) -> None:
        self._add_other(
            value, mis, competing, active, _PER_SAMPLE[in_medium], merging=self._own[in_medium]
        )
        square = dr.square(self._brightness(value))
        add_own(self._merged[in_medium], square, self._lane, active & dr.isfinite(square))

    def _add_other(
        self, value, mis, competing, active, count: float = 1.0, is_joined: bool = False,
        merging: mi.Float | None = None,
    ) -> None:  # fmt: skip
        """Adds what the camera path in each lane found together with a light path. ``competing``
        holds the technique itself. MIS weights count ``count`` such contributions as one
        sample."""
        brought = self._brightness(value)
        active = active & (brought > 0)
        self._moments.add(
            brought, mis, competing, self._pixel, self._light_path, active, count, is_joined,
            merging, self._lane,
        )  # fmt: skip

    def splatted(self, s, position, value, mis, competing, active) -> None:
        brought = channel_mean(value)
        active = active & (brought > 0)
        place = mi.Point2u(position - self._corner)
        pixel = self._place(place.y * self._film_width + place.x, active)
        add_to(self._splats, brought, 2 * pixel, active)
        add_to(self._splats, dr.square(brought), 2 * pixel + 1, active)
        own = CompetingDensities(competing.by_camera, competing.by_kind + mi.Vector2f(0, 1))
        self._moments.add(brought, mis, own, pixel, self._light_path, active)

    def _place(self, pixel: mi.UInt32, active: mi.Bool | bool = True) -> mi.UInt32:
        """The place of a pixel in the arrays."""
        if self._of_pixel is None:
            return pixel
        return dr.gather(mi.UInt32, self._of_pixel, pixel, active)

    def _brightness(self, value: mi.Spectrum) -> mi.Float:
        return channel_mean(value * self._importance)

    def traced(self, camera: Sample, whole: Sample) -> None:
        brought = self._brightness(camera.L)
        # The whole sample, since the film reads it too
        dr.eval(camera, brought)
        pixel, values, by_path, squares, *others = to_host(
            self._pixel, brought, self._path, self._squares, *self._merged, self._joined,
            self._shadow_count, self._looked, camera.scatter_count, camera.shadow_count,
            whole.scatter_count,
        )  # fmt: skip
        kinds = len(self._merged)
        merged, joined, counts = others[:kinds], others[kinds], others[kinds + 1 :]

        def per_pixel(values: np.ndarray) -> np.ndarray:
            # NumPy adds in a fixed order: equal seeds give equal sums
            values = np.where(np.isfinite(values), values, 0).astype(np.float64)
            return np.bincount(pixel, values, self._pixels)

        values, by_path = values.astype(np.float64), by_path.astype(np.float64)
        splats = self._splats.numpy().astype(np.float64).reshape(self._pixels, 2)
        self._sums += (
            np.bincount(pixel, minlength=self._pixels), per_pixel(values), per_pixel(values**2),
            per_pixel(by_path**2 - squares), splats[:, 0], splats[:, 1], per_pixel(joined),
        )  # fmt: skip
        self._squares_merged[: len(merged)] += [per_pixel(x) for x in merged]
        photons = self._moments.merged(len(pixel))
        photons = np.array([
            (per_pixel(x[:, 0]), per_pixel(x[:, 0] ** 2 - x[:, 1])) for x in photons
        ])  # fmt: skip
        self._photons = photons if self._photons is None else self._photons + photons
        found, by_value = self._moments.taken()
        self._found += found
        self._by_value += by_value
        self._by_group += self._moments.by_group()
        lanes = len(pixel)
        self.samples += lanes
        tested, looked, scattered, all_tested, all_scattered = (
            int(count.sum(dtype=np.uint64)) for count in counts
        )
        self.counts.add(
            lanes + scattered, tested, lanes + all_scattered - scattered, all_tested - tested,
            looked,
        )  # fmt: skip

    # ---- After the passes ----

    def estimate(self) -> Estimate:
        """The estimate from all passes."""
        n, x, x2, own_products, splats, splats2, joined = self._sums
        n = np.maximum(n, 1)
        # The unbiased estimate: with few samples, the square of the sample mean is too large, by
        # the variance of the mean. With one, the mean is taken over the pixel's neighbours
        alone = np.maximum(x2 - self._smooth(x) ** 2, 0)
        of_camera = np.where(n > 1, (x2 - x**2 / n) / np.maximum(n - 1, 1), alone)
        # Few of all light paths splat to a pixel: the sum of their squares is about their variance.
        # The same holds for merging, except that some samples of a pixel find the same vertex
        of_pass = np.subtract(self._shared, 1) @ self._squares_merged
        everything = of_camera + (splats2 + of_pass) / n
        mean = (x + splats) / n
        squared_mean = np.where(n > 1, mean**2 - everything / n, self._smooth(mean) ** 2)
        moments, images = np.moveaxis(self._found, 2, 0)
        # What camera paths bring, with each candidate, and products of such contributions
        brought = [self._smooth(mean - image / n) for image in images]
        products = everything - moments[1] / n + brought[1] ** 2
        ratios = [x / np.maximum(brought[1], 1e-30) for x in brought]
        # Products of two connections of the same vertex, and their share of the square of a mean
        of_first = squares_by_neighbours((joined / n).reshape(-1, self._width)).ravel()
        pairs = [1 - 1 / max(c.connections, 1) for c in self.candidates]
        excess = self._excess_of_photons(n)
        variances = [
            m / n + (products - excess[1] + share * of_first) * ratio**2 + e - x**2
            for m, x, ratio, share, e in zip(moments, brought, ratios, pairs, excess)
        ]
        variances[0] = (moments[0] + own_products) / n - squared_mean
        block = np.arange(self._pixels) if self._block_of is None else self._blocks.of_pixel
        samples = np.bincount(block, n).astype(np.float32)
        self._by_value /= samples[:, None, None]
        self._by_group /= samples
        return Estimate(mean, variances, self._by_value, self._by_group, self._blocks)

    def _excess_of_photons(self, n: np.ndarray) -> list[np.ndarray | float]:
        """For each candidate: by how much products of what photons bring to a camera path exceed
        the square of their mean."""
        excess: list[np.ndarray | float] = [0.0] * len(self.candidates)
        merging = [i for i, candidate in enumerate(self.candidates) if candidate.merges]
        for i, (brought, products) in zip(merging, self._photons):
            squares = squares_by_neighbours((brought / n).reshape(-1, self._width)).ravel()
            excess[i] = products / n - squares
        return excess

    @property
    def _block_count(self) -> int:
        return self._blocks.width * self._blocks.height

    def _smooth(self, values: np.ndarray) -> np.ndarray:
        return box_means(values.reshape(-1, self._width)).ravel()
