"""The disk of the sun in Mitsuba's ``sunsky``: too small for a table of directions."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.spectra import brightness, comparison_wavelengths

#: Angles at which the edge of the disk is searched for, up to the largest aperture, in radians.
_ANGLES = np.geomspace(1e-4, 0.5, 4096)

#: The minimum brightness of the sun's edge, relative to the sky, for treating it as a disk.
_CONTRAST = 4.0

#: The ratio of the sampled disk's angle to the sun's: Mitsuba compares cosines with the cosine of
#: the edge in single precision, which blurs the edge by half a percent.
_MARGIN = 1.015


class SunDisk:
    """A small cone of directions, sampled uniformly.

    Parameters:
        direction: Its axis in world space, of unit length.
        half_angle: The angle between the axis and the edge, in radians.

    Attributes:
        direction (mi.Vector3f): The axis.
        solid_angle (float): Solid angle of the cone.
    """

    def __init__(self, direction: mi.Vector3f, half_angle: float) -> None:
        self.direction = mi.Vector3f(direction)
        dr.make_opaque(self.direction)
        # The square of the chord: precise for small angles, and proportional to the solid angle
        self._square = float(4 * np.sin(half_angle / 2) ** 2)
        self.solid_angle = np.pi * self._square

    @classmethod
    def of(cls, emitter: mi.Emitter) -> SunDisk | None:
        """The sun's disk in a ``sunsky``; ``None`` for other emitters, and where the sun is not
        visible."""
        parameters = mi.traverse(emitter)
        if emitter.class_name() != "SunskyEmitter" or "sun_direction" not in parameters:
            return None
        sun = dr.normalize(mi.Vector3f(parameters["sun_direction"]))
        # The edge is searched for upwards: at sunset, the lower half is below the horizon
        zenith = emitter.world_transform() @ mi.Vector3f(0, 0, 1)
        upwards = zenith - sun * dr.dot(zenith, sun)
        length = dr.norm(upwards)
        # If the sun is at the zenith, any direction will do
        upwards = dr.select(
            length > 1e-3, upwards / dr.maximum(length, 1e-3), mi.coordinate_system(sun)[0]
        )
        sin, cos = dr.sincos(from_numpy(mi.Float, _ANGLES))
        si = dr.zeros(mi.SurfaceInteraction3f, len(_ANGLES))
        si.wi = -(sun * cos + upwards * sin)
        si.wavelengths = comparison_wavelengths(len(_ANGLES))
        value = brightness(emitter.eval(si)).numpy()
        contrast = value[:-1] / np.maximum(value[1:], 1e-30)
        edge = int(contrast.argmax())
        if contrast[edge] < _CONTRAST or not value[edge] > 0:
            return None
        return cls(sun, _MARGIN * _ANGLES[edge + 1])

    def contains(self, d: mi.Vector3f) -> mi.Bool:
        """Whether the direction ``d`` lies in the disk."""
        return dr.squared_norm(d - self.direction) < self._square

    def sample(self, sample: mi.Point2f) -> mi.Vector3f:
        """A direction in the disk, uniformly distributed."""
        p = mi.warp.square_to_uniform_disk_concentric(sample)
        square = self._square * (1 - 1e-5) * dr.squared_norm(p)
        # The cosine of the angle is 1 − square / 2
        p *= math.sqrt(self._square) * dr.sqrt(1 - 0.25 * square)
        return mi.Frame3f(self.direction).to_world(mi.Vector3f(p.x, p.y, 1 - 0.5 * square))

    def invert(self, d: mi.Vector3f) -> mi.Point2f:
        """The sample that :meth:`sample` maps to the direction ``d`` in the disk."""
        p = mi.Frame3f(self.direction).to_local(d)
        square = dr.squared_norm(d - self.direction)
        scale = math.sqrt(self._square) * dr.sqrt(dr.maximum(1 - 0.25 * square, 1e-6))
        return mi.warp.uniform_disk_to_square_concentric(mi.Point2f(p.x, p.y) / scale)
