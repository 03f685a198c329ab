"""Builds light trees: trees over lights whose nodes know where their lights are, how far they are
spread, and in which directions they shine.

The lights of a node are halved in the middle of the longest edge of the box around them, then each
half again, five times in all: a node has up to 32 children. The trees are built level by level,
with operations on whole arrays. (Splits that minimise the surface area orientation heuristic of the
source have a seventh less variance in one of seven arrangements of lights, and as much or more in
five.)

Source: A. Conty Estevez, C. Kulla, *Importance Sampling of Many Lights with Adaptive Tree
Splitting*, HPG 2018, section 4 (bounds and cones).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

#: Numbers of a node: centre and spread, axis and strength.
NODE_WORDS = 8

#: How often the lights of a node are halved, and the maximum number of its children.
HALVINGS = 5
MOST_CHILDREN = 1 << HALVINGS

#: After this number of halvings, all further halves have equal numbers of lights: lights whose
#: distances range over many orders of magnitude would make deep trees.
_MIDDLE_ROUNDS = 32

#: Added to the angles of cones, for rounding.
_ANGLE_MARGIN = 1e-3

#: Shorter mean directions of emission are no axis of a cone.
_LEAST_AXIS = 1e-3


@dataclass
class Lights:
    """What lights look like from afar. Each array has one row for each light.

    Attributes:
        center: Mean position; shape [lights, 3].
        spread: Root mean square distance of the light's points from the centre.
        reach: The largest such distance.
        axis: Mean normal of the light's surface. Lights that shine in all directions have 0. Shape
            [lights, 3].
        angle: No light leaves at a larger angle to the axis. π if the axis is 0.
        strength: The power, for diffuse lights: irradiance at the distance 1 in the direction of
            the normal, times π. Positive.
    """

    center: np.ndarray
    spread: np.ndarray
    reach: np.ndarray
    axis: np.ndarray
    angle: np.ndarray
    strength: np.ndarray

    def __len__(self) -> int:
        return len(self.strength)

    def at(self, index: np.ndarray) -> Lights:
        """The lights with these numbers."""
        return Lights(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass
class Trees:
    """Trees over disjoint sets of lights. The first nodes are the roots. Siblings are adjacent.

    Attributes:
        nodes: The words of each node (:func:`_packed`); shape [nodes, ``NODE_WORDS``].
        link: The children of each node (:func:`_links`).
        parent: The parent of each node; 0 for roots.
        leaf: The node of each light; shape [lights].
        roots: The number of sets.
        depth: The number of levels below the roots.
    """

    nodes: np.ndarray
    link: np.ndarray
    parent: np.ndarray
    leaf: np.ndarray
    roots: int
    depth: int

    def padded(self, nodes: int, lights: int) -> Trees:
        """The same trees, in arrays that have room for these numbers of nodes and lights."""
        arrays = (self.nodes, nodes), (self.link, nodes), (self.parent, nodes), (self.leaf, lights)
        return Trees(*map(_padded, *zip(*arrays)), self.roots, self.depth)


def _padded(array: np.ndarray, length: int) -> np.ndarray:
    return np.pad(array, [(0, length - len(array)), *[(0, 0)] * (array.ndim - 1)])


def build_trees(
    lights: Lights, owner: np.ndarray | None = None, sets: int = 1, apart: np.ndarray | None = None
) -> Trees:
    """Builds a tree for each set of lights.

    Parameters:
        owner: The set of each light. By default, there is one.
        sets: The number of sets. The tree of an empty set has one leaf, which is no light.
        apart: Lights to be separated from the others at the root.
    """
    count = len(lights)
    owner = np.zeros(count, int) if owner is None else owner
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=sets)
    nodes, links, parents = [], [], [np.zeros(sets, int)]
    leaf = np.zeros(count, np.uint32)
    known, depth = 0, 0
    while True:
        number = known + np.arange(len(counts))
        known += len(counts)
        start = np.cumsum(counts) - counts
        exists = counts > 0
        nodes.append(np.zeros((len(counts), NODE_WORDS), np.float32))
        nodes[-1][exists] = _packed(_summary(lights, order, start[exists], counts[exists]))
        is_inner = counts > 1
        light = np.where(counts == 1, np.append(order, 0)[start], 0)
        leaf[light[counts == 1]] = number[counts == 1]
        order, counts = order[np.repeat(is_inner, counts)], counts[is_inner]
        order, counts, parent = _divided(lights.center, order, counts, depth, apart)
        children = np.bincount(parent, minlength=np.count_nonzero(is_inner))
        first = known + np.cumsum(children) - children
        links.append(2 * light + 1)
        links[-1][is_inner] = _links(first, children)
        if len(counts) == 0:
            break
        parents.append(number[is_inner][parent])
        depth += 1
    words = (np.concatenate(x).astype(np.uint32) for x in (links, parents))
    return Trees(np.concatenate(nodes), *words, leaf, sets, depth)


def _links(first: np.ndarray, children: np.ndarray) -> np.ndarray:
    """The words that describe the children of nodes: an even number, with the number of the first
    child, and the count of children, less one, in five bits. (Leaves have an odd number: twice
    their light, plus one.)"""
    return first << 6 | (children - 1) << 1


def _divided(
    center: np.ndarray, order: np.ndarray, counts: np.ndarray, depth: int, apart: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divides nodes into children, by halving them several times.

    Returns:
        The lights of the children, child by child; the number of lights of each child; and the
        parent of each.
    """
    parent = np.arange(len(counts))
    for halving in range(HALVINGS if len(counts) else 0):
        segment = np.repeat(np.arange(len(counts)), counts)
        round_ = depth * HALVINGS + halving
        is_right = _division(center[order], counts, round_ < _MIDDLE_ROUNDS)
        if round_ == 0 and apart is not None and apart.any() and not apart.all():
            is_right = apart[order]
        order = order[np.argsort(2 * segment + is_right, kind="stable")]
        right = np.bincount(segment, is_right, len(counts)).astype(int)
        counts = np.stack([counts - right, right], axis=1).ravel()
        exists = counts > 0
        counts, parent = counts[exists], np.repeat(parent, 2)[exists]
    return order, counts, parent


