"""The light that was chosen for a connection."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Choice:
    """The choice of a light cell for a connection.

    Attributes:
        row: Row of the table at the vertex.
        cell: The chosen light cell.
        probability: The probability of that choice.
    """

    row: mi.UInt32
    cell: mi.UInt32
    probability: mi.Float
