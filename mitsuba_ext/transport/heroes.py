"""Hero wavelengths: the convention between the random walk and dispersive BSDFs.

A ray carries four wavelengths. The first, the *hero*, chooses lobes and directions. Reflection
leads all four the same way. Refraction by a dispersive interface does not: only the hero continues,
with four times the weight. That is unbiased, since the hero is distributed as each of the others,
and since whether a path has passed such an interface does not depend on wavelengths.

Source: A. Wilkie, S. Nawaz, M. Droske, A. Weidlich, J. Hanika, *Hero Wavelength Spectral Sampling*,
2014.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi

#: A bit that Mitsuba does not use. In the flags of a BSDF, which wrapper BSDFs pass on, it means
#: that the BSDF disperses light. In the ``type_mask`` of a ``BSDFContext``, where Mitsuba reads
#: only the bits of lobes, it means that the caller lets only the hero be refracted. A dispersive
#: BSDF refuses to work for other callers.
DISPERSES = 1 << 30

#: The default mask: its caller asks for all lobes, and does not know about heroes.
_EVERYTHING = 0xFFFFFFFF


def knows_heroes(ctx: mi.BSDFContext) -> bool:
    """Whether the caller lets only the hero be refracted."""
    return bool(ctx.type_mask & DISPERSES) and ctx.type_mask != _EVERYTHING


def disperses(shapes: Iterable[mi.Shape]) -> bool:
    """Whether any of these shapes may disperse light. ``children`` of shapes are searched too. The
    BSDFs of an instance are not accessible, so every instance is assumed to disperse."""
    return any(
        bool(shape.bsdf() and shape.bsdf().flags() & DISPERSES)
        or shape.class_name() == "Instance"
        or disperses(getattr(shape, "children", ()))
        for shape in shapes
    )


def warn_of_sampler(scene: mi.Scene, sampler: mi.Sampler) -> None:
    """Warns if light may disperse in ``scene``, and ``sampler`` does not choose lobes and
    wavelengths independently of each other: in Mitsuba 3.9.1's ``ldsampler``, small lobe numbers
    coincide more often with wavelength numbers in some quarters of [0, 1) than in others."""
    if (
        mi.is_spectral
        and sampler.class_name() == "LowDiscrepancySampler"
        and disperses(scene.shapes())
    ):
        mi.Log(
            mi.LogLevel.Warn,
            'The numbers of the sampler "ldsampler" depend on each other: what dispersive glass '
            'shows may be coloured by a few percent. Use "independent" or "multijitter".',
        )


class Heroes:
    """Lets dispersive BSDFs refract only the hero. Adds no code where nothing disperses.

    Its state says whether only the hero is left of a path: a mask, or ``None`` where
    nothing disperses.

    Parameters:
        scene: The scene.
        hero_weight: A factor of the throughput, besides 4, where only the hero is left.

    Attributes:
        are_needed: Whether something disperses light.
    """

    def __init__(self, scene: mi.Scene, hero_weight: mi.Float | float = 1.0) -> None:
        self.are_needed = mi.is_spectral and disperses(scene.shapes())
        self._count = dr.size_v(mi.Spectrum)
        self._factor = self._count * hero_weight

    def context(self) -> mi.BSDFContext:
        """The context for all calls of BSDFs."""
        ctx = mi.BSDFContext()
        # Also where nothing disperses: Dr.Jit traces the BSDFs of all scenes in memory
        if mi.is_spectral:
            ctx.type_mask |= DISPERSES
        return ctx

    def begin(self) -> mi.Bool | None:
        """The state before the first bounce."""
        return mi.Bool(False) if self.are_needed else None

    def connect(
        self,
        is_alone: Any,
        bsdf_value: mi.Spectrum,
        bsdf: mi.BSDFPtr,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
    ) -> mi.Spectrum:
        """The value of a BSDF that multiplies the throughput for a connection."""
        if not self.are_needed:
            return bsdf_value
        return self._collapse(bsdf_value, self._refracts(bsdf, si, wo), is_alone)

    def scatter(
        self,
        is_alone: Any,
        bsdf_weight: mi.Spectrum,
        bsdf: mi.BSDFPtr,
        si: mi.SurfaceInteraction3f,
        bs: mi.BSDFSample3f,
    ) -> tuple[mi.Spectrum, mi.Float | float, Any]:
        """The weight of a BSDF sample.

        Returns:
            The weight that multiplies the throughput; the factor in it that compensates for the
            lost wavelengths, by which Russian roulette must divide; and the new state.
        """
        if not self.are_needed:
            return bsdf_weight, 1.0, is_alone
        # Light that passes through an opacity mask is not refracted
        refracts = self._refracts(bsdf, si, bs.wo)
        refracts &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        weight = self._collapse(bsdf_weight, refracts, is_alone)
        return weight, dr.select(refracts & ~is_alone, self._factor, 1), is_alone | refracts

    def join(self, one: tuple, other: tuple) -> mi.Spectrum:
        """The product of the BSDF values at the two vertices at which two paths are connected. It
        multiplies both throughputs. Each vertex is given as the state of its path, and
        ``bsdf_value``, ``bsdf``, ``si``, ``wo`` of :meth:`connect`."""
        value = one[1] * other[1]
        if not self.are_needed:
            return value
        refracts = self._refracts(*one[2:]) | self._refracts(*other[2:])
        return self._joined(value, refracts, one[0], other[0])

    def merge(
        self,
        is_alone: Any,
        other_is_alone: Any,
        bsdf_value: mi.Spectrum,
        bsdf: mi.BSDFPtr,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
    ) -> mi.Spectrum:
        """Like :meth:`join`, for two paths that meet at one vertex."""
        if not self.are_needed:
            return bsdf_value
        return self._joined(bsdf_value, self._refracts(bsdf, si, wo), is_alone, other_is_alone)

    def _joined(self, value, refracts, one_alone, other_alone) -> mi.Spectrum:
        # The factor for lost wavelengths is applied once, even if both paths have lost them
        both, any_alone = one_alone & other_alone, one_alone | other_alone
        hero = value[0] * dr.select(
            both, 1 / self._factor, dr.select(any_alone, 1, self._factor)
        )
        alone = mi.Spectrum([hero] + [0] * (self._count - 1))
        return dr.select(any_alone | refracts, alone, value)

    def _refracts(self, bsdf, si, wo) -> mi.Bool:
        """Whether ``wo`` crosses a dispersive interface. Its lobe does not matter: connections and
        BSDF samples must agree, or their MIS weights would not add up to one."""
        crosses = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) < 0
        return crosses & ((bsdf.flags() & DISPERSES) != 0)

    def _collapse(self, value, refracts, is_alone) -> mi.Spectrum:
        hero = dr.select(is_alone, value[0], value[0] * self._factor)
        return dr.select(refracts, mi.Spectrum([hero] + [0] * (self._count - 1)), value)
