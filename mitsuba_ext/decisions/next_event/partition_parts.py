"""What a partition of an environment is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ...lights.texel_sums import Corners


@dataclass
class Peak:
    """A direction in which a BSDF sample has found light.

    Attributes:
        column, row: Its texel.
        value: What is reflected.
    """

    column: mi.UInt32
    row: mi.UInt32
    value: mi.Float


@dataclass
class Node:
    """A rectangle in local memory.

    Attributes:
        x, y: First and last + 1 column (row), in 16 bits each.
        f: The function at the corners.
        lift: Is added to the function, as it is larger inside than at the corners.
        share: What the texels emit.
    """

    x: mi.UInt32
    y: mi.UInt32
    f: Corners
    lift: mi.Float
    share: mi.Float

    @property
    def weight(self) -> mi.Float:
        return self.share * (self.f.mean + self.lift)


@dataclass
class Branch:
    """The place of a rectangle in the tree.

    Attributes:
        weight: Of the rectangle, or of its parts together.
        link: The first of its two parts, which follow each other; 0 for a leaf.
    """

    weight: mi.Float
    link: mi.UInt32


@dataclass
class Partition:
    """A partition of one vertex.

    Attributes:
        nodes, branches: Local memory (``dr.Local`` of :class:`Node` and :class:`Branch`).
        floor: Is added to the function everywhere.
        sun: The probability of the sun's disk.
    """

    nodes: Any
    branches: Any
    floor: mi.Float
    sun: mi.Float
