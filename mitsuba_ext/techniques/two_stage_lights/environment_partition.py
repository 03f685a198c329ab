"""Partitions of an environment, one for each vertex: rectangles with the value of the BSDF at their
corners.

Source: Cline, PhD dissertation, section 5.2.2. Instead of a queue ordered by split potential,
rectangles are visited once, in the order in which they were made. Instead of neighbour cascades,
BSDF samples that lie in a rectangle find lobes that its corners miss.

Writes to local memory are indexed by the loop counter only, reads may use any index: on CPUs,
Dr.Jit 1.5 assumes that an index that enters a loop as a literal is the same in all lanes of a
packet, and writes at the largest one.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...scene.lights.texel_sums import Corners, Rectangle, TexelSums, part_of
from ...transport.bsdfs import eval_bsdf, sample_bsdf
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from ...util.spectra import brightness
from .environment_visibility import Tile, WorldVisibility
from .partition_parts import Branch, Node, Partition, Peak

#: The first rectangles of each partition: at least this number of columns and rows.
_GRID = (4, 2)

#: Where the values at the corners vary by less than the root of this, relative to their mean, they
#: do not decide across which axis to divide.
_LITTLE = 1e-2

#: Splits of a partition, at most: local memory is small.
MOST_SPLITS = 1024

#: BSDF samples that look for lobes.
_PEAKS = 8

#: A peak counts for a rectangle if it lies in the rectangle enlarged by this factor, and by this
#: number of half texels.
_REACH, _BORDER = 1.25, 2

#: Where a BSDF sample inside a rectangle exceeds the corners, this share of the excess is added to
#: the whole rectangle.
_LIFT = 0.25

#: A rectangle is divided if its potential exceeds this share of the total weight, divided by the
#: largest number of divisions.
_THRESHOLD = 0.25

#: The share of defensive sampling, by emission without the BSDF.
_DEFENSIVE = 0.01

#: Steps of the lattice from which BSDF samples are drawn.
_STEPS = 0.7548776662, 0.5698402910, 0.6180339887


class Partitioner:
    """Makes partitions, and draws directions from them.

    Parameters:
        sums: Sums over the texels of the environment.
        ctx: The context for calls of BSDFs.
        splits: How often rectangles of a partition are divided, at most, beyond the first ones.
        visibility: The learned visibility of the environment, by which rectangles are weighted.
    """

    def __init__(
        self, sums: TexelSums, ctx: mi.BSDFContext, splits: int,
        visibility: WorldVisibility | None = None,
    ) -> None:  # fmt: skip
        self._sums, self._ctx, self._texels = sums, ctx, sums.texels
        self._visibility = visibility
        # The largest size of the first rectangles
        self._width, self._height = (
            max(1, -(-count // parts))
            for count, parts in zip((self._texels.columns, self._texels.rows), _GRID)
        )
        self._splits = _GRID[0] * _GRID[1] + splits
        # The sun's emission, in units of all other
        self._sun_share = self._texels.sun_emission() / sums.emission

    # ---- Making a partition ----

    @dr.syntax
    def partition(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool, tile: Tile | None = None
    ) -> Partition:
        """The partition of the vertex ``si``; ``tile`` selects the maps of visibility."""
        nodes = dr.alloc_local(Node, 1 + 2 * self._splits)
        potentials = dr.alloc_local(mi.Float, 1 + 2 * self._splits)
        parents = dr.alloc_local(mi.UInt32, self._splits)
        local = self._peaks(si, active)
        # In registers: each rectangle is compared with all of them
        peaks = [local.read(mi.UInt32(i), active) for i in range(_PEAKS)]
        root = self._root(si, active)
        zero = mi.UInt32(0)
        whole, potential = self._node(root, peaks, tile, active)
        nodes.write(whole, zero, active)
        potentials.write(potential, zero, active)
        total, split, next, count = mi.Float(whole.weight), mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
        # Accesses to local memory do not apply the loop's own mask: it must be given
        working = mi.Bool(active)
        while dr.hint(working, label="partition"):
            end = 2 * split + 1
            threshold = total * (_THRESHOLD / self._splits)
            next = self._next(potentials, next, end, threshold, working)
            divides = working & (next < end)
            node = nodes.read(next, divides)
            halves = self._divided(si, node, divides)
            (low, of_low), (high, of_high) = (
                self._node(half, peaks, tile, divides) for half in halves
            )
            nodes.write(low, end, divides)
            nodes.write(high, end + 1, divides)
            potentials.write(of_low, end, divides)
            potentials.write(of_high, end + 1, divides)
            parents.write(next, split, divides)
            total += dr.select(divides, low.weight + high.weight - node.weight, 0)
            next += 1
            split += 1
            count = dr.select(divides, split, count)
            working = divides & (split < self._splits)
        # The emission of all texels adds up to 1
        floor = dr.maximum(total * (_DEFENSIVE / (1 - _DEFENSIVE)), 1e-20)
        branches = self._branches(nodes, parents, count, floor, active)
        sun = mi.Float(0)
        if dr.hint(self._sun_share > 0, mode="scalar"):
            sun = self._value(si, self._texels.sun.direction, active) + floor
            sun *= self._sun_share
            sun = sun / (sun + total + floor)
        return Partition(nodes, branches, floor, sun)

    @dr.syntax
    def _next(self, potentials, index, end, threshold, active) -> mi.UInt32:
        """The next rectangle to be divided; ``end`` if there is none."""
        index = mi.UInt32(index)
        searching = active & (index < end)
        while dr.hint(searching, label="potential"):
            searching &= potentials.read(index, searching) <= threshold
            index += dr.select(searching, mi.UInt32(1), 0)
            searching &= index < end
        return index

    def _value(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The brightness of the BSDF's value, cosine included, in the direction ``d``."""
        value = brightness(eval_bsdf(si.bsdf(), self._ctx, si, si.to_local(d), active)[0])
        return dr.select(active & (value > 0) & dr.isfinite(value), value, 0)

    def _corner(self, si, x: mi.UInt32, y: mi.UInt32, active) -> mi.Float:
        return self._value(si, self._texels.node_direction(x, y), active)

    @dr.syntax
    def _peaks(self, si, active) -> Any:
        """The directions of BSDF samples: texel of the environment, and value of the BSDF."""
        peaks = dr.alloc_local(Peak, _PEAKS)
        bsdf, index, working = si.bsdf(), mi.UInt32(0), mi.Bool(active)
        while dr.hint(working, label="peaks"):
            i = mi.Float(index) + 0.5
            x, y, z = (i * step - dr.floor(i * step) for step in _STEPS)
            bs, _weight = sample_bsdf(bsdf, self._ctx, si, z, mi.Point2f(x, y), working)
            is_smooth = working & (bs.pdf > 0)
            is_smooth &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            d = si.to_world(bs.wo)
            column, row, _point, _sine = self._texels.find(d)
            peaks.write(Peak(column, row, self._value(si, d, is_smooth)), index, working)
            index += 1
            working &= index < _PEAKS
        return peaks

    def _root(self, si, active) -> Rectangle:
        columns, rows = mi.UInt32(self._texels.columns), mi.UInt32(self._texels.rows)
        zero = mi.UInt32(0)
        # All directions of a pole are one
        top, bottom = (self._corner(si, zero, y, active) for y in (zero, rows))
        f = Corners(top, top, bottom, bottom)
        return self._sums.rectangle(zero, zero, columns, rows, f, active)

    def _divided(self, si, node: Node, active) -> tuple[Rectangle, Rectangle]:
        whole = self._rectangle(node, active)
        width, height = whole.x1 - whole.x0, whole.y1 - whole.y0
        # Eq. 5.4 (Cline). Where corners hardly differ, the longer side
        f = whole.f
        dx = dr.square(f.v10 - f.v00) + dr.square(f.v11 - f.v01)
        dy = dr.square(f.v01 - f.v00) + dr.square(f.v11 - f.v10)
        little = dr.maximum(_LITTLE * dr.square(f.mean), 1e-30)
        by_x = (dx + little) * mi.Float(width) > (dy + little) * mi.Float(height)
        is_wide = mi.Float(width) * self._height > mi.Float(height) * self._width
        by_x = dr.select(self._is_large(whole), is_wide, by_x)
        by_x = (by_x | (height < 2)) & (width > 1)
        ends = self._sums.middle(whole, by_x)
        f_low, f_high = (self._corner(si, x, y, active) for x, y in ends)
        return self._sums.divide(whole, by_x, f_low, f_high, active)

    def _is_large(self, r: Rectangle) -> mi.Bool:
        return (r.x1 - r.x0 > self._width) | (r.y1 - r.y0 > self._height)

    def _rectangle(self, node: Node, active) -> Rectangle:
        x0, x1, y0, y1 = node.x & 0xFFFF, node.x >> 16, node.y & 0xFFFF, node.y >> 16
        return self._sums.rectangle(x0, y0, x1, y1, node.f, active)

    def _node(self, r: Rectangle, peaks, tile, active) -> tuple[Node, mi.Float]:
        """A rectangle for local memory, and its split potential: Eq. 5.3 (Cline), with the range
        instead of the deviation, and without the area."""
        values = (r.f.v00, r.f.v10, r.f.v01, r.f.v11)
        least, most, peak = values[0], values[0], mi.Float(0)
        for value in values[1:]:
            least, most = dr.minimum(least, value), dr.maximum(most, value)
        # The lobe around a peak just outside of the border reaches into the rectangle
        x_sum, y_sum = mi.Float(r.x0 + r.x1), mi.Float(r.y0 + r.y1)
        width = _REACH * mi.Float(r.x1 - r.x0) + _BORDER
        height = _REACH * mi.Float(r.y1 - r.y0) + _BORDER
        for p in peaks:
            is_inside = dr.abs(2 * mi.Float(p.column) + 1 - x_sum) <= width
            is_inside &= dr.abs(2 * mi.Float(p.row) + 1 - y_sum) <= height
            peak = dr.maximum(peak, dr.select(is_inside, p.value, 0))
        lift = _LIFT * dr.maximum(peak - most, 0)
        share, range = r.share, dr.maximum(most, peak) - least
        potential = share * range
        if self._visibility is not None:
            seen, deviation = self._visibility.seen(tile, r.x0, r.y0, r.x1, r.y1, active)
            potential = share * (seen * range + 2 * deviation * (r.f.mean + lift))
            share *= seen
        is_texel = (r.x1 - r.x0 <= 1) & (r.y1 - r.y0 <= 1)
        potential = dr.select(is_texel, 0, potential)
        potential = dr.select(self._is_large(r), dr.largest(mi.Float), potential)
        x, y = r.x0 | (r.x1 << 16), r.y0 | (r.y1 << 16)
        return Node(x, y, r.f, lift, share), potential

    @dr.syntax
    def _branches(self, nodes, parents, count: mi.UInt32, floor: mi.Float, active) -> Any:
        """The tree, with weights summed from the leaves. Children have larger indices than their
        parents, which were divided in the order of their indices: one backward pass suffices."""
        branches = dr.alloc_local(Branch, 1 + 2 * self._splits)
        sums = dr.alloc_local(mi.Float, self._splits)
        # Of the splits that are left, the last one
        split, last = mi.UInt32(self._splits), mi.UInt32(count)
        working = mi.Bool(active)
        while dr.hint(working, label="branches"):
            split -= 1
            inside = working & (split < count)
            second, last = self._branch(nodes, parents, sums, 2 * split + 2, last, floor, inside)
            branches.write(second, 2 * split + 2, inside)
            first, last = self._branch(nodes, parents, sums, 2 * split + 1, last, floor, inside)
            branches.write(first, 2 * split + 1, inside)
            sums.write(first.weight + second.weight, split, inside)
            working &= split > 0
        zero = mi.UInt32(0)
        root, last = self._branch(nodes, parents, sums, zero, last, floor, active)
        branches.write(root, zero, active)
        return branches

    def _branch(self, nodes, parents, sums, index, last, floor, active):
        """The branch of a rectangle, and the number of splits that are left."""
        is_left = active & (last > 0)
        is_divided = is_left & (parents.read(last - 1, is_left) == index)
        last = last - dr.select(is_divided, mi.UInt32(1), 0)
        node = nodes.read(index, active)
        weight = dr.select(
            is_divided, sums.read(last, is_divided), node.weight + node.share * floor
        )
        return Branch(weight, dr.select(is_divided, 2 * last + 1, 0)), last

    # ---- Drawing from it ----

    @dr.syntax
    def sample(
        self, made: Partition, point: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Point2f, mi.Float]:
        """A direction (in world space), its ``uv``, and its density."""
        in_sun, x, y = mi.Bool(False), mi.Float(point.x), mi.Float(point.y)
        if dr.hint(self._sun_share > 0, mode="scalar"):
            in_sun, x = _choose(made.sun, x)
        nodes, branches, index = made.nodes, made.branches, mi.UInt32(0)
        branch, columns = branches.read(index, active), nodes.read(index, active).x
        root = mi.Float(branch.weight)
        working = active & (branch.link != 0)
        while dr.hint(working, label="tree"):
            low, high = (branches.read(branch.link + i, working) for i in (0, 1))
            # A part differs from the whole in only one of x and y
            of_low, of_high = (nodes.read(branch.link + i, working).x for i in (0, 1))
            by_x = of_low != columns
            is_low, number = _choose(low.weight / branch.weight, dr.select(by_x, x, y))
            x, y = dr.select(by_x, number, x), dr.select(by_x, y, number)
            index = branch.link + dr.select(is_low, mi.UInt32(0), 1)
            branch, columns = dr.select(is_low, low, high), dr.select(is_low, of_low, of_high)
            working &= branch.link != 0
        leaf = self._leaf(nodes.read(index, active), made.floor, active)
        d, uv, density = self._sums.sample(leaf, mi.Point2f(x, y), active)
        density *= branch.weight / root
        if dr.hint(self._sun_share > 0, mode="scalar"):
            d = dr.select(in_sun, self._texels.sun.sample(mi.Point2f(x, point.y)), d)
            is_lost = ~in_sun & self._texels.sun.contains(d)
            by_sun = made.sun / self._texels.sun.solid_angle
            density = dr.select(
                in_sun, by_sun, dr.select(is_lost, 0, (1 - made.sun) * density)
            )
        return d, uv, density

    def pdf(self, made: Partition, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The density with which :meth:`sample` gives the direction ``d``."""
        return self.invert(made, d, active)[1]

    @dr.syntax
    def invert(
        self, made: Partition, d: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float]:
        """The random numbers with which :meth:`sample` gives the direction ``d``, and its density.
        """
        column, row, point, sin_theta = self._texels.find(d)
        nodes, branches, index = made.nodes, made.branches, mi.UInt32(0)
        branch, columns = branches.read(index, active), nodes.read(index, active).x
        root, first, size = mi.Float(branch.weight), mi.Point2f(0), mi.Point2f(1)
        working = active & (branch.link != 0)
        while dr.hint(working, label="tree"):
            low = nodes.read(branch.link, working)
            # The direction lies in the whole
            is_low = (column < (low.x >> 16)) & (row < (low.y >> 16))
            index = branch.link + dr.select(is_low, mi.UInt32(0), 1)
            part = branches.read(index, working)
            by_x = low.x != columns
            first, size = part_of(first, size, by_x, is_low, part.weight / branch.weight)
            branch, columns = part, nodes.read(index, working).x
            working &= branch.link != 0
        leaf = self._leaf(nodes.read(index, active), made.floor, active)
        number, density = self._sums.invert(leaf, column, row, point, sin_theta, active)
        number = first + size * number
        density *= branch.weight / root
        if dr.hint(self._sun_share > 0, mode="scalar"):
            sun = self._texels.sun
            in_sun, by_sun = sun.contains(d), made.sun / sun.solid_angle
            density = dr.select(in_sun, by_sun, (1 - made.sun) * density)
            of_sun = sun.invert(d)
            number = dr.select(
                in_sun,
                mi.Point2f(made.sun * of_sun.x, of_sun.y),
                mi.Point2f(dr.lerp(made.sun, 1, number.x), number.y),
            )
        return number, dr.select(active, density, 0)

    def _leaf(self, node: Node, floor: mi.Float, active) -> Rectangle:
        leaf = self._rectangle(node, active)
        f, floor = leaf.f, floor + node.lift
        leaf.f = Corners(f.v00 + floor, f.v10 + floor, f.v01 + floor, f.v11 + floor)
        return leaf


def _choose(probability: mi.Float, number: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Whether the first of two is chosen; the rest of the random number, stretched to [0, 1)."""
    is_first = number < probability
    number = number - dr.select(is_first, 0, probability)
    number /= dr.select(is_first, probability, 1 - probability)
    return is_first, dr.clip(number, 0, ONE_MINUS_EPSILON)
