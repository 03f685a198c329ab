"""Auxiliary features for denoisers: albedo and normal of the surfaces that the camera sees, also in
mirrors and through glass.

The albedo of diffuse surfaces, with or without a coat, is their diffuse reflectance, as Open Image
Denoise recommends [1]: the gloss of a coat would hide their texture. The albedo of other surfaces,
such as rough metal and rough glass, is the share of light that they scatter,

    a(ω_i) = ∫ f(ω_i, ω_o) |cos θ_o| dω_o,

estimated by samples of the BSDF, whose weights have this mean.

[1] Áfra. Intel Open Image Denoise: Documentation, section "Albedos".
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.bsdfs import eval_bsdf, sample_bsdf
from ..transport.decisions import CameraSamples
from ..transport.estimator import Sample
from ..transport.path_decisions import SceneQuery
from ..util.arrays import channel_mean
from . import camera
from .plan import check_extent

#: The names of the channels in an OpenEXR file.
CHANNELS = (*(f"albedo.{letter}" for letter in "RGB"), *(f"normal.{letter}" for letter in "XYZ"))

#: Samples per pixel.
_SPP = 32

#: Approximate number of samples of a pass.
_PASS_SAMPLES = 1 << 22

#: RGB of a spectrum that is 1 everywhere.
_WHITE = (1.206, 0.949, 0.910)

#: Largest number of surfaces that transmit or reflect a camera ray.
_MOST_BOUNCES = 16

#: The relative difference of two evaluations of one formula.
_ROUNDING = 1e-3


def render_guides(
    scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery, seed: int = 0
) -> dict[str, np.ndarray]:
    """Renders albedo and shading normal of the first surface that is not perfectly specular: camera
    rays are traced on through mirrors and glass. Replaces the contents of the film.

    Args:
        query: Intersects rays with the scene.

    Returns:
        Arrays (height, width) by the names of :data:`CHANNELS`.

    Raises:
        ValueError: The film has more pixels than a wavefront can hold.
    """
    film = sensor.film()
    check_extent(film)
    film.prepare(list(CHANNELS))
    block = film.create_block()
    width, height = camera.film_extent(film)
    length = min(_SPP, max(1, _PASS_SAMPLES // (width * height)))
    for first in range(0, _SPP, length):
        sampler = mi.load_dict({"type": "independent"})
        pass_seed = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(first))[0]
        sampler.seed(pass_seed, width * height * length)
        rays = camera.sample_rays(sensor, sampler, length, _SPP, CameraSamples(), first)
        si, albedo = _follow(scene, query, sampler, mi.Ray3f(rays.ray), mi.Bool(True))
        nothing, hit = Sample(mi.Spectrum(0), mi.Bool(False)), si.is_valid()
        if mi.is_spectral:
            importance = mi.unpolarized_spectrum(rays.importance)
            colour = camera.to_rgb(albedo * importance, rays.ray.wavelengths) / mi.Color3f(_WHITE)
        else:
            colour = _grey_or_rgb(albedo)
        found = [*dr.select(hit, colour, 0), *dr.select(hit, si.sh_frame.n, 0)]
        camera.put(film, block, rays, nothing, found)
        dr.eval(block.tensor())
    film.put_block(block)
    image = np.array(film.develop())[..., -len(CHANNELS) :]
    # Weights of samples may be above 1, and colours of sampled wavelengths negative
    image[..., :3] = np.clip(image[..., :3], 0, 1)
    return {name: image[..., n] for n, name in enumerate(CHANNELS)}


def guides_of(si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Float]:
    """RGB of a surface's albedo (grey in spectral variants) and its shading normal. There are no
    random numbers: one sample from the middle of the BSDF's lobes stands for all of them."""
    _, weight = sample_bsdf(si.bsdf(), _context(), si, mi.Float(0.5), mi.Point2f(0.5), active)
    albedo = _albedo(si, mi.unpolarized_spectrum(weight), active)
    colour = dr.clip(_grey_or_rgb(albedo), 0, 1)
    return [*dr.select(active, colour, 0), *dr.select(active, si.sh_frame.n, 0)]


def _grey_or_rgb(value: mi.UnpolarizedSpectrum) -> mi.Color3f:
    is_grey = mi.is_spectral or mi.is_monochromatic
    return mi.Color3f(channel_mean(value) if is_grey else value)


def _context() -> mi.BSDFContext:
    """A context in which glass conserves energy: no factor η², by which radiance changes."""
    return mi.BSDFContext(mi.TransportMode.Importance)


def _albedo(
    si: mi.SurfaceInteraction3f, weight: mi.UnpolarizedSpectrum, active: mi.Bool
) -> mi.UnpolarizedSpectrum:
    """The albedo of a surface; ``weight`` is the weight of a sample of its BSDF.

    Mitsuba's BSDFs without a diffuse reflectance return π times their value in the direction of
    the normal, which is up to 96 for rough metal (docs/mitsuba_faults.md). A mixture adds this to
    the reflectance of its diffuse part."""
    bsdf = si.bsdf()
    reflectance = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, active))
    up = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), si.wi.z))
    value, _ = eval_bsdf(bsdf, _context(), si, up, active)
    value = dr.pi * mi.unpolarized_spectrum(value)
    is_value = dr.max(dr.abs(reflectance - value)) <= _ROUNDING * dr.max(dr.abs(value))
    flags, kinds = bsdf.flags(), mi.BSDFFlags
    is_mixed = mi.has_flag(flags, kinds.Glossy) | mi.has_flag(flags, kinds.DiffuseTransmission)
    is_known = mi.has_flag(flags, kinds.DiffuseReflection) & (dr.max(reflectance) <= 1)
    return dr.select(is_known & ~(is_mixed & is_value), reflectance, weight)


@dr.syntax
def _follow(scene, query, sampler, ray, going):
    """Follows rays through perfectly specular surfaces, to the first surface that has a smooth
    lobe. Returns it, and its albedo times the weights of the samples on the way."""
    si, bounces = dr.zeros(mi.SurfaceInteraction3f), mi.UInt32(0)
    throughput, last = mi.UnpolarizedSpectrum(1), mi.UnpolarizedSpectrum(1)
    context = _context()
    while going:
        pi = query.closest(scene, ray, coherent=True, active=going)
        si = query.interaction(pi, ray)
        bsdf = si.bsdf()
        numbers = sampler.next_1d(going), sampler.next_2d(going)
        bs, weight = sample_bsdf(bsdf, context, si, *numbers, going)
        last = mi.unpolarized_spectrum(weight)
        # Does the surface only scatter specularly?
        is_specular = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        is_specular |= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        is_specular &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        going &= si.is_valid() & is_specular & (bounces < _MOST_BOUNCES)
        throughput = dr.select(going, throughput * last, throughput)
        ray = dr.select(going, query.starts.along(si, si.to_world(bs.wo)), ray)
        bounces += 1
    return si, throughput * _albedo(si, last, si.is_valid())
