"""The data structures of a partition of an environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ...scene.lights.texel_sums import Corners


@dataclass
class Peak:
    """The direction of a BSDF sample.

    Attributes:
        column, row: Its texel.
        value: The brightness of the BSDF's value there, cosine included.
    """

    column: mi.UInt32
    row: mi.UInt32
    value: mi.Float


@dataclass
class Node:
    """A rectangle in local memory.

    Attributes:
        x, y: First and last + 1 column (row), in 16 bits each.
        f: The BSDF's value, cosine included, at the corners.
        lift: Is added to ``f``, where BSDF samples inside found more than the corners.
        share: The share of its texels in all emission, times their visibility where it is known.
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
        weight: The weight of the rectangle, or the sum of the weights of its parts.
        link: The first of its two parts, which follow each other; 0 for a leaf.
    """

    weight: mi.Float
    link: mi.UInt32


@dataclass
class Partition:
    """The partition of the environment at one vertex.

    Attributes:
        nodes, branches: Local memory (``dr.Local`` of :class:`Node` and :class:`Branch`).
        floor: Is added to the BSDF's value everywhere.
        sun: The probability of sampling the sun's disk.
    """

    nodes: Any
    branches: Any
    floor: mi.Float
    sun: mi.Float
