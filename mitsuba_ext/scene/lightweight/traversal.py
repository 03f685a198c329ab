"""Traverses a tree: nearer children first, the others on a stack (Cline 2007, section 3.3.4)."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi

#: Stands for no node or no triangle; also the key of a child that a ray misses.
NONE = 0xFFFFFFFF

#: The bits of a key that hold a distance; the others hold the index of the child.
_DISTANCE = 0xFFFFFFFC

#: The closest hit so far: its distance, or the end of the ray; its triangle, or ``NONE``; and its
#: barycentric coordinates.
Hit = "tuple[mi.Float, mi.UInt32, mi.Point2f]"  # in quotes because there may be no variant yet

#: For each child, the nonnegative distance of its box and whether the ray meets it; and a function
#: that returns the child with an index from 0 to 3.
Children = "tuple[list[tuple[mi.Float, mi.Bool]], Callable[[mi.UInt32], mi.UInt32]]"


class Tree(Protocol):
    """A tree as seen by one set of rays."""

    #: The root, which is not a leaf.
    root: int

    #: The maximum number of children that wait while others are visited.
    stack_size: int

    def is_leaf(self, node: mi.UInt32) -> mi.Bool:
        """Whether ``node`` holds triangles."""

    def children(self, node: mi.UInt32, maxt: mi.Float) -> Children:
        """The children of an inner node, and which of them rays meet before ``maxt``."""

    def intersect(self, leaf: mi.UInt32, hit: Hit) -> Hit:
        """The closest of a previous hit and the hits in a leaf."""


def traverse(tree: Tree, ray: mi.Ray3f, active: mi.Bool, any_hit: bool) -> Hit:
    """The closest hit of each ray before ``ray.maxt``; with ``any_hit``, the first that is found.
    """

    def pop(node, size, stack, maxt):
        """Takes the latest node from the stack in lanes without a node."""
        pops = (node == NONE) & (size > 0)
        size = dr.select(pops, size - 1, size)
        key, stored = stack.read(size, pops)
        # Skips what lies behind the closest hit so far
        is_near = dr.reinterpret_array(mi.Float, key & _DISTANCE) <= maxt
        return dr.select(pops & is_near, stored, node), size

    def visit(node, size, stack, maxt):
        boxes, child = tree.children(node, maxt)
        keys = [
            dr.select(is_met, dr.reinterpret_array(mi.UInt32, near) & _DISTANCE | c, NONE)
            for c, (near, is_met) in enumerate(boxes)
        ]
        nearest, *others = _sorted(keys)
        for key in reversed(others):
            is_met = key != NONE
            stack.write(mi.Array2u(key, child(key & 3)), size, is_met)
            size = dr.select(is_met, size + 1, size)
        node = dr.select(nearest != NONE, child(nearest & 3), NONE)
        return node, size, stack, maxt

    def descend(searches, node, size, stack, maxt):
        node, size, stack, maxt = dr.if_stmt(
            (node, size, stack, maxt), searches & (node != NONE), visit, lambda *state: state
        )
        node, size = pop(node, size, stack, maxt)
        searches &= dr.select(node == NONE, size > 0, ~tree.is_leaf(node))
        return searches, node, size, stack, maxt

    def body(active, node, size, stack, hit):
        # Rays wait at their next leaf for the others of their group
        searches = active & dr.select(node == NONE, size > 0, ~tree.is_leaf(node))
        state = (searches, node, size, stack, hit[0])
        _, node, size, stack, _ = dr.while_loop(
            state, lambda searches, *_: searches, descend, label="descend"
        )
        node, hit = dr.if_stmt(
            (node, hit), active & (node != NONE),
            lambda node, hit: (mi.UInt32(NONE), tree.intersect(node, hit)),
            lambda *state: state,
        )  # fmt: skip
        active &= size > 0
        if any_hit:
            active &= hit[1] == NONE
        return active, node, size, stack, hit

    # The index of the hit triangle is not differentiable
    ray = dr.detach(ray)
    width = dr.width(ray)
    hit = (mi.Float(ray.maxt), dr.full(mi.UInt32, NONE, width), dr.zeros(mi.Point2f, width))
    node, size = dr.full(mi.UInt32, tree.root, width), dr.zeros(mi.UInt32, width)
    stack = dr.alloc_local(mi.Array2u, tree.stack_size)
    state = (mi.Bool(active), node, size, stack, hit)
    return dr.while_loop(state, lambda active, *_: active, body, label="lightweight")[4]


def _sorted(keys: list[mi.UInt32]) -> list[mi.UInt32]:
    a, b, c, d = keys
    a, b, c, d = dr.minimum(a, b), dr.maximum(a, b), dr.minimum(c, d), dr.maximum(c, d)
    a, c, b, d = dr.minimum(a, c), dr.maximum(a, c), dr.minimum(b, d), dr.maximum(b, d)
    return [a, dr.minimum(b, c), dr.maximum(b, c), d]
