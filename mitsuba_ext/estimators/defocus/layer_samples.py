"""Chooses the pixels of a layered render that sample hidden surfaces or surfaces off the film."""

from __future__ import annotations

import numpy as np

#: The edge of a tile, in pixels. Decisions are made for all pixels of a tile together.
TILE = 8

#: The difference between neighbouring pixels' blurs above which one surface hides another.
_EDGE_STEP = 0.5


def outside_pixels(blurs: np.ndarray, margin: int) -> np.ndarray:
    """The pixels of the margin around the film that are blurred into the film, and (approximated by
    tiles) the pixels into which the film is blurred.

    Parameters:
        blurs: The blur of each pixel, including the margin, [height, width].
    """
    height, width = blurs.shape
    outside = np.ones((height, width), dtype=bool)
    outside[margin : height - margin, margin : width - margin] = False
    reach = np.abs(blurs) + 1
    film = _spread(_by_tile(np.where(outside, 0, reach), 0, np.max))
    distance = distance_from_film(blurs.shape, margin)
    return outside & (np.maximum(_by_pixel(film, blurs.shape), reach) >= distance)


def distance_from_film(shape: tuple[int, int], margin: int) -> np.ndarray:
    """The distance of each pixel from the film, in pixels, [height, width]. ``shape`` includes the
    margin."""
    away = [
        np.maximum(0, np.maximum(margin - i, i - (n - 1 - margin)))
        for i, n in zip(np.ogrid[: shape[0], : shape[1]], shape)
    ]
    return np.hypot(*away)


def _spread(reach: np.ndarray) -> np.ndarray:
    """For each tile, the largest reach, in pixels, of all tiles that reach it; 0 if none does."""
    steps = np.ceil(reach / TILE)
    found = np.zeros_like(reach)
    for step in range(int(steps.max()), 0, -1):
        found = _around(np.maximum(found, np.where(steps >= step, reach, 0)), np.maximum)
    return found


def least_blur_around(blurs: np.ndarray, sky: float) -> np.ndarray:
    """For each pixel, the smallest blur, which belongs to the farthest surface, at edges near
    enough for the lens to see this surface behind the pixel; otherwise infinity. Computed by tiles.

    Parameters:
        blurs: Signed blur radii in pixels, [height, width].
        sky: The blur of a point at infinity.
    """
    edge = np.full_like(blurs, np.inf)
    for axis in range(2):
        a = np.moveaxis(blurs, axis, 0)
        e = np.moveaxis(edge, axis, 0)
        jump = np.abs(a[1:] - a[:-1]) > _EDGE_STEP
        least = np.where(jump, np.minimum(a[1:], a[:-1]), np.inf)
        e[1:] = np.minimum(e[1:], least)
        e[:-1] = np.minimum(e[:-1], least)
    least, most = _by_tile(edge, np.inf, np.min), _by_tile(blurs, -np.inf, np.max)
    # The largest distance on the film between a surface seen through the edge of the lens and
    # through its middle
    reach = np.ceil((most - sky) / TILE)
    found = np.full_like(least, np.inf)
    for radius in range(int(reach.max()) + 1):
        found = np.where(reach >= radius, least, found)
        least = _around(least, np.minimum)
    found[most <= found + 1] = np.inf
    return _by_pixel(found, blurs.shape)


def _by_tile(image: np.ndarray, fill: float, reduce) -> np.ndarray:
    height, width = image.shape
    tiles = -(-height // TILE), -(-width // TILE)
    pad = ((0, tiles[0] * TILE - height), (0, tiles[1] * TILE - width))
    padded = np.pad(image, pad, constant_values=fill)
    return reduce(padded.reshape(tiles[0], TILE, tiles[1], TILE), axis=(1, 3))


def _by_pixel(tiles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.repeat(np.repeat(tiles, TILE, 0), TILE, 1)[: shape[0], : shape[1]]


def _around(tiles: np.ndarray, reduce: np.ufunc) -> np.ndarray:
    """``reduce`` over each tile and the eight tiles around it."""
    padded = np.pad(tiles, 1, mode="edge")
    height, width = tiles.shape
    return reduce.reduce([
        padded[y : y + height, x : x + width] for y in range(3) for x in range(3)
    ])  # fmt: skip
