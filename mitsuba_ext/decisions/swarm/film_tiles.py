"""Square tiles of the film, whose pixels share their maps."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Cells of all tiles of one map, at most: 32 MiB of counters, and as much for the table.
_MOST_CELLS = 1 << 23


class FilmTiles:
    """Tiles of the film.

    Parameters:
        width, height: Of the film in pixels, with its border where that is sampled.
        edge: Of a tile in pixels, where memory suffices.
        cells: Cells that each tile has; where the film is large and these are many, tiles are
            larger.

    Attributes:
        edge: Of a tile in pixels.
        rows, columns, count: How many tiles there are.
    """

    def __init__(self, width: int, height: int, edge: int, cells: int) -> None:
        self.edge = edge
        while -(-width // self.edge) * -(-height // self.edge) * cells > _MOST_CELLS:
            self.edge *= 2
        self.rows, self.columns = -(-height // self.edge), -(-width // self.edge)
        self.count = self.rows * self.columns
        # Opaque: films of all sizes share the kernels
        self._width, self._edge, self._across = (
            dr.opaque(mi.UInt32, x) for x in (width, self.edge, self.columns)
        )

    def tile(self, pixel: mi.UInt32) -> mi.UInt32:
        """The tile of a pixel, both counted row by row."""
        y = pixel // self._width
        return y // self._edge * self._across + (pixel - y * self._width) // self._edge
