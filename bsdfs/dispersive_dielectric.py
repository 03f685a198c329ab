"""Smooth glass that disperses light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_ext.startup import registry
from mitsuba_ext.transport.materials.dispersive_interface import (
    DispersiveInterface,
    fresnel_spectrum,
)


@registry.plugin
class DispersiveDielectric(mi.BSDF):
    r"""
    .. _bsdf-dispersive_dielectric:

    Smooth dispersive dielectric (:monosp:`dispersive_dielectric`)
    --------------------------------------------------------------

    A smooth surface between air and a glass whose refractive index depends on the wavelength, so
    that a prism spreads white light into a spectrum. Otherwise it is Mitsuba's
    :monosp:`dielectric`.

    .. pluginparameters::

     * - int_ior
       - |string| or |float|
       - The material inside: :monosp:`bk7`, :monosp:`bak4`, :monosp:`f2`, :monosp:`sf6`,
         :monosp:`sf10`, :monosp:`sf11`, :monosp:`n-sf6`, :monosp:`n-sf11`, :monosp:`fused silica`,
         :monosp:`water`, :monosp:`diamond`, :monosp:`sapphire` (ordinary ray), or a number for an
         index that is the same at all wavelengths. (Default: bk7)
     * - cauchy
       - |string|
       - Instead of int_ior: the coefficients "A, B" or "A, B, C" of the index A + B/λ² + C/λ⁴, with
         λ in µm.
     * - sellmeier
       - |string|
       - Instead of int_ior: the coefficients "B1, B2, B3, C1, C2, C3" of the index whose square is
         1 + Σ Bλ²/(λ² - C), with λ in µm and C in µm².
     * - ext_ior
       - |string| or |float|
       - The index outside: a number, or :monosp:`vacuum`, :monosp:`helium`, :monosp:`hydrogen`,
         :monosp:`air`, :monosp:`carbon dioxide`. (Default: air, 1.000277)
     * - specular_reflectance, specular_transmittance
       - |spectrum| or |texture|
       - Factors of reflection and refraction, 0 to 1; leave them at 1 for physical results.
         (Default: 1)

    **Use it when** the colours of dispersion should be visible: prisms, gems, lenses, edges of
    thick glass. **Not when** they would not be visible: a refracted path keeps only one of its four
    wavelengths, which causes coloured noise. The noise is lowest with a
    :monosp:`reweighted_wavelength` around the integrator.

    It needs a spectral variant (:monosp:`llvm_ad_spectral`) and an integrator of this package:
    Mitsuba's own integrators cannot continue a path with a single wavelength. With them there is a
    warning, and pixels whose paths hit the glass are infinite or NaN. If int_ior is a number, the
    plugin works everywhere, as :monosp:`dielectric` does. Reflected light keeps all wavelengths. A
    :monosp:`bumpmap` or :monosp:`normalmap` around it must flip invalid normals
    (flip_invalid_normals, true by default). Catalogue indices hold for 360 to 830 nm; beyond this
    range, the index at its nearer end is used. The medium outside does not disperse, and the medium
    inside does not absorb (tint it with specular_transmittance). Gradients are not supported.

    Source: A. Wilkie et al., *Hero Wavelength Spectral Sampling*, 2014. Indices: data sheets of
    Schott; I. H. Malitson 1965 (fused silica); M. Daimon and A. Masumura 2007 (water); F. Peter
    1923 (diamond); I. H. Malitson and M. J. Dodge 1972 (sapphire).

    .. tabs::
        .. code-tab:: xml

            <bsdf type="dispersive_dielectric">
                <string name="int_ior" value="sf10"/>
            </bsdf>

        .. code-tab:: python

            'type': 'dispersive_dielectric',
            'int_ior': 'sf10'
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._interface = DispersiveInterface("dispersive_dielectric", props)
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide | self._interface.flags
        self.m_components = [
            mi.BSDFFlags.DeltaReflection | sides,
            mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric | sides,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def sample(self, ctx, si, sample1, sample2, active=True):
        if not self._interface.is_answerable(ctx):
            return self._interface.infinite_sample(si, sample1)
        has_reflection = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0)
        has_transmission = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, 1)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (has_reflection or has_transmission):
            return bs, mi.Spectrum(0)

        # ----- The hero chooses the lobe and the direction -----
        η = self._interface.η(si)
        cos_θ = mi.Frame3f.cos_theta(si.wi)
        F, cos_θ_t, η_it, η_ti = mi.fresnel(cos_θ, η[0])
        if has_reflection and has_transmission:
            # Where F is 0, nothing is reflected, even if sample1 is 0
            reflects = (sample1 <= F) & (F > 0)
            bs.pdf = dr.select(reflects, F, 1 - F)
        else:
            reflects = mi.Bool(has_reflection)
            bs.pdf = mi.Float(1)
        bs.wo = dr.select(reflects, mi.reflect(si.wi), mi.refract(si.wi, cos_θ_t, η_ti))
        bs.eta = dr.select(reflects, 1, η_it)
        bs.sampled_component = dr.select(reflects, mi.UInt32(0), 1)
        bs.sampled_type = dr.select(
            reflects,
            mi.UInt32(+mi.BSDFFlags.DeltaReflection),
            mi.UInt32(+mi.BSDFFlags.DeltaTransmission),
        )

        # ----- The reflectance of each wavelength, over the probability of the lobe -----
        active = mi.Bool(active) & (bs.pdf > 0)
        reflection = fresnel_spectrum(cos_θ, η) * self._interface.reflectance(si, active & reflects)
        transmission = self._interface.transmittance(si, active & ~reflects)
        # Refraction scales radiance by the change of its solid angle
        scale = dr.square(η_ti) if ctx.mode == mi.TransportMode.Radiance else 1
        value = dr.select(reflects, reflection, transmission * (1 - F) * scale)
        return bs, dr.select(active, value / dr.select(active, bs.pdf, 1), 0)

    def eval(self, ctx, si, wo, active=True):
        return mi.Spectrum(0)

    def pdf(self, ctx, si, wo, active=True):
        return mi.Float(0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return mi.Spectrum(0), mi.Float(0)

    def eval_diffuse_reflectance(self, si, active=True):
        return mi.Spectrum(0)

    def traverse(self, callback):
        self._interface.traverse(callback)

    def to_string(self):
        return self._interface.describe()
