"""What swarm maps have learned for a pixel, as arrays: for pictures, and to examine a render."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.learner import Learner
from ...rendering.camera import film_extent
from ...util.arrays import from_numpy
from .lobe_map_learner import LobeMapLearner
from .map_learner import MapLearner


@dataclass
class PixelMap:
    """The maps of one decision that a pixel uses. All pixels of its tile share them.

    Attributes:
        name: The name of the maps in summaries (``times``, ``lens``, …).
        edges: Where cells begin and end along each axis of the primary samples, increasing from 0
            to 1. An axis can have cells without width.
        density: The density of the primary samples relative to uniform ones, [cell of axis 0, of
            axis 1, …]: its mean, weighted by the sizes of the cells, is 1. For ``lobes``: [bounce,
            number of reflections before it, cell]. For times, axis 0 is the time in the shutter
            interval; for the lens, the axes are the two numbers that Mitsuba maps to a disk; for
            directions, the angle around the z axis and the height, from z = 1 to z = -1, as
            fractions; for distances and wavelengths, the number from which they are sampled; for
            lights, the number that chooses the light, in the order of ``scene.emitters()``, and one
            or two for the point on it.
        tile: The pixels that share the maps: first column, first row, and the column and row after
            the last ones.
    """

    name: str
    edges: list[np.ndarray]
    density: np.ndarray
    tile: tuple[int, int, int, int]

    def along(self, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """The edges of one axis, and the marginal density along it."""
        axes = self.density.ndim - len(self.edges)
        result = self.density
        for other in reversed(range(len(self.edges))):
            if other != axis:
                widths = np.diff(self.edges[other])
                result = np.tensordot(result, widths, axes=(axes + other, 0))
        return self.edges[axis], result


def pixel_maps(
    learners: Mapping[str, Learner], sensor: mi.Sensor, x: int, y: int
) -> dict[str, PixelMap]:
    """The maps that the last render used for a pixel.

    Parameters:
        learners: The learners of the render: ``integrator.learners``.
        sensor: The sensor that was rendered.
        x, y: Column and row of the pixel, in the image (the crop window).

    Returns:
        The maps in use, by slot: a decision is missing if its maps did not pay off.

    Raises:
        ValueError: There is no such pixel.
    """
    film = sensor.film()
    columns, rows = map(int, film.crop_size())
    if not (0 <= x < columns and 0 <= y < rows):
        raise ValueError(f"there is no pixel {x}, {y}: the image has {columns} x {rows}")
    border = film.rfilter().border_size() if film.sample_border() else 0
    pixel = (y + border) * film_extent(film)[0] + x + border
    return {
        slot: _map(learner, pixel, (x, y), border)
        for slot, learner in learners.items()
        if isinstance(learner, MapLearner) and learner.decision.maps is not None
    }


def _map(learner: MapLearner, pixel: int, place: tuple[int, int], border: int) -> PixelMap:
    cells, maps, tiles = learner.cells, learner.maps, learner.decision.tiles
    bits = [cells.axes.count(axis) for axis in range(cells.dimension)]
    edges = [np.linspace(0, 1, (1 << b) + 1) for b in bits]
    if cells.bounds is not None:
        edges[0] = cells.bounds.numpy().astype(np.float64)
    # The index of a cell from its position along each axis, as in `Cells.find`
    index = np.zeros([1 << b for b in bits], np.uint32)
    left = list(bits)
    for axis in cells.axes:
        left[axis] -= 1
        shape = [-1 if axis == a else 1 for a in range(cells.dimension)]
        bit = (np.arange(1 << bits[axis]) >> left[axis]) & 1
        index = (index << 1) | bit.reshape(shape).astype(np.uint32)
    tile = int(tiles.tile(mi.UInt32(pixel))[0])
    table = np.repeat(np.arange(maps, dtype=np.uint32) + tile * maps, cells.count)
    cell = from_numpy(mi.UInt32, np.tile(index.ravel(), maps))
    # A cell without width has no density
    is_wide = dr.gather(mi.Float, from_numpy(mi.Float, cells.widths), cell) > 0
    found = learner.decision.maps.density(mi.UInt32(table), cell, is_wide)
    density = dr.select(is_wide, found, 0).numpy().reshape(maps, *index.shape)
    if isinstance(learner, LobeMapLearner):
        density = density.reshape(-1, learner.reflections, cells.count)
    else:
        density = density[0]
    first = [(p + border) // tiles.edge * tiles.edge - border for p in place]
    ends = [p + tiles.edge for p in first]
    return PixelMap(learner.name, edges, density, (*first, *ends))


def light_probabilities(scene: mi.Scene, lights: PixelMap) -> np.ndarray:
    """The probability with which a map of lights chooses each of ``scene.emitters()``, where
    nothing else chooses among them (``next_event`` is ``uniform`` or ``power``).

    Parameters:
        scene: The scene that was rendered.
        lights: The map in the slot ``light_numbers``.
    """
    count = len(scene.emitters())
    of_scene = scene.pdf_emitter(dr.arange(mi.UInt32, count)).numpy().astype(np.float64)
    ends = np.cumsum(np.broadcast_to(of_scene, count))
    ends = np.concatenate([[0], ends / ends[-1]])
    edges, density = lights.along(0)
    cumulative = np.concatenate([[0], np.cumsum(density * np.diff(edges))])
    # Cells without width add nothing to the cumulative distribution
    return np.diff(np.interp(ends, edges, cumulative / cumulative[-1]))
