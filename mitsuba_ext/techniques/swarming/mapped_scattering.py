"""Maps of directions in the world, mixed with the BSDF, at the first vertex of a path that is not
specular.

Source: D. Cline, PhD dissertation, BYU 2007, sections 9.2.1 (Eq. 9.2) and 9.2.2 (scatter
direction).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.bsdfs import eval_bsdf
from ...transport.path_decisions import Scattering
from ...transport.vertex import Vertex
from .cells import CellDensities, Cells

#: The share of the directions that maps choose.
SHARE = 0.5

#: Bits of each axis of the map: height and angle around the z axis. All its cells have one size.
_BITS = 5


class MappedScattering(Scattering):
    """Mixes directions of a map with BSDF samples. Its densities are the densities of the mixture.

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
            return super().sample(state, ctx, vertex, wo, sample_1, sample_2)
        is_first = state & is_smooth(vertex)
        if self.maps is None:
            *result, _ = super().sample(state, ctx, vertex, wo, sample_1, sample_2)
            bs = result[2]
            found = self.cells.find(_to_square(vertex.si.to_world(bs.wo)))
            self._record(found, mi.Float(1), bs, bs.pdf, is_first)
            return *result, state & ~is_first
        from_map = is_first & (sample_1 < SHARE)
        stretched = dr.select(from_map, sample_1 / SHARE, (sample_1 - SHARE) / (1 - SHARE))
        sample_1 = dr.select(is_first, dr.clip(stretched, 0, 1 - 2**-24), sample_1)
        value, pdf, bs, weight, _ = super().sample(state, ctx, vertex, wo, sample_1, sample_2)
        table = self._table(vertex)
        # A direction of the map
        drawn, _, _ = self.maps.sample(table, [sample_2.x, sample_2.y], from_map)
        direction = vertex.si.to_local(_to_sphere(drawn))
        of_map, pdf_of_bsdf = eval_bsdf(vertex.bsdf, ctx, vertex.si, direction, from_map)
        is_smooth_sample = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        bs_value = dr.select(from_map, of_map, weight * bs.pdf)
        pdf_of_bsdf = dr.select(from_map, pdf_of_bsdf, bs.pdf)
        bs.wo = dr.select(from_map, direction, bs.wo)
        bs.eta = dr.select(from_map, 1, bs.eta)
        bs.sampled_type = dr.select(
            from_map, mi.UInt32(+mi.BSDFFlags.GlossyReflection), bs.sampled_type
        )
        mixes = from_map | (is_first & is_smooth_sample)
        cell = self.cells.find(_to_square(vertex.si.to_world(bs.wo)))
        mixture = self._mixture(table, cell, pdf_of_bsdf, mixes)
        bs.pdf = dr.select(mixes, mixture, bs.pdf)
        found = dr.select(mixture > 0, bs_value / mixture, 0)
        # Directions that only the BSDF finds are sampled with the probability 1 − SHARE
        others = dr.select(is_first, weight / (1 - SHARE), weight)
        weight = dr.select(mixes, found, others)
        if self.is_recorded:
            ratio = dr.select(pdf_of_bsdf > 0, mixture / pdf_of_bsdf, 0)
            self._record(cell, ratio, bs, pdf_of_bsdf, mixes)
        pdf = self._with_map(table, vertex, wo, pdf, is_first)
        return value, pdf, bs, weight, state & ~is_first

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = super().eval_pdf(state, ctx, vertex, wo, active)
        if state is None or self.maps is None:
            return value, pdf
        is_first = state & is_smooth(vertex) & active
        return value, self._with_map(self._table(vertex), vertex, wo, pdf, is_first)

    def _table(self, vertex: Vertex) -> mi.UInt32:
        return self.tiles.tile(vertex.pixel)

    def _with_map(self, table, vertex, wo, pdf, active) -> mi.Float:
        """The density of the mixture in a local direction."""
        cell = self.cells.find(_to_square(vertex.si.to_world(wo)))
        return dr.select(active, self._mixture(table, cell, pdf, active), pdf)

    def _mixture(self, table, cell, pdf, active) -> mi.Float:
        of_map = self.maps.density(table, cell, active) * dr.inv_four_pi
        return dr.lerp(pdf, of_map, SHARE)  # Eq. 9.2 (Cline)

    def _record(self, cell, density, bs, pdf, active) -> None:
        active = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (pdf > 0)
        dr.scatter(self.cell, cell, self.lane, active)
        dr.scatter(self.density, density, self.lane, active)
        dr.scatter(self.inverse, dr.inv_four_pi / pdf, self.lane, active)


def is_smooth(vertex: Vertex) -> mi.Bool:
    """Whether the BSDF has a lobe that is not specular."""
    return mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)


def _to_sphere(u: list[mi.Float]) -> mi.Vector3f:
    return mi.warp.square_to_uniform_sphere(mi.Point2f(*u))


def _to_square(d: mi.Vector3f) -> list[mi.Float]:
    """The inverse of :func:`_to_sphere`."""
    u = mi.warp.uniform_sphere_to_square(d)
    return [dr.clip(u.x, 0, 1 - 2**-24), dr.clip(u.y, 0, 1 - 2**-24)]
