"""Which light a vertex is connected to."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Choice:
    """What was chosen for a connection.

    Attributes:
        row: Row of the table at the vertex.
        cell: What was chosen there.
        probability: With what probability.
    """

    row: mi.UInt32
    cell: mi.UInt32
    probability: mi.Float
