"""A light tree: choosing a light by going down from the root at random.

Each step takes a child with a probability proportional to an estimate of what its lights contribute
to the vertex if nothing occludes them: their strength, times the cosines at the vertex and at the
lights, divided by the squared distance. All three are means over the lights of the node, as far as
their mean position, their spread and their mean normal tell them. (The bounds that the source uses
have up to eight times the variance.) The estimate is 0 only where all lights of the node lie below
the horizon of an opaque surface, or shine elsewhere, so a wrong estimate causes noise, but no bias.
Where both children are dark, they are chosen by strength.

Source: A. Conty Estevez, C. Kulla, *Importance Sampling of Many Lights with Adaptive Tree
Splitting*, HPG 2018, section 5 (going down at random).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...util.arrays import from_numpy
from .tree_construction import NODE_WORDS, Trees

#: The squared spread of lights, times this, is added to their squared distance: a mean of 1 / d².
_SPREAD = 0.5

#: Added to the cosine at a surface: glossy reflection does not decrease with the cosine.
_LEAST_COSINE = 0.01

#: Smaller distances, relative to the spread, are as good as 0.
_TINY = 1e-30


@dataclass
class Receiver:
    """What the choice of a light knows of a vertex.

    Attributes:
        normal: Shading normal, on the side that is seen; 0 in a medium.
        is_opaque: Whether only light from the side of the normal contributes.
    """

    normal: mi.Normal3f
    is_opaque: mi.Bool


class LightTree:
    """Chooses lights, and computes the probability of any light. For a vertex and one of n lights,
    both visit about log₂ n pairs of nodes.

    Parameters:
        trees: The trees.
        in_media: Whether vertices can have no normal.
        largest: The bound of the cosines divided by the squared distance, if there is one.
    """

    def __init__(self, trees: Trees, in_media: bool, largest: mi.Float | None = None) -> None:
        self._in_media, self._largest = in_media, largest
        self._nodes = from_numpy(mi.Float, trees.nodes)
        self._link, self._parent, self._leaf = (
            from_numpy(mi.UInt32, x) for x in (trees.link, trees.parent, trees.leaf)
        )
        # Each half of the way down takes its own random number, because one has only 24 bits
        self._half = dr.opaque(mi.UInt32, (trees.depth + 1) // 2)

    @dr.syntax
    def choose(
        self, root: mi.UInt32, numbers: mi.Point2f, p: mi.Point3f, receiver: Receiver, active
    ) -> tuple[mi.UInt32, mi.Float]:
        """Chooses a light of the tree with this root by two uniform numbers.

        Returns:
            The light, and the probability of choosing it.
        """
        normal, is_opaque = receiver.normal, receiver.is_opaque
        x, level, probability = mi.Float(numbers.x), mi.UInt32(0), mi.Float(1)
        link = dr.gather(mi.UInt32, self._link, root, active)
        goes_down = active & (link & 1 == 0)
        while dr.hint(goes_down, label="light tree"):
            x = dr.select(level == self._half, numbers.y, x)
            share = self._share(link, p, normal, is_opaque, goes_down)
            is_first = x < share
            chosen = dr.select(is_first, share, 1 - share)
            x = dr.select(is_first, x, x - share) / chosen
            x = dr.minimum(x, dr.one_minus_epsilon(mi.Float))
            probability *= chosen
            level += 1
            link = dr.gather(mi.UInt32, self._link, link + dr.select(is_first, 0, 1), goes_down)
            goes_down &= link & 1 == 0
        return link >> 1, probability

    @dr.syntax
    def probability(self, light: mi.UInt32, p: mi.Point3f, receiver: Receiver, active) -> mi.Float:
        """The probability with which :meth:`choose` chooses a light of its tree."""
        normal, is_opaque = receiver.normal, receiver.is_opaque
        node = dr.gather(mi.UInt32, self._leaf, light, active)
        parent = dr.gather(mi.UInt32, self._parent, node >> 1, active)
        probability = mi.Float(1)
        while dr.hint(parent > 0, label="up the light tree"):
            share = self._share(node & ~mi.UInt32(1), p, normal, is_opaque, active)
            probability *= dr.select(node & 1 == 0, share, 1 - share)
            node = parent
            parent = dr.gather(mi.UInt32, self._parent, node >> 1, active)
        return probability

    def _share(self, first, p, normal, is_opaque, active) -> mi.Float:
        """The probability of the first one of two siblings. Both functions above compute the
        probability of the other one as 1 − share, so that they agree."""
        shape = (2 * NODE_WORDS, dr.width(first))
        w = dr.gather(mi.ArrayXf, self._nodes, first >> 1, active, shape=shape)
        a, b = (
            self._estimate(w[i : i + NODE_WORDS], p, normal, is_opaque)
            for i in (0, NODE_WORDS)
        )
        # Strengths are positive
        is_dark = a + b <= 0
        a, b = dr.select(is_dark, w[7], a), dr.select(is_dark, w[15], b)
        return a / dr.select(active, a + b, 1)

    def _estimate(self, words, p, normal, is_opaque) -> mi.Float:
        """What the lights of a node contribute to a vertex."""
        center, axis = mi.Point3f(words[:3]), mi.Vector3f(words[4:7])
        spread, strength = words[3], words[7]
        ratio, cos_limit = _last_bits(spread) / 255, _last_bits(strength) / 127.5 - 1
        d = center - p
        d_2 = dr.squared_norm(d)
        inverse = dr.rsqrt(dr.maximum(d_2 + _SPREAD * dr.square(spread), _TINY))
        near = spread * inverse

        height = dr.dot(normal, d)
        is_lit = ~is_opaque | (height * ratio + spread >= 0)
        height = dr.select(is_opaque, height, dr.abs(height)) * inverse
        received = _mean_of_positive(height, 0.5 * near) + _LEAST_COSINE
        if self._in_media:
            received = dr.select(dr.squared_norm(normal) > 0, received, 1)

        height, length_2 = -dr.dot(axis, d), dr.squared_norm(axis)
        # A mean normal of length 1 is the normal of all lights. If it is 0, they face all sides
        variety = 0.25 * dr.maximum(1 - length_2, 0)
        emitted = _mean_of_positive(
            height * inverse, dr.sqrt(variety + dr.square(0.5 * near))
        )
        # The distance from the cone's mantle, times the axis's length, positive within the cone
        aside = dr.safe_sqrt(length_2 * d_2 - dr.square(height))
        sin_limit = dr.safe_sqrt(1 - dr.square(cos_limit))
        within = height * sin_limit - aside * cos_limit
        is_lit &= within * ratio + spread * dr.sqrt(length_2) >= 0

        G = received * emitted * dr.square(inverse)
        if self._largest is not None:
            G = dr.minimum(G, self._largest)
        return dr.select(is_lit, strength * G, 0)


def _last_bits(x: mi.Float) -> mi.Float:
    return mi.Float(dr.reinterpret_array(mi.UInt32, x) & 0xFF)


def _mean_of_positive(mean: mi.Float, deviation: mi.Float) -> mi.Float:
    """An estimate of the mean of max(x, 0), if x has this mean and varies by this deviation."""
    return 0.5 * (mean + dr.sqrt(dr.square(mean) + dr.square(deviation)))
