"""Square tiles of the film, whose pixels share what they learn."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class FilmTiles:
    """Tiles of the film.

    Parameters:
        width, height: Size of the film in pixels, with its border where that is sampled.
        edge: Edge of a tile in pixels.

    Attributes:
        edge: See above.
        rows, columns, count: Numbers of rows, columns and tiles.
    """

    def __init__(self, width: int, height: int, edge: int) -> None:
        self.width, self.height, self.edge = width, height, edge
        self.rows, self.columns = -(-height // edge), -(-width // edge)
        self.count = self.rows * self.columns
        # Opaque: films of all sizes share the kernels
        self._width, self._edge, self._across = (
            dr.opaque(mi.UInt32, x) for x in (width, edge, self.columns)
        )

    def tile(self, pixel: mi.UInt32) -> mi.UInt32:
        """The tile of a pixel, both counted row by row."""
        y = pixel // self._width
        return y // self._edge * self._across + (pixel - y * self._width) // self._edge
