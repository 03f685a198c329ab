"""BSDFs at vertices of light paths, evaluated so that light paths and ``path`` have the same
integrand. :class:`SurfaceTerms` bundles what bidirectional methods need of a vertex.

``path`` evaluates BSDFs with ``wi`` towards the camera. Some are not reciprocal (normal and bump
maps, hair, thin transmission), so light paths evaluate them in the same way, although they travel
in the other direction. The geometric cosines use the geometric normal; the value of a BSDF includes
the cosine with its shading normal.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.bsdfs import bsdf_density, eval_bsdf
from ...transport.heroes import Heroes


def evaluate(
    heroes: Heroes,
    hero_is_alone: Any,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    to_camera: mi.Vector3f,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float]:
    """The BSDF of a vertex for light that arrives from ``si.wi`` and leaves to ``to_camera``
    (local). Not for connections to camera paths, which combine the wavelengths of two paths.

    Returns:
        BSDF · geometric cosine of ``to_camera``, which multiplies flux per solid angle; and the
        density with which a camera path that arrives from ``to_camera`` samples ``si.wi``.
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
    """Like :func:`evaluate`, but not restricted to the hero wavelength where dispersive interfaces
    refract."""
    value, pdf = eval_bsdf(bsdf, ctx, reversed_at(si, to_camera), si.wi, active)
    arrives, leaves = geometric_cosine(si, si.wi), geometric_cosine(si, to_camera)
    # The value holds the shading cosine of arrival
    return value * dr.select(arrives > 0, leaves / arrives, 0), pdf


class SurfaceTerms:
    """What a vertex of a camera path or a light path contributes to the throughput and the
    densities of a complete path. This class is for vertices on surfaces. Methods receive the
    interaction ``si``, the ``bsdf``, and the participating medium in which the vertex lies
    (``None`` here).

    Attributes:
        sees_media: Whether vertices may lie in media.
    """

    sees_media = False

    def eval(
        self, ctx: mi.BSDFContext, bsdf, si, medium, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """The value for light from ``wo`` (local), cosine included, and the density with which
        scattering samples ``wo``."""
        return eval_bsdf(bsdf, ctx, si, wo, active)

    def adjoint(
        self, ctx: mi.BSDFContext, bsdf, si, medium, to_camera: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """At a vertex of a light path: :func:`adjoint_value`."""
        return adjoint_value(ctx, bsdf, si, to_camera, active)

    def density(
        self, ctx: mi.BSDFContext, bsdf, si, medium, wo: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """The second result of :meth:`eval`."""
        return bsdf_density(bsdf, ctx, si, wo, active)

    def reverse_density(
        self, ctx: mi.BSDFContext, bsdf, si, medium, wo: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """The density with which a path that arrives from ``wo`` goes on towards ``si.wi``."""
        return reverse_density(ctx, bsdf, si, wo, active)

    def cosine(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
        """The factor that turns densities per solid angle, for paths from the local direction
        ``d``, into densities of the vertex: the geometric cosine."""
        return geometric_cosine(si, d)


def is_in_medium(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a vertex lies in a participating medium, and not on a surface."""
    return si.shape == None  # noqa: E711


def delta_correction(si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f) -> mi.Float:
    """The factor of the weight of a sample from a delta lobe, drawn with the mode ``Importance``,
    that makes the integrand the same as in ``path`` (Veach, PhD thesis, section 5.3.2).

    The BSDF may have turned its frame (normal maps). Its normal follows from the directions, by
    Snell's law: it is parallel to wi + η wo.
    """
    normal = si.wi + bs.eta * bs.wo
    arrives, leaves = dr.abs(dr.dot(normal, si.wi)), dr.abs(dr.dot(normal, bs.wo))
    geometric = geometric_cosine(si, bs.wo) / geometric_cosine(si, si.wi)
    factor = geometric * arrives / leaves
    # A direction that passes straight through has no such normal, and needs no correction
    passes = dr.squared_norm(si.wi + bs.wo) < 1e-8
    return dr.select(passes, 1, dr.select(dr.isfinite(factor), factor, 0))


def cosine_of_delta(si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f) -> mi.Float:
    """The factor that replaces the cosine in ratios of densities, for a direction from a delta
    lobe.

    The densities with which two techniques pass the vertex, in one direction and in the other, are
    per solid angle. Étendue, η² · cosine · solid angle · area, is the same on both sides of an
    interface, so their ratio changes by η² (Veach, PhD thesis, section 5.2).
    """
    return geometric_cosine(si, si.wi) / dr.square(bs.eta)


def geometric_cosine(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
    """The cosine between the geometric normal and a local direction, not negative."""
    return dr.abs(dr.dot(si.n, si.to_world(d)))


def reverse_density(
    ctx: mi.BSDFContext,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    active: mi.Bool,
) -> mi.Float:
    """The density with which a path that arrives from ``wo`` goes on towards ``si.wi``."""
    return bsdf_density(bsdf, ctx, reversed_at(si, wo), si.wi, active)


def reversed_at(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """The interaction of a path that arrives from the local direction ``wo``."""
    si = mi.SurfaceInteraction3f(si)
    si.wi = wo
    return si
