"""Mixes directions to focal points with samples of the BSDF."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.bsdfs import eval_bsdf
from ...transport.path_decisions import Scattering
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .focal_boxes import FocalBoxes


class FocalScattering(Scattering):
    """At vertices whose BSDF has a lobe that is not specular, a share of the directions lead to
    focal points. Its densities are the densities of the mixture. Paths in media scatter as always.

    Parameters (and attributes):
        boxes: The density of focal points.
        share: The probability of a direction to a focal point.
    """

    def __init__(self, boxes: FocalBoxes, share: float) -> None:
        self.boxes, self.share = boxes, share
        self._share = dr.opaque(mi.Float, share)

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        si = vertex.si
        is_mixed = is_smooth(vertex)
        share = dr.select(is_mixed, self._share, 0)
        by_focus = sample_1 < share
        number = dr.select(by_focus, sample_1 / share, (sample_1 - share) / (1 - share))
        number = dr.clip(number, 0, ONE_MINUS_EPSILON)
        value, pdf, bs, weight, _ = super().sample(state, ctx, vertex, wo, number, sample_2)
        d = self.boxes.sample(si.p, number, sample_2, by_focus)
        local = si.to_local(d)
        of_focus, pdf_of_focus = eval_bsdf(vertex.bsdf, ctx, si, local, by_focus)
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        of_bsdf = dr.select(by_focus, of_focus, weight * bs.pdf)
        pdf_of_bsdf = dr.select(by_focus, pdf_of_focus, bs.pdf)
        bs.wo = dr.select(by_focus, local, bs.wo)
        bs.eta = dr.select(by_focus, 1, bs.eta)
        bs.sampled_type = dr.select(
            by_focus, mi.UInt32(+mi.BSDFFlags.GlossyReflection), bs.sampled_type
        )
        mixes = by_focus | (is_mixed & ~is_delta)
        to_light, sampled = self.boxes.densities(
            si.p, si.to_world(wo), dr.select(by_focus, d, si.to_world(bs.wo)), is_mixed
        )
        mixture = dr.lerp(pdf_of_bsdf, sampled, share)
        bs.pdf = dr.select(mixes, mixture, bs.pdf)
        found = dr.select(mixture > 0, of_bsdf / mixture, 0)
        weight = dr.select(mixes, found, dr.select(is_mixed, weight / (1 - share), weight))
        return value, dr.lerp(pdf, to_light, share), bs, weight, state

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = super().eval_pdf(state, ctx, vertex, wo, active)
        is_mixed = active & is_smooth(vertex)
        density = self.boxes.density(vertex.si.p, vertex.si.to_world(wo), is_mixed)
        return value, dr.lerp(pdf, density, dr.select(is_mixed, self._share, 0))


def is_smooth(vertex) -> mi.Bool:
    """Whether the BSDF has a lobe that is not specular; false in media."""
    return mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
