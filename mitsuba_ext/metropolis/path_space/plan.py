"""Which vertices of a path a mutation makes anew, and how."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Plan:
    """How a proposal is made.

    Attributes:
        keeps: The last vertex that is kept at the camera's end; 0 if all from the first on are new.
        grown: The last vertex that is made from the camera.
        rest: The first vertex that is kept at the light's end; length + 1 if all are new. Those
            between the last two are made from the light.
        perturbs: Do the new vertices follow the old path at a small distance? Else they are a
            random walk. At discrete lobes the new path is scattered as the old one.
    """

    keeps: mi.UInt32
    grown: mi.UInt32
    rest: mi.UInt32
    perturbs: mi.Bool
