"""The directions in which light paths leave surfaces.

A light path that arrives from ``a`` and leaves to ``b`` carries on with the value that a camera
path, which arrives from ``b``, finds for light from ``a`` (``scattering.py``). Most BSDFs are
reciprocal, so the density of samples of a camera path that arrives from ``a`` suits that value as
well. It does not suit the other BSDFs: it is small or zero where the value is not. A bump map turns
its frame towards the side from which a path arrives; from one path to the reverse one, the frame
changes, and up to a fifth of the light goes in directions that are never sampled. For these BSDFs,
a share of the directions is drawn from the cosine with the geometric normal, which is a factor of
the value, on both sides of the surface (a mixture, or one-sample MIS with the balance heuristic:
Veach, PhD thesis, section 9.2.4). The weight of a sample is then at most about 2π / 0.2 times the
value without its cosine, which is large at grazing angles: it reaches 1400 at a ``principledthin``
of roughness 0.3.

A mirror under a bump map reflects light paths and camera paths the same way only if the frame is
the same for both. A sample of such a mirror therefore has the weight with which a camera path
passes it in the reverse direction. This weight is zero if the mirror reflects that path elsewhere.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.bsdfs import is_in_table
from ...transport.bsdfs import eval_bsdf, sample_bsdf
from .scattering import reversed_at

#: The BSDFs of Mitsuba 3.9.1 that are not reciprocal.
NOT_RECIPROCAL = frozenset({"NormalMap", "BumpMap", "PrincipledThin", "Hair"})

#: The share of the directions that are drawn from the cosine.
_SHARE = 0.2

#: Largest squared difference of directions that count as the same, up to rounding.
_SAME = 1e-5


class LightDirections:
    """Samples directions in which light paths leave surfaces.

    Parameters:
        not_reciprocal: :func:`~mitsuba_ext.scene.bsdfs.bsdf_table` of ``NOT_RECIPROCAL``; ``None``
            if all BSDFs are reciprocal.
        mixes: Whether directions are also drawn from the cosine. This is not needed where other
            techniques find the light that samples of the BSDF miss.
    """

    def __init__(self, not_reciprocal: mi.Bool | None, mixes: bool = True) -> None:
        self._not_reciprocal, self._mixes = not_reciprocal, mixes

    def sample(
        self,
        bsdf: mi.BSDFPtr,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample_1: mi.Float,
        sample_2: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """A direction, its density ``bs.pdf`` (0 where none is sampled), and the weight of a delta
        lobe. The weights of other lobes are meaningless."""
        if self._not_reciprocal is None:
            return sample_bsdf(bsdf, ctx, si, sample_1, sample_2, active)
        differs = active & is_in_table(self._not_reciprocal, bsdf)
        mixes = mi.Bool(False)
        if self._mixes:
            mixes = differs & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        rest = dr.clip((sample_1 - _SHARE) / (1 - _SHARE), 0, dr.one_minus_epsilon(mi.Float))
        rest = dr.select(mixes, rest, sample_1)
        bs, weight = sample_bsdf(bsdf, ctx, si, rest, sample_2, active)
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        bs, weight = _with_weight_of_reverse(
            bsdf, ctx, si, (rest, sample_2), bs, weight, differs & is_delta
        )
        if self._mixes:
            bs, weight = self._mixed(bsdf, ctx, si, (sample_1, sample_2), bs, weight, mixes)
        return bs, weight

    def _mixed(self, bsdf, ctx, si, numbers, bs, weight, active):
        """A sample of the mixture, instead of one of the BSDF."""
        by_cosine = active & (numbers[0] < _SHARE)
        d = mi.warp.square_to_cosine_hemisphere(numbers[1])
        d.z = dr.mulsign(d.z, numbers[0] - 0.5 * _SHARE)
        n = si.to_local(si.n)
        bs.wo = dr.select(by_cosine, mi.Frame3f(n).to_world(d), bs.wo)
        bs.eta = dr.select(by_cosine, 1, bs.eta)
        bs.sampled_type = dr.select(by_cosine, +mi.BSDFFlags.DiffuseReflection, bs.sampled_type)
        is_smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        value, pdf = eval_bsdf(bsdf, ctx, si, bs.wo, is_smooth)
        # A BSDF's own sample counts as failed where its weight is zero
        pdf = dr.select(dr.max(dr.abs(mi.unpolarized_spectrum(value))) > 0, pdf, 0)
        mixed = _SHARE * dr.inv_two_pi * dr.abs(dr.dot(n, bs.wo)) + (1 - _SHARE) * pdf
        is_sampled = by_cosine | (bs.pdf > 0)
        bs.pdf = dr.select(is_smooth, dr.select(is_sampled, mixed, 0), bs.pdf)
        return bs, dr.select(active, weight / (1 - _SHARE), weight)


def _with_weight_of_reverse(bsdf, ctx, si, numbers, bs, weight, active):
    """A sample of a delta lobe, with the weight with which a camera path passes the lobe in reverse
    direction: none if it is led elsewhere."""
    back, back_weight = sample_bsdf(bsdf, ctx, reversed_at(si, bs.wo), *numbers, active)
    agrees = mi.has_flag(back.sampled_type, mi.BSDFFlags.Delta)
    agrees &= dr.squared_norm(back.wo - si.wi) < _SAME
    share = dr.select(agrees & (bs.pdf > 0), back.pdf / bs.pdf, 0)
    bs.pdf = dr.select(active & ~agrees, 0, bs.pdf)
    return bs, dr.select(active, back_weight * share, weight)
