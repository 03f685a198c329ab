"""The light chosen for a connection."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Choice:
    """The choice of a light cell for a connection.

    Attributes:
        row: The table row of the vertex.
        cell: The chosen light cell.
        probability: The probability with which it was chosen.
    """

    row: mi.UInt32
    cell: mi.UInt32
    probability: mi.Float
