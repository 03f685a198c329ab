"""Traverses a tree: nearer children first, with the others on a stack (Cline 2007, section
3.3.4)."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi

#: No node, no triangle; the key of a child that a ray misses.
NONE = 0xFFFFFFFF

#: A node puts up to three children on the stack, for each of its levels.
_STACK_SIZE = 48

#: The bits of a key that hold a distance; the others number the child.
_DISTANCE = 0xFFFFFFFC

#: The closest hit so far: its distance, or the end of the ray; its triangle, or ``NONE``; and its
#: barycentric coordinates.
Hit = "tuple[mi.Float, mi.UInt32, mi.Point2f]"  # in quotes, as there may be no variant yet


class Tree(Protocol):
    """What is traversed, for one set of rays."""

    #: The root.
    root: int

    def is_leaf(self, node: mi.UInt32) -> mi.Bool:
        """Does ``node`` hold triangles?"""

    def child(self, node: mi.UInt32, number: mi.UInt32) -> mi.UInt32:
        """The child with a number from 0 to 3."""

    def distances(self, node: mi.UInt32, maxt: mi.Float) -> list[tuple[mi.Float, mi.Bool]]:
        """For each child of ``node``, the distance of its box, not negative, and whether the ray
        meets it before ``maxt``."""

    def intersect(self, leaf: mi.UInt32, hit: Hit) -> Hit:
        """The closest hit, with those of a leaf."""


def traverse(tree: Tree, ray: mi.Ray3f, active: mi.Bool, any_hit: bool) -> Hit:
    """The closest hit of each ray before ``ray.maxt``; with ``any_hit``, the first that is found.
    """

    def visit(node, size, stack, maxt):
        keys = [
            dr.select(is_met, dr.reinterpret_array(mi.UInt32, near) & _DISTANCE | c, NONE)
            for c, (near, is_met) in enumerate(tree.distances(node, maxt))
        ]
        nearest, *others = _sorted(keys)
        for key in reversed(others):
            is_met = key != NONE
            stack.write(mi.Array2u(key, tree.child(node, key & 3)), size, is_met)
            size = dr.select(is_met, size + 1, size)
        node = dr.select(nearest != NONE, tree.child(node, nearest & 3), NONE)
        return node, size, stack, maxt

    def body(active, node, size, stack, hit):
        is_leaf = tree.is_leaf(node)
        node, size, stack, _ = dr.if_stmt(
            (node, size, stack, hit[0]), active & ~is_leaf, visit, lambda *state: state
        )
        node, hit = dr.if_stmt(
            (node, hit), active & is_leaf & (node != NONE),
            lambda node, hit: (mi.UInt32(NONE), tree.intersect(node, hit)),
            lambda *state: state,
        )  # fmt: skip
        # Continue with the latest node on the stack
        pops = active & (node == NONE)
        active &= ~pops | (size > 0)
        if any_hit:
            active &= hit[1] == NONE
        pops &= active
        size = dr.select(pops, size - 1, size)
        key, stored = stack.read(size, pops)
        # What lies behind the closest hit so far is skipped
        is_near = dr.reinterpret_array(mi.Float, key & _DISTANCE) <= hit[0]
        node = dr.select(pops, dr.select(is_near, stored, NONE), node)
        return active, node, size, stack, hit

    # Which triangle is hit does not depend smoothly on anything
    ray = dr.detach(ray)
    width = dr.width(ray)
    hit = (mi.Float(ray.maxt), dr.full(mi.UInt32, NONE, width), dr.zeros(mi.Point2f, width))
    node, size = dr.full(mi.UInt32, tree.root, width), dr.zeros(mi.UInt32, width)
    stack = dr.alloc_local(mi.Array2u, _STACK_SIZE)
    state = (mi.Bool(active), node, size, stack, hit)
    return dr.while_loop(state, lambda active, *_: active, body, label="lightweight")[4]


def _sorted(keys: list[mi.UInt32]) -> list[mi.UInt32]:
    a, b, c, d = keys
    a, b, c, d = dr.minimum(a, b), dr.maximum(a, b), dr.minimum(c, d), dr.maximum(c, d)
    a, c, b, d = dr.minimum(a, c), dr.maximum(a, c), dr.minimum(b, d), dr.maximum(b, d)
    return [a, dr.minimum(b, c), dr.maximum(b, c), d]
