"""BSDFs at vertices of light paths, evaluated so that the integrand is that of ``path``.

``path`` evaluates BSDFs with ``wi`` towards the camera. Some are not reciprocal (normal and bump
maps, hair, thin transmission), so light paths evaluate them in the same way, although they travel
in the other direction. Cosines of geometry are those of geometric normals; the BSDF brings along
that of its own frame.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.bsdfs import bsdf_density, eval_bsdf
from ..transport.heroes import Heroes


def evaluate(
    heroes: Heroes,
    hero_is_alone: Any,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    to_camera: mi.Vector3f,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float]:
    """What a vertex does to light that arrives from ``si.wi`` and leaves ``to_camera`` (local),
    where it is not connected to another path.

    Returns:
        BSDF · geometric cosine of ``to_camera``, which multiplies flux per solid angle; and the
        density with which a camera path that arrives there samples ``si.wi``.
    """
    value, pdf = adjoint_value(heroes.context(), bsdf, si, to_camera, active)
    return heroes.connect(hero_is_alone, value, bsdf, si, to_camera), pdf


def adjoint_value(
    ctx: mi.BSDFContext,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    to_camera: mi.Vector3f,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float]:
    """The same for all wavelengths."""
    reversed_si = mi.SurfaceInteraction3f(si)
    reversed_si.wi = to_camera
    value, pdf = eval_bsdf(bsdf, ctx, reversed_si, si.wi, active)
    arrives, leaves = geometric_cosine(si, si.wi), geometric_cosine(si, to_camera)
    # The value holds the shading cosine of arrival
    return value * dr.select(arrives > 0, leaves / arrives, 0), pdf


def delta_correction(si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f) -> mi.Float:
    """What multiplies the weight of a sample of a discrete direction, drawn with the mode
    ``Importance``, for the integrand to be that of ``path`` (Veach, PhD thesis, section 5.3.2).

    The BSDF may have turned its frame (normal maps): its normal is that about which the sample was
    reflected or refracted, since its tangential part obeys Snell's law.
    """
    normal = si.wi + bs.eta * bs.wo
    arrives, leaves = dr.abs(dr.dot(normal, si.wi)), dr.abs(dr.dot(normal, bs.wo))
    geometric = geometric_cosine(si, bs.wo) / geometric_cosine(si, si.wi)
    factor = geometric * arrives / leaves
    # What passes straight on has no such normal, and no correction
    passes = dr.squared_norm(si.wi + bs.wo) < 1e-8
    return dr.select(passes, 1, dr.select(dr.isfinite(factor), factor, 0))


def geometric_cosine(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
    """Between the geometric normal and a local direction, not negative."""
    return dr.abs(dr.dot(si.n, si.to_world(d)))


def reverse_density(
    ctx: mi.BSDFContext,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    active: mi.Bool,
) -> mi.Float:
    """The density with which a path that arrives from ``wo`` goes on towards ``si.wi``."""
    reversed_si = mi.SurfaceInteraction3f(si)
    reversed_si.wi = wo
    return bsdf_density(bsdf, ctx, reversed_si, si.wi, active)
