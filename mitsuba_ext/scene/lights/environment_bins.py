"""Divides the directions of an environment emitter into bins."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON, alias_tables
from .environment_texels import EnvironmentTexels

#: The numbers of bins along the azimuth and along the polar angle.
BINS = (32, 16)


class EnvironmentBins:
    """Samples directions in rectangular bins of latitude and longitude.

    Inside a bin, a texel is chosen by its brightness, and a point in it by the bilinear function
    with which Mitsuba's ``envmap`` interpolates. For maps, the density in a bin is therefore
    proportional to the emission. The sun of a ``sunsky`` is a last bin, cut out of the others.

    Parameters:
        scene: The scene with the environment emitter.

    Attributes:
        count (int): Number of bins.
        pointer (mi.EmitterPtr): The emitter.
        share (numpy.ndarray): The fraction of the emitted brightness in each bin; shape [count].
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._texels = EnvironmentTexels(scene)
        self._sun = self._texels.sun
        self._columns, self._rows = self._texels.columns, self._texels.rows
        self.pointer = self._texels.directions.pointer
        self._build(self._texels.corners())

    def _build(self, corners: np.ndarray) -> None:
        columns, rows = self._columns, self._rows
        self._bins = min(BINS[0], columns), min(BINS[1], rows)
        count = self._bins[0] * self._bins[1]
        # The weight of a texel is the mean of its corners
        weight = corners.mean(axis=1)
        bin = (
            (np.arange(rows) * self._bins[1] // rows)[:, None] * self._bins[0]
            + np.arange(columns) * self._bins[0] // columns
        ).ravel()
        bin_weight = np.bincount(bin, weight, count)
        emitted = bin_weight * self._texels.area / (columns * rows)
        if self._sun is not None:
            emitted = np.append(emitted, self._texels.sun_emission())
        self.count = len(emitted)
        self.share = emitted / emitted.sum()
        # Densities on the sphere, without the factor 1 / sin θ
        corners = corners * (columns * rows / self._texels.area / bin_weight)[bin][:, None]
        self._corners = from_numpy(mi.Float, corners)

        order = np.argsort(bin.astype(np.uint16), kind="stable")
        size = np.bincount(bin, minlength=count)
        end = np.cumsum(size)
        of = bin[order]
        threshold, alias = alias_tables(
            mi.Float64((weight * size[bin] / bin_weight[bin])[order]),
            from_numpy(mi.UInt32, (end - size)[of]),
            from_numpy(mi.UInt32, (end - 1)[of]),
            int(size.max()),
        )
        entries = np.empty((len(order), 2), dtype=np.uint32)
        entries[order, 0] = threshold.numpy().view(np.uint32)
        entries[order, 1] = order[alias.numpy()]
        self._entries = from_numpy(mi.UInt32, entries)

    @property
    def diameter(self) -> float:
        """A bound of the distance between two directions of a bin."""
        angle = math.hypot(2 * math.pi / self._bins[0], math.pi / self._bins[1])
        return min(2.0, angle)

    def sample(
        self, bin: mi.UInt32, ref: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Samples a direction in ``bin``.

        Returns:
            The direction sample, whose ``pdf`` is conditional on the bin, and its radiance / pdf,
            before any visibility test.
        """
        if self._sun is not None:
            in_sun = bin == self.count - 1
            bin = dr.minimum(bin, self.count - 2)  # valid, but unused in the sun
        texel, point = self._texel(bin, sample, active)
        point, density = mi.warp.square_to_bilinear(*self._corner_values(texel, active), point)
        d, sin_theta, uv = self._texels.direction(texel, point)
        pdf = density / sin_theta
        if self._sun is not None:
            d = dr.select(in_sun, self._sun.sample(sample), d)
            # Samples of other bins in the sun's disk get density 0: they belong to its bin
            is_lost = ~in_sun & self._sun.contains(d)
            pdf = dr.select(in_sun, 1 / self._sun.solid_angle, dr.select(is_lost, 0, pdf))
        ds = self._texels.directions.sample(ref, d)
        ds.uv = uv
        ds.pdf = dr.select(active, pdf, 0)
        value = self._texels.radiance(ref, ds, active)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        """The bin of the world space direction ``d``, and the density of ``d`` under
        :meth:`sample`, conditional on the bin."""
        column, row, point, sin_theta = self._texels.find(d)
        corners = self._corner_values(row * self._columns + column, active)
        density = mi.warp.square_to_bilinear_pdf(*corners, point)
        bins = self._bins
        bin = row * bins[1] // self._rows * bins[0] + column * bins[0] // self._columns
        pdf = density / sin_theta
        if self._sun is not None:
            in_sun = self._sun.contains(d)
            bin = dr.select(in_sun, self.count - 1, bin)
            pdf = dr.select(in_sun, 1 / self._sun.solid_angle, pdf)
        return bin, dr.select(active, pdf, 0)

    def _texel(self, bin, sample, active) -> tuple[mi.UInt32, mi.Point2f]:
        """Chooses a texel of the bin in proportion to its weight (alias method).

        A texel of the bin is chosen uniformly, and is then either taken or replaced by its alias.

        Returns:
            The texel, and the sample rescaled to [0, 1)².
        """
        bin_row = bin // self._bins[0]
        bin_column = bin - bin_row * self._bins[0]
        column, x, width = _entry(bin_column, self._bins[0], self._columns, sample.x)
        row, y, _height = _entry(bin_row, self._bins[1], self._rows, sample.y)
        # A rescaled number has too few digits for the small thresholds of dark texels beside the
        # sun; the other coordinate supplies more
        x = dr.minimum(dr.fma(y, width * 2.0**-23, x), ONE_MINUS_EPSILON)
        texel = row * self._columns + column
        entry = dr.gather(mi.Vector2u, self._entries, texel, active)
        threshold = dr.reinterpret_array(mi.Float, entry.x)
        is_taken = x < threshold
        # x < threshold in the first case, threshold ≤ x < 1 in the second: no division by zero
        x = dr.select(is_taken, x, x - threshold) / dr.select(is_taken, threshold, 1 - threshold)
        return dr.select(is_taken, texel, entry.y), mi.Point2f(x, y)

    def _corner_values(self, texel: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        """The values at the corners of a texel, all positive; its density is interpolated between
        them."""
        corners = dr.gather(mi.Vector4f, self._corners, texel, active)
        return [dr.select(active, corner, 1) for corner in corners]


def _entry(part, parts: int, count: int, x: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """Chooses one of the columns (or rows) of a bin uniformly. All ``count`` columns are divided
    into ``parts``, of which the bin has the one with index ``part``.

    Returns:
        The column, the random number rescaled to [0, 1), and the number of columns of the bin.
    """
    first = (part * count + (parts - 1)) // parts
    width = ((part + 1) * count + (parts - 1)) // parts - first
    x = x * mi.Float(width)
    index = dr.minimum(mi.UInt32(x), width - 1)
    return first + index, dr.minimum(x - mi.Float(index), ONE_MINUS_EPSILON), mi.Float(width)
