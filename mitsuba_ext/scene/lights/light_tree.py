"""A light tree: choosing a light by going down from the root at random.

Each step takes a child of a node with a probability proportional to an estimate of what the child's
lights contribute to the vertex if nothing occludes them: their strength, times the cosines at the
vertex and at the lights, divided by the squared distance. The estimate is a mean over these lights,
as far as their mean position, their spread and their mean normal tell it. (With the source's upper
bounds in its place, unoccluded light has two to seven times the variance.) It is 0 only where all
of the lights lie below the horizon of an opaque surface, or shine elsewhere: a wrong estimate
causes noise, but no bias. Where all children are dark, they are chosen uniformly.

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
    """Chooses lights, and computes the probability of any light. Both visit the children of as many
    nodes as the tree has levels: the cost grows with the logarithm of the number of lights.

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
        self._half, self._roots = (
            dr.opaque(mi.UInt32, n) for n in ((trees.depth + 1) // 2, trees.roots)
        )

    @dr.syntax
    def choose(
        self, root: mi.UInt32, numbers: mi.Point2f, p: mi.Point3f, receiver: Receiver, active
    ) -> tuple[mi.UInt32, mi.Float]:
        """Chooses a light of the tree with this root by two uniform numbers.

        Returns:
            The light, and the probability of choosing it.
        """
        x, level, probability = mi.Float(numbers.x), mi.UInt32(0), mi.Float(1)
        link = dr.gather(mi.UInt32, self._link, root, active)
        goes_down = active & (link & 1 == 0)
        while dr.hint(goes_down, label="light tree"):
            x = dr.select(level == self._half, numbers.y, x)
            first, count = link >> 6, (link >> 1 & 31) + 1
            child, share, x = self._pick(first, count, p, receiver, x, goes_down)
            probability *= share
            level += 1
            link = dr.gather(mi.UInt32, self._link, first + child, goes_down)
            goes_down &= link & 1 == 0
        return link >> 1, probability

    @dr.syntax
    def _pick(self, first, count, p, receiver, x, active):
        """Picks one of ``count`` siblings, the first of which is ``first``, by the uniform number
        ``x``. Each sibling in turn takes the place of the one before it with the probability of its
        share in the sum so far.

        Returns:
            The sibling's place among them, its probability, and what is left of the number.
        """
        rest, total, mine = mi.Float(x), mi.Float(0), mi.Float(0)
        child, index = mi.UInt32(0), mi.UInt32(0)
        while dr.hint(active & (index < count), label="siblings"):
            estimate = self._estimate(first + index, p, receiver, active)
            before, total = total, total + estimate
            target = rest * total
            is_lit = estimate > 0
            is_taken = is_lit & ((target < estimate) | (before <= 0))
            child = dr.select(is_taken, index, child)
            mine = dr.select(is_taken, estimate, mine)
            # What is left of the number is uniform again
            target -= dr.select(is_taken, 0, estimate)
            target /= dr.select(is_taken, estimate, dr.maximum(before, _TINY))
            rest = dr.select(is_lit, target, rest)
            rest = dr.clip(rest, 0, dr.one_minus_epsilon(mi.Float))
            index += 1
        # Where all are dark
        is_dark, slots = total <= 0, mi.Float(count)
        slot = dr.minimum(mi.UInt32(x * slots), count - 1)
        child = dr.select(is_dark, slot, child)
        rest = dr.select(is_dark, x * slots - mi.Float(slot), rest)
        return child, _share(mine, total, count), rest

    @dr.syntax
    def probability(self, light: mi.UInt32, p: mi.Point3f, receiver: Receiver, active) -> mi.Float:
        """The probability with which :meth:`choose` chooses a light of its tree."""
        node = dr.gather(mi.UInt32, self._leaf, light, active)
        probability = mi.Float(1)
        while dr.hint(active & (node >= self._roots), label="up the light tree"):
            parent = dr.gather(mi.UInt32, self._parent, node, active)
            link = dr.gather(mi.UInt32, self._link, parent, active)
            first, count = link >> 6, (link >> 1 & 31) + 1
            # In the order of `choose`, for the same sum
            total, mine, index = mi.Float(0), mi.Float(0), mi.UInt32(0)
            while dr.hint(index < count, label="its siblings"):
                estimate = self._estimate(first + index, p, receiver, active)
                total += estimate
                mine = dr.select(first + index == node, estimate, mine)
                index += 1
            probability *= _share(mine, total, count)
            node = parent
        return probability

    def _estimate(self, node, p, receiver, active) -> mi.Float:
        """What the lights of a node contribute to a vertex."""
        words = dr.gather(
            mi.ArrayXf, self._nodes, node, active, shape=(NODE_WORDS, dr.width(node))
        )
        normal, is_opaque = receiver.normal, receiver.is_opaque
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
        near_2 = 0.25 * dr.square(near)
        received = _mean_of_positive(height, near_2) + _LEAST_COSINE
        if self._in_media:
            received = dr.select(dr.squared_norm(normal) > 0, received, 1)

        height, length_2 = -dr.dot(axis, d), dr.squared_norm(axis)
        # A mean normal of length 1 is the normal of all lights. If it is 0, they face all sides
        variety = 0.25 * dr.maximum(1 - length_2, 0)
        emitted = _mean_of_positive(height * inverse, variety + near_2)
        # Is a point within the lights' reach of the vertex in the cone? It is if height · sin +
        # reach · length >= aside · cos, where `aside` is the distance from the axis, times its
        # length. Without roots: squares of both sides, and (1 + length²) / 2, which is no less
        aside_2 = dr.maximum(length_2 * d_2 - dr.square(height), 0)
        sin_limit = dr.safe_sqrt(1 - dr.square(cos_limit))
        inside = height * sin_limit * ratio + spread * 0.5 * (1 + length_2)
        outside_2 = aside_2 * dr.square(cos_limit * ratio)
        is_wide, inside_2 = cos_limit <= 0, dr.square(inside)
        is_lit &= dr.select(
            inside >= 0, is_wide | (inside_2 >= outside_2), is_wide & (inside_2 <= outside_2)
        )

        G = received * emitted * dr.square(inverse)
        if self._largest is not None:
            G = dr.minimum(G, self._largest)
        return dr.select(is_lit, strength * G, 0)


def _share(estimate, total, count) -> mi.Float:
    """The probability of a sibling with this estimate; the same for all where all are dark."""
    return dr.select(total > 0, estimate / total, dr.rcp(mi.Float(count)))


def _last_bits(x: mi.Float) -> mi.Float:
    return mi.Float(dr.reinterpret_array(mi.UInt32, x) & 0xFF)


def _mean_of_positive(mean: mi.Float, variance: mi.Float) -> mi.Float:
    """An estimate of the mean of max(x, 0), if x has this mean and this variance."""
    return 0.5 * (mean + dr.sqrt(dr.square(mean) + variance))
