"""Divides the directions of an environment emitter into bins."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bounds import scene_bounds
from ..discrete_sampling import ONE_MINUS_EPSILON, alias_tables
from .spectra import brightness, comparison_wavelengths
from .sun import SunDisk

#: Bins along the azimuth and along the polar angle.
BINS = (32, 16)

#: Nodes (columns, rows) at which emitters that are no maps are evaluated. Features smaller than the
#: 0.35° between two nodes are found only if the emitter's own sampling finds them. The disk of the
#: sun is a bin of its own.
_NODES = (1024, 513)

#: Nodes of a constant emitter, for which only sin θ is interpolated.
_CONSTANT_NODES = (64, 33)

#: Samples that the own sampling of an emitter that is no map takes.
_OWN_SAMPLES = 1 << 16

#: Weight of black texels relative to the mean.
_FLOOR = 1e-3

#: The sine of the polar angle at the poles, where densities would be infinite.
_LEAST_SINE = 1e-7


class EnvironmentBins:
    """Samples directions in rectangular bins of latitude and longitude.

    Inside a bin, a texel is chosen by its brightness and a point in it by the bilinear function
    that Mitsuba's ``envmap`` interpolates with: for maps the density of a bin is proportional to
    what it emits. The sun of a ``sunsky`` is one more bin, the last, cut out of the others.

    Parameters:
        scene: The scene with the environment emitter.

    Attributes:
        count (int): Number of bins.
        share (numpy.ndarray): Share of the emitted brightness in each bin; shape [count].
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._scene = scene  # kept alive, as its emitter has to be
        self.emitter = scene.environment()
        self.pointer = mi.EmitterPtr(self.emitter)
        self._is_map = self.emitter.class_name() == "EnvironmentMapEmitter"
        bbox = scene_bounds(scene)
        sphere = bbox.bounding_sphere() if bbox.valid() else mi.ScalarBoundingSphere3f(0.0, 1.0)
        # So that samples lie behind all shapes, also after rounding
        self._center, self._radius = mi.Point3f(sphere.center), mi.Float(1.001 * sphere.radius)
        self._to_world = mi.Transform4f(self.emitter.world_transform())
        self._to_local = self._to_world.inverse()
        dr.make_opaque(self._center, self._radius, self._to_world, self._to_local)
        self._sun = SunDisk.of(self.emitter)
        if self._is_map:
            height, width = mi.traverse(self.emitter)["data"].shape[:2]
            # Mitsuba adds two columns, which are copies. The first and the last row are the poles
            self._columns, self._rows = width - 2, height - 1
        else:
            is_constant = self.emitter.class_name() == "ConstantBackgroundEmitter"
            columns, rows = _CONSTANT_NODES if is_constant else _NODES
            self._columns, self._rows = columns, rows - 1
        # Nodes of a map are the middles of its columns
        self._shift = 0.5 / self._columns
        self._build(self._node_values())

    def _node_values(self) -> np.ndarray:
        """Brightness times sin θ at the nodes, the first column repeated; shape [rows + 1,
        columns + 1]."""
        columns, rows = self._columns, self._rows
        index = dr.arange(mi.UInt32, columns * (rows + 1))
        row = index // columns
        u = mi.Float(index - row * columns) / columns + self._shift
        # Not at the poles: a direction there belongs to no column
        v = dr.clip(mi.Float(row), 1e-2, rows - 1e-2) / rows
        value = self._brightness(mi.Point2f(u, v)).numpy().reshape(rows + 1, columns)
        if not self._is_map:
            # The largest value around each node, and what the emitter's own samples found there: so
            # that features between the nodes are not missed
            value = np.maximum(value, self._own_samples(value.shape))
            wide = np.maximum(value, np.maximum(np.roll(value, 1, 1), np.roll(value, -1, 1)))
            padded = np.pad(wide, ((1, 1), (0, 0)), mode="edge")
            value = np.maximum(wide, np.maximum(padded[:-2], padded[2:]))
        value = value + _FLOOR * value.mean() + 1e-30
        sin_theta = np.sin(np.linspace(0, np.pi, rows + 1))
        # Not zero at the poles, where a texel still has an area
        sin_theta[[0, -1]] = 0.25 * np.sin(np.pi / rows)
        value = value * sin_theta[:, None]
        return np.concatenate([value, value[:, :1]], axis=1)

    def _own_samples(self, shape: tuple[int, int]) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, _OWN_SAMPLES)
        ref = dr.zeros(mi.Interaction3f, _OWN_SAMPLES)
        ref.p, ref.wavelengths = self._center, comparison_wavelengths(_OWN_SAMPLES)
        ds, weight = self.emitter.sample_direction(ref, sampler.next_2d())
        value = brightness(weight) * ds.pdf
        if self._sun is not None:
            value = dr.select(self._sun.contains(ds.d), 0, value)
        value = (value + dr.zeros(mi.Float, _OWN_SAMPLES)).numpy()
        uv = self._uv(ds.d)[0].numpy()
        result = np.zeros(shape)
        x = np.minimum((uv[0] * self._columns).astype(int), self._columns - 1)
        y = np.minimum((uv[1] * self._rows).round().astype(int), self._rows)
        np.maximum.at(result, (y, x), np.where(np.isfinite(value), value, 0))
        return result

    def _brightness(self, uv: mi.Point2f) -> mi.Float:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.wi = -(self._to_world @ self._direction(uv)[0])
        si.wavelengths = comparison_wavelengths(dr.width(uv))
        value = brightness(self.emitter.eval(si))
        counts = dr.isfinite(value)
        if self._sun is not None:
            counts &= ~self._sun.contains(-si.wi)
        return dr.select(counts, value, dr.zeros(mi.Float, dr.width(uv)))

    def _build(self, node: np.ndarray) -> None:
        columns, rows = self._columns, self._rows
        self._bins = min(BINS[0], columns), min(BINS[1], rows)
        count = self._bins[0] * self._bins[1]
        # Each texel with its corners; its weight is their mean
        corners = np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]], axis=-1)
        corners = corners.reshape(-1, 4)
        weight = corners.mean(axis=1)
        bin = (
            (np.arange(rows) * self._bins[1] // rows)[:, None] * self._bins[0]
            + np.arange(columns) * self._bins[0] // columns
        ).ravel()
        bin_weight = np.bincount(bin, weight, count)
        self._set_shares(bin_weight)
        # Densities on the sphere, but for 1 / sin θ
        corners *= (columns * rows / (2 * np.pi**2) / bin_weight)[bin][:, None]
        self._corners = mi.Float(corners.ravel().astype(np.float32))

        order = np.argsort(bin.astype(np.uint16), kind="stable")
        size = np.bincount(bin, minlength=count)
        end = np.cumsum(size)
        of = bin[order]
        threshold, alias = alias_tables(
            mi.Float64((weight * size[bin] / bin_weight[bin])[order]),
            mi.UInt32((end - size)[of].astype(np.uint32)),
            mi.UInt32((end - 1)[of].astype(np.uint32)),
            int(size.max()),
        )
        entries = np.empty((len(order), 2), dtype=np.uint32)
        entries[order, 0] = threshold.numpy().view(np.uint32)
        entries[order, 1] = order[alias.numpy()]
        self._entries = mi.UInt32(entries.ravel())

    def _set_shares(self, bin_weight: np.ndarray) -> None:
        """Sets the share of each bin in the emitted brightness, the sun's included."""
        # From the sum over texels to the integral over the sphere
        emitted = bin_weight * 2 * np.pi**2 / (self._columns * self._rows)
        if self._sun is not None:
            n = 64
            x, y = dr.meshgrid(*2 * [(dr.arange(mi.Float, n) + 0.5) / n])
            si = dr.zeros(mi.SurfaceInteraction3f, n * n)
            si.wi = -self._sun.sample(mi.Point2f(x, y))
            si.wavelengths = comparison_wavelengths(n * n)
            value = float(dr.mean(brightness(self.emitter.eval(si)))[0])
            emitted = np.append(emitted, value * self._sun.solid_angle)
        self.count = len(emitted)
        self.share = emitted / emitted.sum()

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
            bin = dr.minimum(bin, self.count - 2)  # a valid one; it is not used in the sun
        texel, point = self._texel(bin, sample, active)
        point, density = mi.warp.square_to_bilinear(*self._corner_values(texel, active), point)
        row = texel // self._columns
        uv = mi.Point2f(
            (mi.Float(texel - row * self._columns) + point.x) / self._columns + self._shift,
            (mi.Float(row) + point.y) / self._rows,
        )
        d, sin_theta = self._direction(uv)

        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = self._to_world @ d
        ds.pdf = density / sin_theta
        if self._sun is not None:
            ds.d = dr.select(in_sun, self._sun.sample(sample), ds.d)
            # Samples of other bins in the disk get no density: these directions are the sun's bin's
            is_lost = ~in_sun & self._sun.contains(ds.d)
            ds.pdf = dr.select(in_sun, 1 / self._sun.solid_angle, dr.select(is_lost, 0, ds.pdf))
        ds.dist = 2 * dr.maximum(self._radius, dr.norm(ref.p - self._center))
        ds.p = ref.p + ds.d * ds.dist
        ds.n = -ds.d
        ds.uv = uv
        ds.time = ref.time
        ds.pdf = dr.select(active, ds.pdf, 0)
        ds.emitter = self.pointer
        if self._is_map:
            # By the sample's uv, without a search for the texel
            value = self.emitter.eval_direction(ref, ds, active)
        else:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wi, si.wavelengths, si.time = -ds.d, ref.wavelengths, ref.time
            value = self.emitter.eval(si, active)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        """The bin of the world space direction ``d``, and the density, conditional on the bin, with
        which :meth:`sample` would sample it."""
        uv, sin_theta = self._uv(d)
        x, y = uv.x * self._columns, uv.y * self._rows
        column = dr.minimum(mi.UInt32(x), self._columns - 1)
        row = dr.minimum(mi.UInt32(y), self._rows - 1)
        corners = self._corner_values(row * self._columns + column, active)
        point = mi.Point2f(x - mi.Float(column), y - mi.Float(row))
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

        A texel of the bin is chosen uniformly, and then is either taken or replaced by its alias.

        Returns:
            The texel, and the sample rescaled to [0, 1)².
        """
        bin_row = bin // self._bins[0]
        bin_column = bin - bin_row * self._bins[0]
        column, x, width = _entry(bin_column, self._bins[0], self._columns, sample.x)
        row, y, _height = _entry(bin_row, self._bins[1], self._rows, sample.y)
        # A rescaled number has few digits, too few for the small thresholds of dark texels beside
        # the sun: the other coordinate supplies more of them
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

    def _direction(self, uv: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        sin_theta, cos_theta = dr.sincos(uv.y * dr.pi)
        sin_phi, cos_phi = dr.sincos(uv.x * dr.two_pi)
        sin_theta = dr.maximum(sin_theta, _LEAST_SINE)
        return mi.Vector3f(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta), sin_theta

    def _uv(self, d: mi.Vector3f) -> tuple[mi.Point2f, mi.Float]:
        """Coordinates in [0, 1] whose columns begin at nodes, and the sine of the polar angle."""
        v = self._to_local @ d
        u = dr.atan2(v.x, -v.z) * dr.inv_two_pi - self._shift
        # Accurate near the poles, where the cosine does not change
        sin_theta = dr.maximum(dr.sqrt(dr.square(v.x) + dr.square(v.z)), _LEAST_SINE)
        return mi.Point2f(u - dr.floor(u), dr.atan2(sin_theta, v.y) * dr.inv_pi), sin_theta


def _entry(part, parts: int, count: int, x: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """Chooses one of the columns (or rows) of a bin uniformly. All ``count`` columns are divided
    into ``parts``; those of the bin are ``part``.

    Returns:
        The column, the random number rescaled to [0, 1), and the number of columns of the bin.
    """
    first = (part * count + (parts - 1)) // parts
    width = ((part + 1) * count + (parts - 1)) // parts - first
    x = x * mi.Float(width)
    index = dr.minimum(mi.UInt32(x), width - 1)
    return first + index, dr.minimum(x - mi.Float(index), ONE_MINUS_EPSILON), mi.Float(width)
