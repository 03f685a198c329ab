"""Choosing points of the aperture by visibility: light paths are connected to the part of the lens
that depth maps show to be unoccluded."""

from __future__ import annotations

import itertools
import math

import drjit as dr
import mitsuba as mi

from ...transport.numbers import hashed
from ...transport.path_decisions import SceneQuery
from .depth_maps import DepthMaps
from .sensor import UniformLens

#: Pieces of the aperture along each edge of a square, and largest number of pixels along the longer
#: edge of a map: for a lens that blurs little, and for one that blurs much.
_SHARP, _BLURRED = (4, 256), (8, 128)

#: A lens with more parallax than this, in units of the film's longer edge, blurs much.
_MUCH_PARALLAX = 0.1

#: Largest number of cells · pieces, and of slices. A cell takes 4 bytes. A cell that holds surfaces
#: takes one more byte for each piece, and 5 more while the table is computed: 100 MiB in the worst
#: case.
_MOST_ENTRIES, _MOST_SLICES = 1 << 24, 64

#: Slices for each pixel of parallax, in pixels of a map.
_SLICES_PER_PIXEL = 2.0

#: Lookups in the maps for each cell and piece, along each edge of a square around the cell; and the
#: size of this square in units of the cell.
_TAPS, _WIDTH = 3, 2.0

#: The powers of its inverse are the steps of a low-discrepancy sequence in five dimensions (the
#: root of x⁶ = x + 1; M. Roberts, *The Unreasonable Effectiveness of Quasirandom Sequences*, 2018).
_STEP = 1.1347241384015194

#: Added to the number of these lookups that see the point, because all of them may miss it.
_PRIOR = 0.3

#: Largest distance by which the table extends beyond the film, in units of the film's size.
_WIDEST_MARGIN = 1.0

#: With less parallax than this, in pixels of the film, points of the aperture are chosen uniformly.
_LEAST_PARALLAX = 2.0


def visibility_lens(scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery) -> UniformLens:
    """The choice of points of the aperture of a ``thinlens``: by visibility, or uniformly if the
    visible surfaces have so little parallax that all of the lens sees the same."""
    parallax = DepthMaps(scene, sensor, query, pieces=2, most_pixels=64).parallax
    if parallax * max(sensor.film().crop_size()) < _LEAST_PARALLAX:
        return UniformLens()
    pieces, most_pixels = _BLURRED if parallax > _MUCH_PARALLAX else _SHARP
    lens = VisibilityLens(DepthMaps(scene, sensor, query, pieces, most_pixels))
    mi.Log(mi.LogLevel.Info, f"Table of what the lens sees: {lens.bytes / 2**20:.1f} MiB")
    return lens


