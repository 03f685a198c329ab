"""Profiles: the dependence of a light's radiance on direction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...util.arrays import from_numpy
from .ies import Intensities

#: The minimum ratio of the light's projected area to its area: radiance is intensity divided by the
#: projected area, and real luminaires are not flat.
MIN_COSINE = 0.1


class Profile:
    """A direction-dependent factor of the radiance.

    Attributes:
        needs_axis: Whether the profile changes if the light is rotated about its normal.
    """

    needs_axis = False

    def eval(self, cosine: mi.Float, cos_turn: mi.Float, sin_turn: mi.Float) -> mi.Float:
        """The factor.

        Parameters:
            cosine: Cosine between the direction and the normal, positive.
            cos_turn, sin_turn: Cosine and sine of the angle about the normal, from the light's
                x axis.
        """
        raise NotImplementedError

    def sample(self, sample: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction (z along the normal), and its density per solid angle."""
        wo = mi.warp.square_to_cosine_hemisphere(sample)
        return wo, mi.warp.square_to_cosine_hemisphere_pdf(wo)


class PowerOfCosine(Profile):
    """The profile of Phong: cosineⁿ."""

    def __init__(self, exponent: float) -> None:
        self._exponent = dr.opaque(mi.Float, exponent)

    def eval(self, cosine, cos_turn, sin_turn):
        return dr.power(dr.maximum(cosine, 0), self._exponent)

    def sample(self, sample):
        # In proportion to radiance · cosine: cosineⁿ⁺¹
        n = self._exponent + 1
        z = dr.power(1 - sample.y, dr.rcp(n + 1))
        sin, cos = dr.sincos(dr.two_pi * sample.x)
        r = dr.safe_sqrt(1 - z * z)
        return mi.Vector3f(r * cos, r * sin, z), (n + 1) * dr.inv_two_pi * dr.power(z, n)


class AngularTable(Profile):
    """Measured intensities, divided by the projected area of the light."""

    def __init__(self, intensities: Intensities) -> None:
        rows, self._columns = intensities.values.shape
        self.needs_axis = rows > 1
        self._rows = rows
        self._values = from_numpy(mi.Float, intensities.values)

    def eval(self, cosine, cos_turn, sin_turn):
        vertical = dr.safe_acos(cosine) * (2 / dr.pi * (self._columns - 1))
        value, other = self._row(mi.UInt32(0), vertical), None
        if self.needs_axis:
            turn = dr.atan2(sin_turn, cos_turn) * dr.inv_two_pi
            turn = dr.select(turn < 0, turn + 1, turn) * (self._rows - 1)
            row = dr.clip(mi.Int32(turn), 0, self._rows - 2)
            value, other = (self._row(mi.UInt32(row + i), vertical) for i in (0, 1))
            value = dr.lerp(value, other, dr.clip(turn - row, 0, 1))
        return value / dr.maximum(cosine, MIN_COSINE)

    def _row(self, row: mi.UInt32, vertical: mi.Float) -> mi.Float:
        """Interpolates linearly in ``vertical``, an angle in steps of the table."""
        column = dr.clip(mi.Int32(vertical), 0, self._columns - 2)
        index = row * self._columns + mi.UInt32(column)
        a, b = (dr.gather(mi.Float, self._values, index + i) for i in (0, 1))
        return dr.lerp(a, b, dr.clip(vertical - column, 0, 1))
