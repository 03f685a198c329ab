"""Phase functions at vertices of light paths and camera paths, in scenes with participating media.

A vertex in a medium is sampled with a density per volume. From either side, this is the density per
solid angle, divided by the squared distance, times the transmittance of the segment and the
extinction at the vertex. MIS weights consist of ratios of the densities of a path. Each technique
samples each vertex once, so the extinction occurs in all densities, and cancels: the factor is 1
where a surface has a cosine.

The transmittance of a segment cancels too, except in the technique that connects its two ends. The
density of this technique does not contain the transmittance; its contribution does. Weights may
replace the transmittance by any positive function of the path that all techniques evaluate alike:
they still add up to one. Here this function is the transmittance of homogeneous media, as the mean
over the colours (a path chooses one of these for its distances). Media of varying density, whose
transmittance is only estimated, count as empty.

Source: E. Lafortune, Y. Willems, *Rendering Participating Media with Bidirectional Path Tracing*,
Eurographics Workshop on Rendering, 1996; J. Křivánek et al., *Unifying Points, Beams, and Paths in
Volumetric Light Transport Simulation*, ACM Transactions on Graphics 33(4), 2014.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.media import eval_phase
from ...transport.numbers import Numbers
from ...transport.path_decisions import SceneQuery
from ...transport.transmittance import transmittance
from ...util.arrays import channel_mean
from .scattering import SurfaceTerms, is_in_medium


class MediumTerms(SurfaceTerms):
    """The terms of vertices on surfaces and in media. In a medium, the interaction has no shape.

    Parameters (and attributes):
        has_grids: Whether there may be media of varying density.

    Light that arrives at a vertex in a medium is scattered with the phase function for its own
    direction: of microflakes, whose extinction depends on the direction, the phase function times
    the extinction is reciprocal, not the phase function alone.
    """

    sees_media = True

    def __init__(self, has_grids: bool) -> None:
        self.has_grids = has_grids

    def transmittance(
        self,
        query: SceneQuery,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        medium: mi.MediumPtr,
        ds: mi.DirectionSample3f,
        numbers: Numbers | None,
        active: mi.Bool,
        passes_emitters: bool = False,
        reach: mi.Float | None = None,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """:func:`transmittance` between a vertex and ``ds.p``. ``numbers`` are used in media of
        varying density only."""
        # Their majorant is the same for all colours
        T, known, _ = transmittance(
            query, scene, si, ds, medium, mi.UInt32(0), self.has_grids, True, False, numbers,
            active, passes_emitters, reach,
        )  # fmt: skip
        return T, known

    def eval(self, ctx, bsdf, si, medium, wo, active):
        value, pdf = super().eval(ctx, bsdf, si, medium, wo, active)
        return self._or_phase(si, medium, si.wi, wo, active, value, pdf)

    def adjoint(self, ctx, bsdf, si, medium, to_camera, active):
        value, reverse = super().adjoint(ctx, bsdf, si, medium, to_camera, active)
        value, _ = self._or_phase(si, medium, si.wi, to_camera, active, value, reverse)
        _, reverse = self._or_phase(si, medium, to_camera, si.wi, active, value, reverse)
        return value, reverse

    def density(self, ctx, bsdf, si, medium, wo, active):
        pdf = super().density(ctx, bsdf, si, medium, wo, active)
        return self._or_phase(si, medium, si.wi, wo, active, mi.Spectrum(0), pdf)[1]

    def reverse_density(self, ctx, bsdf, si, medium, wo, active):
        pdf = super().reverse_density(ctx, bsdf, si, medium, wo, active)
        return self._or_phase(si, medium, wo, si.wi, active, mi.Spectrum(0), pdf)[1]

    def cosine(self, si, d):
        return dr.select(is_in_medium(si), 1, super().cosine(si, d))

    def phase(self, si, medium, wi, wo, active) -> tuple[mi.Spectrum, mi.Float]:
        """At a vertex in ``medium``: the phase function for light between the local directions, and
        the density of ``wo``."""
        value, pdf = eval_phase(_at(si, medium, si.to_world(wi)), si.to_world(wo), active)
        return mi.Spectrum(value), pdf

    def extinction(self, si, medium) -> mi.Float:
        """At a vertex in ``medium``: the mean of the extinction over the colours, for light along
        the z axis. (The extinction of microflakes depends on the direction. Weights contain the
        same extinction for all techniques, from either side.) 0 on surfaces."""
        active = is_in_medium(si)
        mei = _at(si, medium, mi.Vector3f(0, 0, 1))
        _, _, σ = medium.get_scattering_coefficients(mei, active)
        return dr.select(active, channel_mean(mi.Spectrum(σ)), 0)

    def scattering(self, si, medium, active) -> mi.Spectrum:
        """The coefficient of scattering at a vertex in ``medium``, for light from ``si.wi``."""
        mei = _at(si, medium, si.to_world(si.wi))
        return mi.Spectrum(medium.get_scattering_coefficients(mei, active)[0])

    def _or_phase(self, si, medium, wi, wo, active, value, pdf) -> tuple[mi.Spectrum, mi.Float]:
        """:meth:`phase` where the vertex lies in a medium; elsewhere ``value`` and ``pdf``."""
        in_medium = active & is_in_medium(si)
        phase, phase_pdf = self.phase(si, medium, wi, wo, in_medium)
        phase = dr.select(in_medium, phase, value)
        return phase, dr.select(in_medium, phase_pdf, pdf)


def _at(
    si: mi.SurfaceInteraction3f, medium: mi.MediumPtr, wi: mi.Vector3f
) -> mi.MediumInteraction3f:
    """The interaction with ``medium`` at the vertex ``si``, for light from ``wi`` (in world
    space)."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi, mei.time, mei.wavelengths = si.p, wi, si.time, si.wavelengths
    mei.sh_frame, mei.medium = mi.Frame3f(mei.wi), medium
    return mei