class VisibilityLens(UniformLens):
    """Chooses points of the aperture by a table of visibilities, which is computed from depth maps.

    The view from the middle of the lens is divided into cells: rectangles of the film, times slices
    of the inverse depth. Equal steps of the inverse depth have equal parallax. For each cell that
    holds surfaces, the table has the probabilities with which its points are connected to each
    piece of the aperture. These are never zero, so the estimate is unbiased even where the maps are
    wrong.

    If the fraction v of a piece is visible, its probability is proportional to √v. If it is chosen
    with the probability q, it contributes v / q to the second moment of the estimate. The sum of
    these is smallest with √v.

    Source: J. J. Guo, PhD thesis, TU Delft, section 5.3.3, Algorithm 5. The algorithm there reads
    the depth maps for each point, and uses v as the probability.

    Attributes:
        shape (tuple[int, int, int]): Number of cells along x and y of the film, and of slices.
        bytes (int): Memory of the table.
    """

    def __init__(self, maps: DepthMaps) -> None:
        self._maps, self._pieces, self._count = maps, maps.pieces, maps.pieces**2
        margins = [min(_WIDEST_MARGIN, margin) for margin in maps.margins]
        slices = math.ceil(_SLICES_PER_PIXEL * maps.parallax * max(maps.shape))
        slices = max(4, min(_MOST_SLICES, slices))
        self.shape = (*_cells(maps.shape, margins, _MOST_ENTRIES // (self._count * slices)), slices)
        # From places to cells
        scale = [n / (1 + 2 * margin) for n, margin in zip(self.shape, margins)]
        self._offset = mi.Point3f(-margins[0], -margins[1], maps.farthest)
        self._scale = mi.Vector3f(*scale, slices / (maps.nearest - maps.farthest))
        self._size = mi.Vector3u(self.shape)
        dr.make_opaque(self._offset, self._scale, self._size)
        self._rows = self._occupied()
        self._words = self._table()
        self.bytes = 4 * (len(self._rows) + len(self._words))

    def sample(self, sample, si, active):
        weights, total = self._weights(si.p, active)
        x, before = sample.x * mi.Float(total), mi.UInt32(0)
        piece, start, chosen = mi.UInt32(0), mi.UInt32(0), weights[0]
        for k, weight in enumerate(weights):
            is_reached = mi.Float(before) <= x
            piece = dr.select(is_reached, k, piece)
            start = dr.select(is_reached, before, start)
            chosen = dr.select(is_reached, weight, chosen)
            before += weight
        # Reuse the number: it is uniform within the chosen interval
        x = (x - mi.Float(start)) / mi.Float(chosen)
        numbers = self._maps.lens_numbers(piece, mi.Point2f(x, sample.y))
        return numbers, mi.Float(total) / mi.Float(self._count * chosen)

    def _weights(self, p: mi.Point3f, active: mi.Bool) -> tuple[list[mi.UInt32], mi.UInt32]:
        """Positive integers in proportion to the probabilities of the pieces for the point ``p``;
        and their sum."""
        place = self._maps.place(p)
        cell, inside = self._cell(place)
        active = active & (place.z > 0) & inside
        row = dr.gather(mi.UInt32, self._rows, self._index(cell), active)
        active &= row > 0
        words = dr.gather(
            mi.ArrayXu, self._words, row - 1, active, shape=(self._count // 4, dr.width(active))
        )
        weights = []
        for i in range(self._count // 4):
            word = dr.select(active, words[i], 0x01010101)
            weights += [(word >> (8 * k)) & 255 for k in range(4)]
        return weights, sum(weights[1:], weights[0])

    def _cell(self, place: mi.Point3f, shift: mi.Point3f = 0) -> tuple[mi.Vector3u, mi.Bool]:
        """The cell of a place that is moved by ``shift`` cells, and whether it is in the table.
        The first slice reaches to infinity, the last one to the lens."""
        cell = (place - self._offset) * self._scale + shift
        last = mi.Point3f(self._size - 1)
        cell.z = dr.clip(cell.z, 0, last.z)
        inside = dr.all((cell >= 0) & (cell < last + 1))
        return mi.Vector3u(dr.select(inside, cell, 0)), inside

    def _index(self, cell: mi.Vector3u) -> mi.UInt32:
        return (cell.z * self._size.y + cell.y) * self._size.x + cell.x

    def _occupied(self) -> mi.UInt32:
        """For each cell, 1 + its row of the table if it holds surfaces, and 0 if it does not."""
        count = self.shape[0] * self.shape[1] * self.shape[2]
        rows = dr.zeros(mi.UInt32, count)
        # Neighbouring cells count as well: rays of the maps may miss a surface there
        for shift in itertools.product((-0.5, 0.5), repeat=3):
            cell, inside = self._cell(self._maps.places, mi.Point3f(*shift))
            dr.scatter(rows, mi.UInt32(1), self._index(cell), inside)
        dr.eval(rows)
        self._cells = dr.compress(rows > 0)
        dr.scatter(rows, dr.arange(mi.UInt32, 1, len(self._cells) + 1), self._cells)
        dr.eval(rows)
        return rows

    def _table(self) -> mi.UInt32:
        """The weights of the cells that hold surfaces: a byte for each piece."""
        rows = len(self._cells)
        row = dr.arange(mi.UInt32, rows)
        counts = dr.gather(mi.ArrayXu, self._seen(), row, shape=(self._count, rows))
        likes = [dr.sqrt(mi.Float(counts[k]) + _PRIOR) for k in range(self._count)]
        largest = likes[0]
        for like in likes[1:]:
            largest = dr.maximum(largest, like)
        words = [mi.UInt32(0) for _ in range(self._count // 4)]
        for k, like in enumerate(likes):
            byte = mi.UInt32(dr.round(255 * like / largest))
            words[k // 4] |= dr.maximum(byte, 1) << (8 * (k % 4))
        table = dr.empty(mi.UInt32, rows * len(words))
        dr.scatter(table, mi.ArrayXu(words), row)
        dr.eval(table)
        return table

    def _seen(self) -> mi.UInt32:
        """For each cell and piece of the aperture, [cell, piece]: how many of the ``_TAPS``² places
        in and around the cell are seen from the piece."""
        lane = dr.arange(mi.UInt32, len(self._cells) * self._count)
        piece = lane % self._count
        index = dr.gather(mi.UInt32, self._cells, lane // self._count)
        x, rest = index % self._size.x, index // self._size.x
        cell = mi.Point3f(x, rest % self._size.y, rest // self._size.y)
        # Surfaces nearer than the next slice hide the cell; surfaces in the cell itself do not
        nearest = (cell.z + 2) / self._scale.z + self._offset.z
        seen, random = mi.UInt32(0), hashed(lane, 5)
        for tap in range(_TAPS**2):
            # Points of a randomly shifted low-discrepancy sequence
            numbers = [x + tap * _STEP**-i for i, x in enumerate(random, 1)]
            numbers = [x - dr.floor(x) for x in numbers]
            jitter = mi.Point2f(tap % _TAPS + numbers[0], tap // _TAPS + numbers[1]) / _TAPS
            jitter = 0.5 + _WIDTH * (jitter - 0.5)
            place = cell + mi.Vector3f(jitter.x, jitter.y, numbers[2])
            place = place / self._scale + self._offset
            lens = self._maps.lens_numbers(piece, mi.Point2f(numbers[3], numbers[4]))
            seen += dr.select(self._maps.is_seen(place, lens, piece, nearest), 1, 0)
        dr.eval(seen)
        return seen


def _cells(shape: tuple[int, int], margins: list[float], most: int) -> tuple[int, int]:
    """Number of cells along x and y. A cell is as large as a pixel of the maps, or larger if there
    would be more than ``most`` of them."""
    sizes = [n * (1 + 2 * margin) for n, margin in zip(shape, margins)]
    shrink = min(1.0, math.sqrt(most / (sizes[0] * sizes[1])))
    return max(1, int(sizes[0] * shrink)), max(1, int(sizes[1] * shrink))
