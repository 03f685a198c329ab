"""Scattering that mixes the directions of the BSDF with directions from another distribution."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..util.discrete_sampling import ONE_MINUS_EPSILON
from .bsdfs import eval_bsdf
from .path_decisions import Scattering
from .vertex import Vertex


class MixedScattering(Scattering):
    """At vertices whose BSDF has a lobe that is not specular, a share of the directions is drawn
    from another distribution. All densities are densities of the mixture, so that MIS weights
    account for it. Paths in media scatter as always."""

    def share(self, state: Any, vertex: Vertex, active: mi.Bool) -> tuple[Any, mi.Float]:
        """What :meth:`direction` and :meth:`densities` need to know about a vertex, and the share
        of its directions that they draw."""
        raise NotImplementedError

    def direction(
        self, place: Any, vertex: Vertex, number: mi.Float, point: mi.Point2f, active: mi.Bool
    ) -> mi.Vector3f:
        """A direction in the world; ``number`` and ``point`` are uniform."""
        raise NotImplementedError

    def densities(
        self, place: Any, vertex: Vertex, directions: tuple[mi.Vector3f, ...], active: mi.Bool
    ) -> tuple[mi.Float, ...]:
        """The densities of one or two directions in the world."""
        raise NotImplementedError

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        return *self.mixed_sample(state, ctx, vertex, wo, sample_1, sample_2)[:4], state

    def mixed_sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        """The first four results of :meth:`sample`; where the density of the sampled direction is
        one of the mixture, and its density among BSDF samples."""
        si, is_smooth = vertex.si, vertex.is_smooth
        place, share = self.share(state, vertex, is_smooth)
        is_other = sample_1 < share
        # What the choice leaves of the number chooses the direction, or the lobe
        number = dr.select(is_other, sample_1 / share, (sample_1 - share) / (1 - share))
        number = dr.clip(number, 0, ONE_MINUS_EPSILON)
        value, pdf, bs, weight, _ = super().sample(state, ctx, vertex, wo, number, sample_2)
        if vertex.lobes is not None:
            vertex.lobes.sampled = None  # They are for the BSDF's own direction
        d = self.direction(place, vertex, number, sample_2, is_other)
        local = si.to_local(d)
        bsdf_value, bsdf_pdf = eval_bsdf(vertex.bsdf, ctx, si, local, is_other)
        mixes = is_other | ((share > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
        bsdf_value = dr.select(is_other, bsdf_value, weight * bs.pdf)
        bsdf_pdf = dr.select(is_other, bsdf_pdf, bs.pdf)
        bs.wo = dr.select(is_other, local, bs.wo)
        bs.eta = dr.select(is_other, 1, bs.eta)
        bs.sampled_type = dr.select(
            is_other, mi.UInt32(+mi.BSDFFlags.GlossyReflection), bs.sampled_type
        )
        directions = si.to_world(wo), dr.select(is_other, d, si.to_world(bs.wo))
        light, other = self.densities(place, vertex, directions, share > 0)
        mixture = dr.lerp(bsdf_pdf, other, share)
        bs.pdf = dr.select(mixes, mixture, bs.pdf)
        # Delta lobes are sampled with the probability 1 − share
        of_mixture = dr.select(mixture > 0, bsdf_value / mixture, 0)
        vertex.sampling_weight = dr.select(
            mixes & (bsdf_pdf > 0) & (mixture > 0), bsdf_pdf / mixture, 1
        )
        weight = dr.select(mixes, of_mixture, weight / (1 - share))
        return value, dr.lerp(pdf, light, share), bs, weight, mixes, bsdf_pdf

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = super().eval_pdf(state, ctx, vertex, wo, active)
        place, share = self.share(state, vertex, active & vertex.is_smooth)
        (other,) = self.densities(place, vertex, (vertex.si.to_world(wo),), share > 0)
        return value, dr.lerp(pdf, other, share)
