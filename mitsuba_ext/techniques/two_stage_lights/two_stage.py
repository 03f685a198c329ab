"""Two-stage importance sampling of an environment, optionally with learned visibility.

Source: Cline, PhD dissertation, chapters 5 and 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...scene.lights.environment_texels import EnvironmentTexels
from ...scene.lights.texel_sums import TexelSums
from ...transport.heroes import Heroes
from ...transport.path_decisions import EmitterSampling
from .environment_partition import Partition, Partitioner
from .environment_visibility import (
    Cell,
    PrimaryVisibility,
    Tile,
    VisibilityCounts,
    WorldVisibility,
)  # fmt: skip


@dataclass
class State:
    """What a path remembers of its last vertex.

    Attributes:
        density: The density with which a connection to the environment would have found the
            direction in which the path has left; valid where ``has_partition``.
        has_partition: Did the last vertex have a partition?
        is_first: Whether there is no last vertex.
        tile: Number of the film tile in which the path begins.
    """

    density: mi.Float
    has_partition: mi.Bool
    is_first: mi.Bool
    tile: mi.UInt32


@dataclass
class Place:
    """What connections need to know about a vertex.

    Attributes:
        partition: The partition of the environment, where ``has_partition``.
        has_partition: Whether it has a partition. Elsewhere, lights are chosen as Mitsuba does.
        tile: Selects the maps of visibility.
    """

    partition: Partition
    has_partition: mi.Bool
    tile: Tile


class TwoStage(EmitterSampling):
    """Samples the environment by the product of its emission and the BSDF, and all other lights as
    Mitsuba does.

    Parameters:
        scene: A scene with an environment emitter.
        splits: See :class:`Partitioner`.
        everywhere: Whether there are partitions at all vertices of a path, not only at the first.
        counts: Finds the cell of a connection, for learning.
        in_primary_space: Whether its cells divide random numbers; if not, directions.
        visibility: The learned visibility of the environment from first vertices.
        sums: Sums over the texels of the environment; made here if ``None``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        splits: int,
        everywhere: bool,
        counts: VisibilityCounts | None = None,
        in_primary_space: bool = True,
        visibility: PrimaryVisibility | WorldVisibility | None = None,
        sums: TexelSums | None = None,
    ) -> None:
        self._everywhere, self._counts = everywhere, counts
        self._in_primary_space = in_primary_space
        self._sums = sums or TexelSums(EnvironmentTexels(scene))
        self._texels = self._sums.texels
        is_world = isinstance(visibility, WorldVisibility)
        self._primary = None if is_world else visibility
        self._partitioner = Partitioner(
            self._sums, Heroes(scene).context(), splits, visibility if is_world else None
        )
        emitters = scene.emitters()
        self.choice_dimension = 1 if len(emitters) > 1 else 0
        self._index = emitters.index(scene.environment())
        self._pointer = self._texels.directions.pointer

    def begin(self, sampler, ray, pixel=None) -> State:
        has_maps = self._counts is not None and pixel is not None
        tile = self._counts.tiles.tile(pixel) if has_maps else mi.UInt32(0)
        return State(mi.Float(0), mi.Bool(False), mi.Bool(True), tile)

    def visit(self, state, scene, si, active) -> Place:
        has_partition = mi.Bool(active)
        if not self._everywhere:
            has_partition &= state.is_first
        tile = Tile(state.tile, has_partition & state.is_first)
        return Place(self._partitioner.partition(si, has_partition, tile), has_partition, tile)

    def sample(self, place, scene, numbers, si, active):
        inverse, by_product = mi.Float(1), active & place.has_partition
        if self.choice_dimension > 0:
            index, inverse, _rest = scene.sample_emitter(numbers.choice, active)
            by_product &= index == self._index
            emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active & ~by_product)
        else:
            emitter = self._pointer
        a, a_weight, choice = self._by_product(
            place, si, numbers.point, dr.rcp(inverse), by_product
        )
        is_other = active & ~by_product
        b, b_weight = emitter.sample_direction(si, numbers.point, is_other)
        b.pdf = dr.select(is_other, b.pdf / inverse, 0)
        b.emitter = mi.EmitterPtr(emitter)
        b_weight = dr.select(is_other, b_weight * inverse, 0)
        weight = dr.select(by_product, a_weight, b_weight)
        return dr.select(by_product, a, b), weight, choice

    def _by_product(self, place, si, point, probability: mi.Float, active):
        if self._primary is not None:
            point, density = self._primary.sample(place.tile, point, active)
            probability = probability * density
        d, uv, density = self._partitioner.sample(place.partition, point, active)
        ds = self._texels.directions.sample(si, d)
        ds.uv, ds.pdf = uv, dr.select(active, density * probability, 0)
        value = self._texels.radiance(si, ds, active)
        choice = None
        if self._counts is not None:
            where = point
            if not self._in_primary_space:
                column, row, _point, _sine = self._texels.find(d)
                where = mi.Point2f(
                    (mi.Float(column) + 0.5) / self._texels.columns,
                    (mi.Float(row) + 0.5) / self._texels.rows,
                )
            cell = self._counts.cell(place.tile.number, where)
            choice = Cell(cell, active & place.tile.is_known)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0), choice

    def remember(self, place, scene, d, pdf, active) -> State:
        has_partition = active & place.has_partition
        number, density = self._partitioner.invert(place.partition, d, has_partition)
        if self._primary is not None:
            density *= self._primary.density(place.tile, number, has_partition)
        return State(density, has_partition, mi.Bool(False), place.tile.number)

    def density(self, state, scene, ref, si, ds, active):
        by_product = active & state.has_partition & (ds.emitter == self._pointer)
        others = scene.pdf_emitter_direction(ref, ds, active & ~by_product)
        chosen = 1.0
        if self.choice_dimension > 0:
            chosen = scene.pdf_emitter(mi.UInt32(self._index), active)
        return dr.select(active, dr.select(by_product, state.density * chosen, others), 0)
