"""Maps of directions in the world, mixed with the BSDF, at the first vertex of a path that is not
specular.

Source: D. Cline, PhD dissertation, BYU 2007, sections 9.2.1 (Eq. 9.2) and 9.2.2 (scatter
direction).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.mixed_scattering import MixedScattering
from ...transport.path_decisions import Scattering
from .cells import CellDensities, Cells

#: The share of the directions that maps choose.
SHARE = 0.5

#: Bits of each axis of the map: height and angle around the z axis. All its cells have one size.
_BITS = 5


class MappedScattering(MixedScattering):
    """Mixes directions of a map with BSDF samples: Eq. 9.2 (Cline).

    Attributes:
        cells, maps, tiles: See
            :class:`~mitsuba_ext.techniques.swarming.mapped_numbers.MappedNumbers`.
        is_recorded: Whether choices are recorded for a learner.
        cell, density, inverse, lane: The choices of the lanes of the running pass, if recorded: the
            cell, the density of the mixture over that of the BSDF, uniform density over that of the
            BSDF, and the lane.
    """

    def __init__(self) -> None:
        self.cells = Cells.square(_BITS)
        self.maps: CellDensities | None = None
        self.tiles: Any = None
        self.is_recorded = False

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
        if self.is_recorded:
            lanes = dr.width(ray)
            self.lane = dr.arange(mi.UInt32, lanes)
            self.cell = dr.zeros(mi.UInt32, lanes)
            self.density, self.inverse = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)
            dr.eval(self.lane, self.cell, self.density, self.inverse)
        return mi.Bool(True) if self.maps is not None or self.is_recorded else None

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        if state is None:
            return Scattering.sample(self, state, ctx, vertex, wo, sample_1, sample_2)
        is_first = state & vertex.is_smooth
        if self.maps is None:
            *result, _ = Scattering.sample(self, state, ctx, vertex, wo, sample_1, sample_2)
            mixes, pdf = is_first, result[2].pdf
        else:
            *result, mixes, pdf = self.mixed_sample(state, ctx, vertex, wo, sample_1, sample_2)
        if self.is_recorded:
            self._record(vertex, result[2], pdf, mixes)
        return *result, state & ~is_first

    def eval_pdf(self, state, ctx, vertex, wo, active):
        kind = Scattering if state is None or self.maps is None else MixedScattering
        return kind.eval_pdf(self, state, ctx, vertex, wo, active)

    def share(self, state, vertex, active):
        return self.tiles.tile(vertex.pixel), dr.select(state & active, mi.Float(SHARE), 0)

    def direction(self, place, vertex, number, point, active):
        drawn, _, _ = self.maps.sample(place, [point.x, point.y], active)
        return mi.warp.square_to_uniform_sphere(mi.Point2f(*drawn))

    def densities(self, place, vertex, directions, active):
        return tuple(
            self.maps.density(place, self._cell(d), active) * dr.inv_four_pi for d in directions
        )

    def _cell(self, d: mi.Vector3f) -> mi.UInt32:
        """The cell of a direction in the world."""
        u = mi.warp.uniform_sphere_to_square(d)
        return self.cells.find([dr.clip(u.x, 0, 1 - 2**-24), dr.clip(u.y, 0, 1 - 2**-24)])

    def _record(self, vertex, bs, pdf, active) -> None:
        active = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (pdf > 0)
        dr.scatter(self.cell, self._cell(vertex.si.to_world(bs.wo)), self.lane, active)
        dr.scatter(self.density, bs.pdf / pdf, self.lane, active)
        dr.scatter(self.inverse, dr.inv_four_pi / pdf, self.lane, active)
