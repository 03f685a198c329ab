"""What a camera path remembers of the casters that it has met."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .casters import Casters
from .microfacets import is_offset, with_offset

#: The most surfaces of a chain: in and out of a piece of glass.
MOST_SURFACES = 2

#: The number of surfaces of chains that no connection finds.
NEVER = 255


@dataclass
class History:
    """The casters that a path has met since the last vertex that could be connected.

    Attributes:
        p, n: Position and normal of the vertex.
        d: The direction in which the ray left it.
        pdf: The density of the direction · the probabilities with which the casters were sampled.
        length: The number of casters; ``NEVER`` where no connection finds the path.
        transmits: Bit i tells whether caster i has transmitted the ray.
        lane: The number of the path.
        total: The importance of all vertices before.
        offsets: The offsets of rough casters; ``None`` if all are smooth.
    """

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    pdf: mi.Float
    length: mi.UInt32
    transmits: mi.UInt32
    lane: mi.UInt32
    total: mi.Float
    offsets: mi.Vector4f | None

    def past(
        self, casters: Casters, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, transmits: mi.Bool
    ) -> tuple[History, mi.Bool]:
        """The history behind the surface ``si``, which scatters the path in the direction ``wo``;
        and whether this is still a chain."""
        passes = casters.contain(si.shape) & (self.length < MOST_SURFACES)
        # Only chains of refractions have more than one surface
        passes &= (self.length == 0) | (transmits & (self.transmits != 0))
        offsets = None
        if casters.are_rough:
            offset = casters.offset(si, wo, transmits)
            passes &= is_offset(offset)
            offsets = with_offset(self.offsets, self.length, offset)
        bit = dr.select(transmits, mi.UInt32(1) << self.length, 0)
        length = dr.select(passes, self.length + 1, NEVER)
        onward = replace(self, length=length, transmits=self.transmits | bit, offsets=offsets)
        return onward, passes
