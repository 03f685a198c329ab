"""The tree of a grid of heights: a quadtree with ranges of heights (Cline 2007, section 3.3.3).

The position of a node in the grid follows from its number. A leaf is a block of 2 x 2 cells, with
eight triangles. An inner node holds the ranges of its four children in 16 bytes: all levels
together take 1.33 bytes per grid cell.

Unlike in the source, the grid may have any size. The nodes of a level form a separate grid, and
children outside the heights have an empty range.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .slabs import ERROR, with_inverse
from .traversal import NONE, Hit, traverse

#: The bits of x and of y in a node's number, which also holds its depth (0 for the root).
_BITS = 14
_MASK, _DEPTH = (1 << _BITS) - 1, 1 << 2 * _BITS

#: The number of bits for the column and for the row of the cell in a triangle's number, which also
#: says which of the two triangles it is.
_CELL_BITS = _BITS + 1
_CELL_MASK = (1 << _CELL_BITS) - 1

#: The maximum number of cells along a side of the grid.
MAX_CELLS = 1 << _CELL_BITS

#: The largest number with which ranges of heights are stored.
_RANGE = 0xFFFF

#: The number of heights read at a time.
_CHUNK = 1 << 20


class Heights:
    """Heights on the device: in single precision, one per word, or with 16 bits.

    Parameters:
        values: Shape (rows, columns); float32, float16 or uint16.
    """

    def __init__(self, values: np.ndarray) -> None:
        self._is_float, self._is_half = values.dtype == np.float32, values.dtype == np.float16
        rows, columns = values.shape
        if not self._is_float:
            # Two neighbours of a row share a word
            padded = np.zeros((rows, columns + columns % 2), dtype="<u2")
            padded[:, :columns] = values.view(np.uint16)
            values = padded.view("<u4")
        self.nbytes = values.nbytes
        self._words = from_numpy(mi.Float if self._is_float else mi.UInt32, values)
        self._stride = mi.UInt32(values.shape[1])
        self.columns, self.rows = mi.UInt32(columns), mi.UInt32(rows)
        # Opaque so that other grids share the kernel
        dr.make_opaque(self._stride, self.columns, self.rows)

    def at(self, column: mi.UInt32, row: mi.UInt32) -> mi.Float:
        """The height of a vertex."""
        if self._is_float:
            return dr.gather(mi.Float, self._words, dr.fma(row, self._stride, column))
        word = self._word(column >> 1, row)
        return self._decoded(word >> ((column & 1) << 4) & 0xFFFF)

    def block(self, x: mi.UInt32, y: mi.UInt32) -> list[list[mi.Float]]:
        """The three rows of heights of a block. Heights outside the grid are arbitrary."""
        rows = [2 * y, 2 * y + 1, dr.minimum(2 * y + 2, self.rows - 1)]
        if self._is_float:
            columns = [2 * x, 2 * x + 1, dr.minimum(2 * x + 2, self.columns - 1)]
            return [[self.at(column, row) for column in columns] for row in rows]
        last = dr.minimum(x + 1, self._stride - 1)
        pairs = [(self._word(x, row), self._word(last, row)) for row in rows]
        return [
            [self._decoded(a & 0xFFFF), self._decoded(a >> 16), self._decoded(b & 0xFFFF)]
            for a, b in pairs
        ]

    def _word(self, column: mi.UInt32, row: mi.UInt32) -> mi.UInt32:
        return dr.gather(mi.UInt32, self._words, dr.fma(row, self._stride, column))

    def _decoded(self, number: mi.UInt32) -> mi.Float:
        if not self._is_half:
            return mi.Float(mi.Int32(number))
        # The exponent bias is 15 in half precision and 127 in single precision
        size = number & 0x7FFF
        normal = dr.reinterpret_array(mi.Float, (size << 13) + ((127 - 15) << 23))
        size = dr.select(size < 1 << 10, mi.Float(mi.Int32(size)) * 2.0**-24, normal)
        return dr.select(number >> 15 != 0, -size, size)


class HeightTree:
    """A tree over heights.

    All coordinates are in the space of the grid, in which a vertex has its column, its row and its
    height as coordinates. They are exact in single precision.

    Parameters:
        values: The heights, finite. Shape (rows, columns), at least (2, 2) and at most
            ``MAX_CELLS`` cells along each side; float32, float16 or uint16.

    Attributes:
        heights (Heights): The heights on the device.
        low, high (float): The lowest and the highest height.
        nbytes (int): The memory of heights and nodes, in bytes.
    """

    def __init__(self, values: np.ndarray) -> None:
        self.heights = Heights(values)
        self.low, self.high = float(values.min()), float(values.max())
        # Rounded up so that no number exceeds the largest one; not zero for equal heights
        unit = max((self.high - self.low) / _RANGE, 1e-30)
        unit = float(np.nextafter(np.float32(unit), np.float32(np.inf)))
        levels, widths = _nodes(*_ranges_of_blocks(values, self.low, unit))
        words = np.concatenate(levels)
        self.nodes = from_numpy(mi.UInt32, words)
        self.nbytes = self.heights.nbytes + words.nbytes
        # For each depth, the nodes of a row and the first node
        starts = np.cumsum([0, *(len(level) // 4 for level in levels)])
        self.levels = from_numpy(mi.UInt32, np.stack([widths, starts[:-1]], axis=1))
        self.depth = mi.UInt32(len(levels))
        self.bottom, self.unit = mi.Float(self.low), mi.Float(unit)
        size = (values.shape[1], values.shape[0], max(abs(self.low), abs(self.high)))
        self.extent = mi.Vector3f(size)
        # Opaque so that the trees of other grids share the kernel
        dr.make_opaque(self.depth, self.bottom, self.unit, self.extent)

    def closest(self, ray: mi.Ray3f, active: mi.Bool) -> Hit:
        """The closest hit before ``ray.maxt`` of each ray, given in the grid's space."""
        ray = dr.detach(ray)
        t, triangle, _ = traverse(_RaysInTree(self, ray), ray, active, any_hit=False)
        x, y, is_right = cell(triangle)
        u = dr.fma(t, ray.d.x, ray.o.x) - mi.Float(mi.Int32(x))
        v = dr.fma(t, ray.d.y, ray.o.y) - mi.Float(mi.Int32(y))
        # Keeps the position inside the triangle despite rounding errors
        u, v = dr.fmin(dr.fmax(u, 0), 1), dr.fmin(dr.fmax(v, 0), 1)  # NaN without a hit
        b, c = dr.select(is_right, u - v, u), dr.select(is_right, v, v - u)
        b, c = dr.maximum(b, 0), dr.maximum(c, 0)
        return t, triangle, mi.Point2f(b, dr.minimum(c, 1 - b))

    def occluded(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Whether there is a hit before ``ray.maxt``."""
        return traverse(_RaysInTree(self, ray), ray, active, any_hit=True)[1] != NONE


def cell(triangle: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Bool]:
    """The column and the row of a triangle's cell, and whether it is the cell's right triangle.

    With the vertices 00, 10 (one column on), 01 (one row on) and 11, the triangles of a cell are
    (00, 11, 01) and, on the right, (00, 10, 11).
    """
    return triangle & _CELL_MASK, triangle >> _CELL_BITS & _CELL_MASK, triangle >> 30 == 1


class _Rays:
    """Rays in the space of the grid."""

    def __init__(self, ray: mi.Ray3f) -> None:
        self.o, self.maxt = ray.o, ray.maxt
        self.d, self.inverse = with_inverse(ray.d)
        # Across the diagonals of cells from 00 to 11
        self.o_diagonal = ray.o.x - ray.o.y
        self.d_diagonal, self.inverse_diagonal = with_inverse(ray.d.x - ray.d.y)


class _RaysInTree:
    """Rays that traverse a tree."""

    root, stack_size = 0, 3 * _BITS

    def __init__(self, tree: HeightTree, ray: mi.Ray3f) -> None:
        self._tree, self._rays = tree, _Rays(ray)
        o, inverse = self._rays.o, self._rays.inverse
        self._error = ERROR * (dr.abs(o) + tree.extent) * dr.abs(inverse)
        self._bottom = (tree.bottom - o.z) * inverse.z
        self._unit = tree.unit * inverse.z

    def is_leaf(self, node):
        return node >= self._tree.depth * _DEPTH

    def children(self, node, maxt):
        depth, x, y = node >> 2 * _BITS, node & _MASK, node >> _BITS & _MASK
        width, start = dr.gather(mi.Array2u, self._tree.levels, depth)
        ranges = dr.gather(mi.Array4u, self._tree.nodes, dr.fma(y, width, x + start))
        # The size of a child in cells, a power of two
        size = dr.reinterpret_array(mi.Float, (self._tree.depth - depth + 127) << 23)
        columns, rows = self._sides(0, x, size), self._sides(1, y, size)
        is_down = self._rays.inverse.z < 0
        start_z, end_z = self._bottom - self._error.z, self._bottom + self._error.z
        boxes = []
        for c, word in enumerate(ranges):
            low, high = word & _RANGE, word >> 16
            near = mi.Float(mi.Int32(dr.select(is_down, high, low)))
            far = mi.Float(mi.Int32(dr.select(is_down, low, high)))
            near, far = dr.fma(near, self._unit, start_z), dr.fma(far, self._unit, end_z)
            (near_x, far_x), (near_y, far_y) = columns[c & 1], rows[c >> 1]
            enter = dr.maximum(dr.maximum(near_x, near_y), dr.maximum(near, 0))
            leave = dr.minimum(dr.minimum(far_x, far_y), dr.minimum(far, maxt))
            # An empty range has its ends swapped
            boxes.append((enter, (enter <= leave) & (low <= high)))
        # Twice x and y
        first = (depth + 1) * _DEPTH | (node & (_DEPTH - 1)) << 1
        return boxes, lambda c: first | c & 1 | c >> 1 << _BITS

    def _sides(self, k: int, node: mi.UInt32, size: mi.Float) -> list[tuple[mi.Float, mi.Float]]:
        """The distances at which rays enter and leave both children of a node along an axis."""
        first, error = 2 * mi.Float(mi.Int32(node)), self._error[k]
        a, b, c = (
            ((first + i) * size - self._rays.o[k]) * self._rays.inverse[k] for i in range(3)
        )
        return [
            (dr.minimum(a, b) - error, dr.maximum(a, b) + error),
            (dr.minimum(b, c) - error, dr.maximum(b, c) + error),
        ]

    def intersect(self, leaf, hit):
        block = _Block(self._rays, self._tree.heights, leaf)
        t, triangle, uv = hit
        for row in range(2):
            for column in range(2):
                t, triangle = block.intersect(column, row, t, triangle)
        return t, triangle, uv


class _Block:
    """The intersections of rays with the cells of a leaf.

    A ray is cut into pieces at the lines of the grid and at the diagonals of its cells. The
    distance of a cut depends only on the ray and the line, and the height above the surface there
    only on the edge. A triangle is hit if the ray is above the surface at one end of its piece and
    not at the other. Neighbouring triangles compute these ends with equal bits, so no ray passes
    between them.

    The test for mesh triangles takes as long. But it depends on angles, and in this space, heights
    are often small compared with cells and nearly all rays graze the surface, so its distances
    would have errors hundreds of times as large.
    """

    def __init__(self, rays: _Rays, heights: Heights, leaf: mi.UInt32) -> None:
        self._rays = rays
        x, y = leaf & _MASK, leaf >> _BITS & _MASK
        self._columns, self._rows = 2 * x, 2 * y
        self._exists = [
            [mi.Bool(True), 2 * x + 2 < heights.columns],
            [mi.Bool(True), 2 * y + 2 < heights.rows],
        ]
        self._heights = heights.block(x, y)
        self._x, self._y = mi.Float(mi.Int32(2 * x)), mi.Float(mi.Int32(2 * y))
        h = self._heights
        # For each line of constant x or y, its distance and the ray's heights above both edges
        self._at_x, self._at_y = [], []
        for k in range(3):
            t = ((self._x + k) - rays.o.x) * rays.inverse.x
            y = dr.fma(t, rays.d.y, rays.o.y) - self._y
            above = [self._above(t, y - r, h[r][k], h[r + 1][k]) for r in range(2)]
            self._at_x.append((t, above))
            t = ((self._y + k) - rays.o.y) * rays.inverse.y
            x = dr.fma(t, rays.d.x, rays.o.x) - self._x
            above = [self._above(t, x - c, h[k][c], h[k][c + 1]) for c in range(2)]
            self._at_y.append((t, above))

    def _above(self, t: mi.Float, along: mi.Float, a: mi.Float, b: mi.Float) -> mi.Float:
        """The height of a ray above an edge at a distance."""
        # The surface stays between both heights, and equals each of them bit for bit at its end
        along = dr.clip(along, 0, 1)
        return dr.fma(t, self._rays.d.z, self._rays.o.z) - dr.fma(along, b, (1 - along) * a)

    def intersect(
        self, column: int, row: int, t: mi.Float, triangle: mi.UInt32
    ) -> tuple[mi.Float, mi.UInt32]:
        """The closest of a previous hit and the hits in a cell."""
        rays = self._rays
        start, end, above_start, above_end = self._piece(column, row)
        (h00, h10), (h01, h11) = (self._heights[r][column : column + 2] for r in (row, row + 1))
        x, y = self._x + column, self._y + row
        cut = ((x - y) - rays.o_diagonal) * rays.inverse_diagonal
        above_cut = self._above(cut, dr.fma(cut, rays.d.x, rays.o.x) - x, h00, h11)
        above_cut = dr.select(cut <= start, above_start, above_cut)
        above_cut = dr.select(cut >= end, above_end, above_cut)
        cut = dr.minimum(dr.maximum(cut, start), end)
        # The slopes of the triangles in front of and behind the diagonal
        is_right = rays.d_diagonal < 0
        left, right = (h11 - h01, h01 - h00), (h10 - h00, h11 - h10)
        first = [dr.select(is_right, a, b) for a, b in zip(right, left)]
        second = [dr.select(is_right, b, a) for a, b in zip(right, left)]
        o = rays.o.x - x, rays.o.y - y, rays.o.z - h00
        exists = self._exists[0][column] & self._exists[1][row] & (start <= end)
        t_1, t_2 = self._crossing(o, first, start, cut), self._crossing(o, second, cut, end)
        is_hit_1 = ((above_start >= 0) != (above_cut >= 0)) & (t_1 >= 0) & (t_1 < t)
        is_hit_2 = ((above_cut >= 0) != (above_end >= 0)) & (t_2 >= 0) & (t_2 < t)
        is_hit = exists & (is_hit_1 | is_hit_2)
        index = (self._columns + column) | (self._rows + row) << _CELL_BITS
        index |= mi.UInt32(dr.select(is_hit_1 == is_right, 1 << 2 * _CELL_BITS, 0))
        new = dr.select(is_hit_1, t_1, t_2)
        return dr.select(is_hit, new, t), dr.select(is_hit, index, triangle)

    def _piece(self, column: int, row: int) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        """The distances where a ray enters and leaves a cell, and its heights above the surface."""
        ends = []
        for lines, k, edge, d in (
            (self._at_x, column, row, self._rays.d.x), (self._at_y, row, column, self._rays.d.y)
        ):  # fmt: skip
            (t_a, above_a), (t_b, above_b) = lines[k], lines[k + 1]
            a, b = above_a[edge], above_b[edge]
            is_forward = d > 0
            ends.append((
                dr.minimum(t_a, t_b), dr.maximum(t_a, t_b),
                dr.select(is_forward, a, b), dr.select(is_forward, b, a),
            ))  # fmt: skip
        (start_x, end_x, first_x, last_x), (start_y, end_y, first_y, last_y) = ends
        return (
            dr.maximum(start_x, start_y), dr.minimum(end_x, end_y),
            dr.select(start_x > start_y, first_x, first_y),
            dr.select(end_x <= end_y, last_x, last_y),
        )  # fmt: skip

    def _crossing(self, o, slopes, start: mi.Float, end: mi.Float) -> mi.Float:
        """The distance of a plane through the vertex 00, relative to which ``o`` is given."""
        d = self._rays.d
        above = dr.fma(-slopes[0], o[0], dr.fma(-slopes[1], o[1], o[2]))
        change = dr.fma(-slopes[0], d.x, dr.fma(-slopes[1], d.y, d.z))
        # For a ray in the plane, the quotient may even be NaN, which these functions discard
        return dr.fmin(dr.fmax(-above / change, start), end)


def _ranges_of_blocks(
    values: np.ndarray, low: float, unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest height of each block, as numbers. Shape (y, x) each, uint16."""
    rows, columns = (n // 2 for n in values.shape)
    lows, highs = (np.empty((rows, columns), dtype=np.uint16) for _ in range(2))
    step = max(1, _CHUNK // (2 * values.shape[1]))
    for first in range(0, rows, step):
        part = values[2 * first : 2 * (first + step) + 1].astype(np.float32)
        for union, rounded, numbers in (
            (np.minimum, np.floor, lows), (np.maximum, np.ceil, highs)
        ):  # fmt: skip
            of_rows = _unions(union, part)
            of_blocks = _unions(union, of_rows.T).T.astype(np.float64)
            numbers[first : first + step] = rounded((of_blocks - low) / unit)
    return lows, highs


def _unions(union: np.ufunc, values: np.ndarray) -> np.ndarray:
    """The union of rows 0 to 2, of rows 2 to 4, and so on; the last may be of two rows."""
    result = union(values[:-1:2], values[1::2])
    last = values[2::2]
    union(result[: len(last)], last, out=result[: len(last)])
    return result


def _nodes(lows: np.ndarray, highs: np.ndarray) -> tuple[list[np.ndarray], list[int]]:
    """The words of the nodes of each depth, and the number of nodes per row there."""
    levels, widths = [], []
    while not levels or lows.size > 1:
        # Pads to even numbers of rows and columns
        pad = [(0, n % 2) for n in lows.shape]
        lows = np.pad(lows, pad, constant_values=_RANGE)
        highs = np.pad(highs, pad, constant_values=0)
        y, x = (n // 2 for n in lows.shape)
        words = lows | highs.astype(np.uint32) << 16
        levels.append(words.reshape(y, 2, x, 2).transpose(0, 2, 1, 3).ravel())
        widths.append(x)
        lows = lows.reshape(y, 2, x, 2).min(axis=(1, 3))
        highs = highs.reshape(y, 2, x, 2).max(axis=(1, 3))
    return levels[::-1], widths[::-1]
