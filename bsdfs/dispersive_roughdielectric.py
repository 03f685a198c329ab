"""Rough glass that disperses light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_ext.startup import registry
from mitsuba_ext.transport.materials.dispersive_interface import (
    DispersiveInterface,
    check_uniform,
    fresnel_spectrum,
)
from mitsuba_ext.util.parameters import read_parameter

NAME = "dispersive_roughdielectric"


@registry.plugin
class DispersiveRoughDielectric(mi.BSDF):
    r"""
    .. _bsdf-dispersive_roughdielectric:

    Rough dispersive dielectric (:monosp:`dispersive_roughdielectric`)
    ------------------------------------------------------------------

    A frosted surface of microfacets between air and a glass whose refractive index depends on the
    wavelength. Otherwise it is Mitsuba's :monosp:`roughdielectric`.

    .. pluginparameters::

     * - int_ior, cauchy, sellmeier, ext_ior
       - |several|
       - As in :monosp:`dispersive_dielectric`. The indices inside and outside must differ at all
         wavelengths from 360 to 830 nm. (Default: int_ior bk7, ext_ior air)
     * - distribution
       - |string|
       - The distribution of microfacets: :monosp:`beckmann` or :monosp:`ggx`. (Default: beckmann)
     * - alpha
       - |float| or |texture|
       - Roughness, not negative: the root mean square slope of microfacets. (Default: 0.1)
     * - alpha_u, alpha_v
       - |float| or |texture|
       - Instead of alpha: roughness along the tangent and the bitangent.
     * - sample_visible
       - |bool|
       - Whether to sample only visible microfacets, which is less noisy. (Default: true)
     * - specular_reflectance, specular_transmittance
       - |spectrum| or |texture|
       - Factors of reflection and refraction, 0 to 1; leave them at 1 for physical results.
         (Default: 1)

    **Use it when** the colours of frosted glass should be visible. **Not when** it is so rough that
    the colours mix: the noise remains, and :monosp:`roughdielectric` has less.

    It needs a spectral variant (:monosp:`llvm_ad_spectral`) and an integrator of this package, as
    :monosp:`dispersive_dielectric` does; if int_ior is a number, it works everywhere. Only single
    scattering is modelled: as with Mitsuba's plugin, rougher surfaces lose more energy. Gradients
    are not supported.

    Source: A. Wilkie et al., *Hero Wavelength Spectral Sampling*, 2014; B. Walter et al.,
    *Microfacet Models for Refraction through Rough Surfaces*, 2007.

    .. tabs::
        .. code-tab:: xml

            <bsdf type="dispersive_roughdielectric">
                <string name="int_ior" value="f2"/>
                <string name="distribution" value="ggx"/>
                <float name="alpha" value="0.05"/>
            </bsdf>

        .. code-tab:: python

            'type': 'dispersive_roughdielectric',
            'int_ior': 'f2',
            'distribution': 'ggx',
            'alpha': 0.05
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._interface = DispersiveInterface(NAME, props)
        self._interface.check_differs()
        distribution = read_parameter(
            NAME, props, "distribution", "beckmann", choices=("beckmann", "ggx")
        )
        self._distribution = {
            "beckmann": mi.MicrofacetType.Beckmann, "ggx": mi.MicrofacetType.GGX
        }[distribution]  # fmt: skip
        self._samples_visible = read_parameter(NAME, props, "sample_visible", True)
        self._alphas = self._read_alphas(props)
        flags = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide | self._interface.flags
        if len(self._alphas) > 1:
            flags |= mi.BSDFFlags.Anisotropic
        self.m_components = [
            mi.BSDFFlags.GlossyReflection | flags,
            mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.NonSymmetric | flags,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def sample(self, ctx, si, sample1, sample2, active=True):
        if not self._interface.is_answerable(ctx):
            return self._interface.infinite_sample(si, sample1)
        has_reflection, has_transmission = _lobes(ctx)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (has_reflection or has_transmission):
            return bs, mi.Spectrum(0)
        cos_θ = mi.Frame3f.cos_theta(si.wi)
        active = mi.Bool(active) & (cos_θ != 0)

        # ----- The hero chooses the microfacet, the lobe and the direction -----
        facets, sampled_facets = self._facets(si, cos_θ, active)
        m, pdf = sampled_facets.sample(dr.mulsign(si.wi, cos_θ), sample2)
        active &= pdf > 0
        m = dr.select(active, m, mi.Normal3f(0, 0, 1))
        η = self._interface.η(si)
        F, cos_θ_t, η_it, η_ti = mi.fresnel(dr.dot(si.wi, m), η[0])
        if has_reflection and has_transmission:
            reflects = (sample1 <= F) & (F > 0)
            probability = dr.select(reflects, F, 1 - F)
        else:
            reflects, probability = mi.Bool(has_reflection), mi.Float(1)
        bs.wo = dr.select(reflects, mi.reflect(si.wi, m), mi.refract(si.wi, m, cos_θ_t, η_ti))
        bs.eta = dr.select(reflects, 1, η_it)
        bs.sampled_component = dr.select(reflects, mi.UInt32(0), 1)
        bs.sampled_type = dr.select(
            reflects,
            mi.UInt32(+mi.BSDFFlags.GlossyReflection),
            mi.UInt32(+mi.BSDFFlags.GlossyTransmission),
        )
        density, is_regular = _facets_per_direction(reflects, η_it, dr.dot(si.wi, m), bs.wo, m)
        active &= (probability > 0) & is_regular
        bs.pdf = dr.select(active, pdf * probability * density, 0)

        # ----- The reflectance of each wavelength, over the probability of the lobe -----
        value = self._reflection_or_transmission(
            ctx, si, η, F, η_ti, dr.dot(si.wi, m), reflects, active
        )
        value /= dr.select(active, probability, 1)
        if self._samples_visible:
            value *= facets.smith_g1(bs.wo, m)
        else:
            # Mitsuba's weight ignores that the facets are sampled from a rougher distribution
            value *= facets.eval(m) * facets.G(si.wi, bs.wo, m) * dr.dot(si.wi, m)
            value /= dr.select(active, cos_θ * pdf, 1)
        return bs, dr.select(active, value, 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        if not self._interface.is_answerable(ctx):
            return mi.Spectrum(dr.inf), mi.Float(1)
        has_reflection, has_transmission = _lobes(ctx)
        cos_θ, cos_θ_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        reflects = cos_θ * cos_θ_o > 0
        active = mi.Bool(active) & (cos_θ != 0)
        active &= (reflects & has_reflection) | (~reflects & has_transmission)

        # ----- Which microfacet scatters the hero from wi to wo? It must face both -----
        η = self._interface.η(si)
        η_it = dr.select(cos_θ > 0, η[0], dr.rcp(η[0]))
        m = dr.normalize(si.wi + wo * dr.select(reflects, 1, η_it))
        m = dr.mulsign(m, mi.Frame3f.cos_theta(m))
        wi_m, wo_m = dr.dot(si.wi, m), dr.dot(wo, m)
        density, is_regular = _facets_per_direction(reflects, η_it, wi_m, wo, m)
        active &= (wi_m * cos_θ > 0) & (wo_m * cos_θ_o > 0) & is_regular

        facets, sampled_facets = self._facets(si, cos_θ, active)
        F = mi.fresnel(wi_m, η[0])[0]
        value = self._reflection_or_transmission(
            ctx, si, η, F, dr.rcp(η_it), wi_m, reflects, active
        )
        # Eqs. 20 and 21 (Walter)
        value *= facets.eval(m) * facets.G(si.wi, wo, m) * density
        value *= dr.abs(wi_m) / dr.select(active, dr.abs(cos_θ), 1)

        pdf = sampled_facets.pdf(dr.mulsign(si.wi, cos_θ), m) * density
        if has_reflection and has_transmission:
            pdf *= dr.select(reflects, F, 1 - F)
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_diffuse_reflectance(self, si, active=True):
        return mi.Spectrum(0)

    def traverse(self, callback):
        self._interface.traverse(callback)
        names = ("alpha",) if len(self._alphas) == 1 else ("alpha_u", "alpha_v")
        for name, alpha in zip(names, self._alphas):
            callback.put(name, alpha, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def to_string(self):
        return self._interface.describe(
            f"distribution = {self._distribution.name}",
            f"sample_visible = {self._samples_visible}",
            *(f"alpha = {alpha}" for alpha in self._alphas),
        )

    # ---- Helpers ----

    def _read_alphas(self, props: mi.Properties) -> list[mi.Texture]:
        given = [key for key in ("alpha", "alpha_u", "alpha_v") if key in props]
        if given == ["alpha_u", "alpha_v"]:
            return [self._read_alpha(props, key) for key in given]
        if given in ([], ["alpha"]):
            return [self._read_alpha(props, "alpha")]
        raise ValueError(
            f'"{NAME}": {" and ".join(given)} are given; it must be either alpha, or alpha_u and '
            f"alpha_v"
        )

    def _read_alpha(self, props: mi.Properties, key: str) -> mi.Texture:
        return check_uniform(NAME, key, props.get_unbounded_texture(key, 0.1))

    def _facets(self, si, cos_θ, active):
        """The distribution of microfacets, and the one from which they are sampled."""
        alpha_u, alpha_v = (self._alphas[k].eval_1(si, active) for k in (0, -1))
        facets, sampled = (
            mi.MicrofacetDistribution(self._distribution, alpha_u, alpha_v, self._samples_visible)
            for _ in range(2)
        )
        if not self._samples_visible:
            # Section 5.3 (Walter): slightly rougher samples have smaller weights
            sampled.scale_alpha(1.2 - 0.2 * dr.sqrt(dr.abs(cos_θ)))
        return facets, sampled

    def _reflection_or_transmission(self, ctx, si, η, F, η_ti, wi_m, reflects, active):
        """F at each wavelength, or 1 - F of the hero, times the factors of the scene."""
        reflection = fresnel_spectrum(wi_m, η)
        reflection *= self._interface.reflectance(si, active & reflects)
        # Refraction scales radiance by the change of its solid angle
        scale = dr.square(η_ti) if ctx.mode == mi.TransportMode.Radiance else 1
        transmission = self._interface.transmittance(si, active & ~reflects) * (1 - F) * scale
        return dr.select(reflects, reflection, transmission)


def _lobes(ctx: mi.BSDFContext) -> tuple[bool, bool]:
    return (
        ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0),
        ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1),
    )


def _facets_per_direction(reflects, η_it, wi_m, wo, m):
    """The solid angle of microfacets per solid angle of ``wo`` (Eqs. 14 and 17 of Walter), and
    whether it is finite."""
    wo_m = dr.dot(wo, m)
    denominator = dr.select(reflects, 4 * wo_m, dr.square(wi_m + η_it * wo_m))
    numerator = dr.select(reflects, 1, dr.square(η_it) * wo_m)
    is_regular = denominator != 0
    return dr.abs(numerator / dr.select(is_regular, denominator, 1)), is_regular
