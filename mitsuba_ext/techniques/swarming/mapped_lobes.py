"""Maps of the number that decides between reflection and transmission, at the first bounces of a
path.

A part of the paths draws uniform numbers at all bounces, and all paths are weighted by the balance
heuristic: with ``Q`` the product of the densities of the maps up to a bounce, the density of a path
relative to uniform numbers is ``α + (1 - α) Q``, so that no path weighs more than ``1 / α``. If
each bounce had its own share of uniform numbers, the largest weights of all bounces would multiply.

Source: D. Cline, PhD dissertation, BYU 2007, section 9.2.2 (bifurcation). The source has an entry
for each bounce; here each bounce has a map for none, one, and more reflections before. The balance
heuristic over whole paths: E. Veach, PhD dissertation, Stanford 1997, section 9.2.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.path_decisions import DirectionSamples
from .bounce_records import BounceRecords
from .cells import CellDensities, Cells

#: The number of bounces with maps, and of cases (0, 1, more reflections before) with maps of their
#: own.
BOUNCES, REFLECTIONS = 8, 3

#: The share of the paths that draw uniform numbers.
_UNIFORM_SHARE = 0.2

#: Bits of a cell's number, and the end of the first cell. The others grow by a factor: the lobe
#: changes where the number equals the reflectance, which is small for glass.
_BITS, _FIRST_END = 5, 0.01


def lobe_cells() -> Cells:
    """The cells of the number that chooses a lobe."""
    ends = _FIRST_END ** (1 - np.arange(1 << _BITS) / ((1 << _BITS) - 1))
    return Cells([0] * _BITS, np.concatenate([[0], ends]))


def divides(shapes) -> bool:
    """Whether a path may be reflected or transmitted at one of these shapes."""
    return any(
        bool(shape.bsdf() and _flags(shape.bsdf().flags()))
        or shape.class_name() == "Instance"
        or divides(getattr(shape, "children", ()))
        for shape in shapes
    )


def _flags(flags):
    """Whether a BSDF with these flags has lobes of both kinds."""
    F = mi.BSDFFlags
    reflects = F.DiffuseReflection | F.GlossyReflection | F.DeltaReflection
    transmits = F.DiffuseTransmission | F.GlossyTransmission | F.DeltaTransmission
    return ((flags & int(reflects)) != 0) & ((flags & int(transmits)) != 0)


class MappedLobes(DirectionSamples):
    """Warps the number that chooses a lobe, where light is reflected or transmitted.

    Attributes:
        cells, maps, tiles: See
            :class:`~mitsuba_ext.techniques.swarming.mapped_numbers.MappedNumbers`.
        is_recorded: Whether choices are recorded for a learner.
        records: The choices of the running pass; ``None`` if they are not recorded.
    """

    def __init__(self) -> None:
        self.cells = lobe_cells()
        self.maps: CellDensities | None = None
        self.tiles: Any = None
        self.is_recorded = False
        self.records: BounceRecords | None = None

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        self.records = BounceRecords(dr.width(ray), BOUNCES) if self.is_recorded else None
        if pixel is None or (self.maps is None and self.records is None):
            return None
        is_uniform = mi.Bool(self.maps is None)
        if self.maps is not None:
            is_uniform = sampler.next_1d() < _UNIFORM_SHARE
        # The tile, the number of reflections, from which side the last surface was hit, whether the
        # path draws uniform numbers, and the density of its numbers under the maps
        return self.tiles.tile(pixel), mi.UInt32(0), mi.Bool(False), is_uniform, mi.Float(1)

    def draw(self, state, sampler, vertex, active):
        sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
        if state is None:
            return sample_1, sample_2, 1.0, state
        tile, reflections, was_front, is_uniform, product = state
        incident = vertex.si.to_world(vertex.si.wi)
        stays = (dr.dot(vertex.path.arrival.ref.n, -incident) > 0) == was_front
        is_reflected = active & (vertex.depth > 0) & stays
        reflections += dr.select(is_reflected, mi.UInt32(1), 0)
        is_mapped = active & (vertex.depth < BOUNCES) & _flags(vertex.bsdf.flags())
        which = vertex.depth * REFLECTIONS + dr.minimum(reflections, REFLECTIONS - 1)
        weight = density = mi.Float(1)
        if self.maps is None:
            cell = self.cells.find([sample_1])
        else:
            table, found = tile * (BOUNCES * REFLECTIONS) + which, self.cells.find([sample_1])
            (sample_1,), density, cell = self.maps.sample(
                table, [sample_1], is_mapped & ~is_uniform
            )
            cell = dr.select(is_uniform, found, cell)
            of_found = self.maps.density(table, cell, is_mapped & is_uniform)
            density = dr.select(is_mapped & is_uniform, of_found, density)
            weight = path_density(product) / path_density(product * density)
            product = product * density
        if self.records is not None:
            self.records.choose(vertex.depth, which, cell, density, is_mapped)
        is_front = dr.dot(vertex.si.n, incident) > 0
        return sample_1, sample_2, weight, (tile, reflections, is_front, is_uniform, product)


def path_density(product: mi.Float) -> mi.Float:
    """The density of the numbers of a path, relative to uniform ones; ``product`` is their density
    under the maps of all bounces so far."""
    return dr.lerp(product, 1.0, _UNIFORM_SHARE)
