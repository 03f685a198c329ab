"""Maps of the numbers that choose a light and a point on it, for the first connection of a path.

Source: D. Cline, PhD dissertation, BYU 2007, section 9.2.2 (light selection, point on light). Here
they are one map of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.path_decisions import EmitterSampling, LightNumbers
from .cells import CellDensities, Cells

#: The most bits of a cell's number: in all, for the light, and for each axis of a point on it.
_BITS, _LIGHT_BITS, _POINT_BITS = 11, 8, 5


def light_cells(scene: mi.Scene, choice_dimension: int) -> Cells:
    """The cells of the numbers of a connection.

    Parameters:
        choice_dimension: That of the decision that uses the numbers. With 0, the first number
            chooses the light, each with its probability; its rest chooses the point on the light.
    """
    emitters = scene.emitters()
    is_delta = all(mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in emitters)
    bits = min(_LIGHT_BITS, (len(emitters) - 1).bit_length())
    each = 0 if is_delta else min(_POINT_BITS, (_BITS - bits) // 2)
    if choice_dimension == 2:
        return Cells.square(_POINT_BITS)
    if choice_dimension == 1:
        return Cells([0] * bits + [1, 2] * each)
    index = dr.arange(mi.UInt32, len(emitters))
    probability = scene.pdf_emitter(index).numpy().astype(np.float64)
    cumulative = np.cumsum(np.broadcast_to(probability, len(emitters)))
    edges = np.concatenate([[0], cumulative / cumulative[-1]])
    # Groups of equal numbers of lights; groups after the last light are empty
    group = -(-len(emitters) // (1 << bits))
    edges = edges[np.minimum(np.arange((1 << bits) + 1) * group, len(emitters))]
    parts = np.arange(1 << each) / (1 << each)
    bounds = edges[:-1, None] + parts * np.diff(edges)[:, None]
    # A map of one light and no extent would have nothing to choose
    axes = [0] * bits + [0, 1] * each
    return Cells(axes or [0], np.append(bounds, 1) if axes else None)


@dataclass
class LightChoice:
    """The choice of :class:`MappedLights`.

    Attributes:
        cell, density: The cell of the numbers in the map, and their density.
        is_mapped: Whether this is the connection whose numbers have a map.
    """

    cell: mi.UInt32
    density: mi.Float
    is_mapped: mi.Bool


class MappedLights(EmitterSampling):
    """Warps the numbers of another next event decision, at the first vertex of a path that is
    connected to lights. MIS weights remain the weights of uniform numbers. That is unbiased,
    because they add up to one in each direction.

    Parameters:
        inner: The decision that uses the numbers.
        numbers: The maps.
    """

    def __init__(self, inner: EmitterSampling, numbers: LightMaps) -> None:
        self._inner, self._numbers = inner, numbers
        self.choice_dimension = inner.choice_dimension

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None = None) -> Any:
        tile = mi.UInt32(0) if pixel is None else self._numbers.tiles.tile(pixel)
        return self._inner.begin(sampler, ray, pixel), tile, mi.Bool(pixel is not None)

    def visit(self, state, scene, si, active):
        inner, tile, is_fresh = state
        return self._inner.visit(inner, scene, si, active), tile, is_fresh, is_fresh & active

    def sample(self, place, scene, numbers, si, active):
        inner, tile, _, is_mapped = place
        numbers, choice = self._numbers.warp(tile, numbers, is_mapped & active)
        ds, weight, _ = self._inner.sample(inner, scene, numbers, si, active)
        return ds, weight / choice.density, choice

    def remember(self, place, scene, d, pdf, active):
        inner, tile, is_fresh, is_mapped = place
        return self._inner.remember(inner, scene, d, pdf, active), tile, is_fresh & ~is_mapped

    def density(self, state, scene, ref, si, ds, active):
        return self._inner.density(state[0], scene, ref, si, ds, active)

    def probability(self, state, scene, ref, emitter, active):
        return self._inner.probability(state[0], scene, ref, emitter, active)


class LightMaps:
    """The maps, and how they warp the numbers of a connection.

    Attributes:
        cells, maps, tiles: See
            :class:`~mitsuba_ext.techniques.swarming.mapped_numbers.MappedNumbers`.
        is_recorded: Whether choices are recorded for a learner.
    """

    def __init__(self, cells: Cells) -> None:
        self.cells = cells
        self.maps: CellDensities | None = None
        self.tiles: Any = None
        self.is_recorded = False

    def around(self, inner: EmitterSampling) -> EmitterSampling:
        """``inner`` with warped numbers, where there are maps or a learner; else ``inner``."""
        is_needed = self.maps is not None or self.is_recorded
        return MappedLights(inner, self) if is_needed else inner

    def warp(
        self, tile: mi.UInt32, numbers: LightNumbers, active: mi.Bool
    ) -> tuple[LightNumbers, LightChoice]:
        """Warps uniform numbers by the map of a tile, where ``active``."""
        u, has_choice = [numbers.point.x, numbers.point.y], self.cells.dimension == 3
        if has_choice:
            u.insert(0, numbers.choice)
        used = u[: self.cells.dimension]
        if self.maps is None:
            return numbers, LightChoice(self.cells.find(used), mi.Float(1), active)
        drawn, density, cell = self.maps.sample(tile, used, active)
        u[: len(drawn)] = drawn
        choice = u.pop(0) if has_choice else numbers.choice
        return LightNumbers(mi.Point2f(*u), choice), LightChoice(cell, density, active)
