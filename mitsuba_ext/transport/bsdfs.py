"""Calls of BSDFs: all code that evaluates or samples a BSDF uses these functions.

Where a sample fails, Mitsuba's BSDFs may return numbers that are not finite, and rely on the
sample's weight, which is zero there, to hide them. ``roughconductor`` does so for every sample on
its back side, ``roughplastic`` and ``principledthin`` for directions in the plane of the surface.
BSDFs that contain others multiply these numbers: in ``blendbsdf``, the weight itself becomes NaN.
``path`` ends such paths, because in Dr.Jit's LLVM and CUDA backends ``NaN != 0`` is false. These
functions do the same at the source: a sample that is not finite counts as failed, and a value or a
density that is not finite as zero. Everything else is returned unchanged.

A failed sample has a direction and a density nevertheless: where the microfacet of
``roughdielectric``, ``principled`` or ``principledthin`` sends light to the wrong side, ``bs.pdf``
is the density of *successful* samples of that direction, which come from another lobe. Only the
weight shows the failure. Code that uses the direction without the weight needs :func:`sample_bsdf`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class DiffuseLobes:
    """The values of the diffuse lobes of a BSDF that has glossy ones too, cosine included. They are
    not known where they are ``None``.

    Attributes:
        connected: In the direction of the connection of a vertex.
        sampled: In the sampled direction.
    """

    connected: mi.Spectrum | None = None
    sampled: mi.Spectrum | None = None


def eval_bsdf(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    active: mi.Bool | bool = True,
) -> tuple[mi.Spectrum, mi.Float]:
    """The BSDF's value, cosine included, and the solid angle density of its samples, in the local
    direction ``wo``."""
    value, density = bsdf.eval_pdf(ctx, si, wo, active)
    return _finite_value(value), _finite(density)


def bsdf_density(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    active: mi.Bool | bool = True,
) -> mi.Float:
    """The second result of :func:`eval_bsdf` alone."""
    return _finite(bsdf.pdf(ctx, si, wo, active))


def sample_bsdf(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    sample_1: mi.Float,
    sample_2: mi.Point2f,
    active: mi.Bool | bool = True,
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """A direction, and value / density there. Where none is sampled, the weight and ``bs.pdf`` are
    zero, and ``bs.wo`` is an arbitrary direction."""
    bs, weight = _finite_sample(*bsdf.sample(ctx, si, sample_1, sample_2, active))
    is_sampled = dr.max(dr.abs(mi.unpolarized_spectrum(weight))) > 0
    bs.pdf = dr.select(is_sampled, bs.pdf, 0)
    return bs, weight


def eval_and_sample_bsdf(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    sample_1: mi.Float,
    sample_2: mi.Point2f,
    lobes: DiffuseLobes | None = None,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """The results of :func:`eval_bsdf` and :func:`sample_bsdf`, in one call of the BSDF, which sets
    ``lobes`` as well."""
    if lobes is None:
        value, density, bs, weight = bsdf.eval_pdf_sample(ctx, si, wo, sample_1, sample_2)
    else:
        value, density, bs, weight, lobes.connected, lobes.sampled = dr.dispatch(
            bsdf, _with_lobes(ctx), si, wo, sample_1, sample_2
        )
    return _finite_value(value), _finite(density), *_finite_sample(bs, weight)


def diffuse_share(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    whole: mi.Spectrum | None,
    undivided: mi.Float | None,
    active: mi.Bool | bool = True,
    known: mi.Spectrum | None = None,
) -> mi.UnpolarizedSpectrum:
    """The share of diffuse lobes in the BSDF's value, without delta lobes, for each colour. It
    depends on nothing but the vertex and the two directions. A BSDF with lobes of one kind is not
    evaluated: the share is 1 if they are diffuse, otherwise 0.

    Mitsuba's ``principled`` and ``principledthin`` do not evaluate their lobes separately. What is
    diffuse is then what a Lambertian surface of the same albedo would scatter, but at most the
    whole value.

    Parameters:
        whole: The value of the BSDF, as :func:`eval_bsdf` returns it, or the product of weight and
            density of a sample; ``None`` if it is not known.
        undivided: The weight of the diffuse lobes where the BSDF is one of these two, or contains
            one of them, elsewhere negative; ``None`` if it is negative everywhere.
        known: The value of the diffuse lobes (:class:`DiffuseLobes`), if it is known.
    """
    flags = bsdf.flags()
    is_diffuse = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    mixes = is_diffuse & mi.has_flag(flags, mi.BSDFFlags.Glossy)
    active = active & mixes
    if whole is None:
        whole = _finite_value(bsdf.eval(ctx, si, wo, active))
    whole = mi.unpolarized_spectrum(whole)
    if known is None:
        divides = active if undivided is None else active & (undivided < 0)
        known = bsdf.eval(_diffuse_part(ctx), si, wo, divides)
    one = mi.unpolarized_spectrum(_finite_value(known))
    if undivided is not None:
        albedo = mi.unpolarized_spectrum(
            bsdf.eval_diffuse_reflectance(si, active & (undivided >= 0))
        )
        lambertian = albedo * (undivided * dr.inv_pi * dr.abs(mi.Frame3f.cos_theta(wo)))
        one = dr.select(undivided < 0, one, lambertian)
    share = dr.select(whole > 0, dr.clip(one / whole, 0, 1), 0)
    return dr.select(mixes, share, dr.select(is_diffuse, mi.Float(1), 0))


def _with_lobes(ctx: mi.BSDFContext):
    """The function that a BSDF is asked to execute for :func:`eval_and_sample_bsdf` with lobes."""
    parts = _diffuse_part(ctx)

    def call(bsdf, si, wo, sample_1, sample_2):
        value, density, bs, weight = bsdf.eval_pdf_sample(ctx, si, wo, sample_1, sample_2)
        connected, sampled = dr.zeros(mi.Spectrum), dr.zeros(mi.Spectrum)
        flags = bsdf.flags()
        if mi.has_flag(flags, mi.BSDFFlags.Diffuse) and mi.has_flag(flags, mi.BSDFFlags.Glossy):
            connected, sampled = (bsdf.eval(parts, si, d) for d in (wo, bs.wo))
        return value, density, bs, weight, connected, sampled

    return call


def _diffuse_part(ctx: mi.BSDFContext) -> mi.BSDFContext:
    """A context for the diffuse lobes alone."""
    parts = mi.BSDFContext(ctx.mode, ctx.type_mask, ctx.component)
    parts.type_mask = ctx.type_mask & ~(int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse))
    return parts


def _finite(number: mi.Float) -> mi.Float:
    return dr.select(dr.isfinite(number), number, 0)


def _is_finite(value: mi.Spectrum) -> mi.Bool:
    return dr.all(dr.isfinite(mi.unpolarized_spectrum(value)))


def _finite_value(value: mi.Spectrum) -> mi.Spectrum:
    return dr.select(_is_finite(value), value, 0)


def _finite_sample(
    bs: mi.BSDFSample3f, weight: mi.Spectrum
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    is_sampled = _is_finite(weight) & dr.isfinite(bs.pdf) & dr.all(dr.isfinite(bs.wo))
    bs = mi.BSDFSample3f(bs)
    bs.pdf = dr.select(is_sampled, bs.pdf, 0)
    bs.wo = dr.select(is_sampled, bs.wo, mi.Vector3f(0, 0, 1))
    return bs, dr.select(is_sampled, weight, 0)
