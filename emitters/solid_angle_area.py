"""Area lights that are sampled by solid angle."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.luminaires.area_luminaire import AreaLuminaire


@registry.plugin
class SolidAngleArea(AreaLuminaire):
    r"""
    .. _emitter-solid_angle_area:

    Area light, sampled by solid angle (:monosp:`solid_angle_area`)
    ---------------------------------------------------------------

    The light of Mitsuba's :monosp:`area`, in its place on a shape. Connections choose among the
    directions in which the light is seen, not among the points of its surface.

    .. pluginparameters::

     * - radiance
       - |spectrum| or |texture|
       - Emitted radiance, in W/(m² sr). (Default: 1)
     * - sampling_weight
       - |float|
       - How often the light is chosen, in proportion to the others. (Default: 1)
    """
