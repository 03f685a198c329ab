"""The plan of a mutation: the vertices of a path that it replaces, and how."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Plan:
    """The plan of a proposal.

    Attributes:
        keeps: The last vertex kept at the camera's end; 0 if none is kept.
        grown: The last vertex made from the camera.
        rest: The first vertex kept at the light's end; length + 1 if none is kept. The
            vertices between ``grown`` and ``rest`` are made from the light.
        perturbs: Whether the new vertices follow the old path at a small distance. Otherwise, a
            random walk samples them. At delta lobes, the new path takes the old path's lobe.
    """

    keeps: mi.UInt32
    grown: mi.UInt32
    rest: mi.UInt32
    perturbs: mi.Bool
