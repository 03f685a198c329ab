"""Mixes directions to focal points with samples of the BSDF."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.regions.nested_regions import NestedRegions
from ...scene.regions.surface_voxels import lit_normal
from ...transport.bsdfs import eval_bsdf
from ...transport.path_decisions import Scattering
from ...transport.vertex import Vertex
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .focal_density import FocalDensity


class FocalScattering(Scattering):
    """At vertices whose BSDF has a lobe that is not specular, a share of the directions lead to
    focal points. Its densities are the densities of the mixture, so that MIS weights account for
    it. Paths in media scatter as always.

    Parameters (and attributes):
        density: The density of directions to focal points, with a row for each region.
        regions: Finds the region of a vertex.
    """

    def __init__(self, density: FocalDensity, regions: NestedRegions) -> None:
        self.density, self.regions = density, regions

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.density, self.regions

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        si, is_mixed = vertex.si, is_smooth(vertex)
        row = self.region(vertex, is_mixed)
        share = dr.select(is_mixed, self.density.share(row, is_mixed), 0)
        to_focus = sample_1 < share
        # What the choice leaves of the number chooses the box, or the lobe
        number = dr.select(to_focus, sample_1 / share, (sample_1 - share) / (1 - share))
        number = dr.clip(number, 0, ONE_MINUS_EPSILON)
        value, pdf, bs, weight, _ = super().sample(state, ctx, vertex, wo, number, sample_2)
        if vertex.lobes is not None:
            vertex.lobes.sampled = None  # They are for the BSDF's own direction
        d = self.density.sample(row, si.p, number, sample_2, to_focus)
        local = si.to_local(d)
        bsdf_value, bsdf_pdf = eval_bsdf(vertex.bsdf, ctx, si, local, to_focus)
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        bsdf_value = dr.select(to_focus, bsdf_value, weight * bs.pdf)
        bsdf_pdf = dr.select(to_focus, bsdf_pdf, bs.pdf)
        bs.wo = dr.select(to_focus, local, bs.wo)
        bs.eta = dr.select(to_focus, 1, bs.eta)
        bs.sampled_type = dr.select(
            to_focus, mi.UInt32(+mi.BSDFFlags.GlossyReflection), bs.sampled_type
        )
        light, focus = self.density.densities(
            row, si.p, si.to_world(wo), dr.select(to_focus, d, si.to_world(bs.wo)),
            is_mixed & (share > 0),
        )  # fmt: skip
        mixes = to_focus | (is_mixed & ~is_delta)
        mixture = dr.lerp(bsdf_pdf, focus, share)
        bs.pdf = dr.select(mixes, mixture, bs.pdf)
        # Delta lobes are sampled with the probability 1 − share
        others = dr.select(is_mixed, weight / (1 - share), weight)
        weight = dr.select(mixes, dr.select(mixture > 0, bsdf_value / mixture, 0), others)
        return value, dr.lerp(pdf, light, share), bs, weight, state

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = super().eval_pdf(state, ctx, vertex, wo, active)
        is_mixed = active & is_smooth(vertex)
        row = self.region(vertex, is_mixed)
        share = dr.select(is_mixed, self.density.share(row, is_mixed), 0)
        focus = self.density.density(
            row, vertex.si.p, vertex.si.to_world(wo), is_mixed & (share > 0)
        )
        return value, dr.lerp(pdf, focus, share)

    def region(self, vertex: Vertex, active: mi.Bool) -> mi.UInt32:
        """The region of a vertex."""
        return self.regions.number(vertex.si.p, lit_normal(vertex.si), active)


def is_smooth(vertex: Vertex) -> mi.Bool:
    """Whether the BSDF has a lobe that is not specular; false in media."""
    return mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
