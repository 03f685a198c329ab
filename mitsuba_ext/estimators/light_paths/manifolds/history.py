"""What a camera path remembers of the casters that it has met."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

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