def _division(center: np.ndarray, counts: np.ndarray, in_the_middle: bool) -> np.ndarray:
    """Whether each light goes to the right child of its node. ``counts``: lights of the nodes."""
    start = np.cumsum(counts) - counts
    segment = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(center)) - start[segment]
    halves = 2 * place >= counts[segment]
    if not in_the_middle:
        return halves
    low, high = (f.reduceat(center, start, axis=0) for f in (np.minimum, np.maximum))
    axis = (high - low).argmax(axis=1)
    rows = np.arange(len(counts))
    middle = 0.5 * (low[rows, axis] + high[rows, axis])
    is_right = center[np.arange(len(center)), axis[segment]] > middle[segment]
    right = np.bincount(segment, is_right, len(counts))
    # All in one place
    is_whole = (right == 0) | (right == counts)
    return np.where(is_whole[segment], halves, is_right)


def _summary(
    lights: Lights, order: np.ndarray, start: np.ndarray, counts: np.ndarray
) -> Lights:
    """What nodes look like from afar. ``order``: their lights, node by node."""
    segment = np.repeat(np.arange(len(counts)), counts)

    def total(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, start, axis=0)

    strength = total(lights.strength[order])
    share = lights.strength[order] / strength[segment]
    center = total(share[:, None] * lights.center[order])
    distance = np.linalg.norm(lights.center[order] - center[segment], axis=1)
    spread = np.sqrt(total(share * (distance**2 + lights.spread[order] ** 2)))
    reach = np.maximum.reduceat(distance + lights.reach[order], start)

    own = lights.axis[order]
    axis = total(share[:, None] * own)
    length, own_length = (np.linalg.norm(a, axis=1) for a in (axis, own))
    cosine = (own * axis[segment]).sum(axis=1)
    cosine /= np.maximum(own_length * length[segment], 1e-300)
    angles = np.arccos(np.clip(cosine, -1, 1)) + lights.angle[order]
    angles[own_length < _LEAST_AXIS] = np.pi
    angle = np.maximum.reduceat(angles, start) + _ANGLE_MARGIN
    angle[length < _LEAST_AXIS] = np.pi
    return Lights(center, spread, reach, axis, np.minimum(angle, np.pi), strength)


def _packed(nodes: Lights) -> np.ndarray:
    """The words of nodes: centre, spread, axis, strength. The last eight bits of the spread hold
    spread / reach, in steps of 1 / 255; the last eight bits of the strength hold the cosine of the
    angle, from −1, in steps of 2 / 255. Both are rounded down, so that a node never seems darker
    than it is."""
    spread, strength = (_cut(x) for x in (nodes.spread, nodes.strength))
    ratio = 255 * spread.astype(np.float64) / np.maximum(nodes.reach, 1e-300)
    cosine = 127.5 * (1 + np.cos(nodes.angle))
    columns = [*nodes.center.T, _with_bits(spread, ratio), *nodes.axis.T]
    return np.stack([*columns, _with_bits(strength, cosine)], axis=1).astype(np.float32)


def _cut(values: np.ndarray) -> np.ndarray:
    """Single precision numbers whose last eight bits are 0."""
    return (values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFFFF00)).view(np.float32)


def _with_bits(values: np.ndarray, bits: np.ndarray) -> np.ndarray:
    bits = np.floor(np.clip(bits, 0, 255)).astype(np.uint32)
    return (values.view(np.uint32) | bits).view(np.float32)
