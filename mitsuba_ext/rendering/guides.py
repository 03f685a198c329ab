"""Auxiliary features for denoisers: albedo and normal of the surfaces that the camera sees, also in
mirrors and through glass."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.bsdfs import sample_bsdf
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
        si, throughput, _ = _follow(
            scene, query, sampler, mi.Ray3f(rays.ray), mi.Bool(True), mi.UnpolarizedSpectrum(1)
        )
        nothing, hit = Sample(mi.Spectrum(0), mi.Bool(False)), si.is_valid()
        albedo = _albedo(si, hit) * throughput
        if mi.is_spectral:
            importance = mi.unpolarized_spectrum(rays.importance)
            colour = camera.to_rgb(albedo * importance, rays.ray.wavelengths) / mi.Color3f(_WHITE)
        else:
            colour = dr.clip(_grey_or_rgb(albedo), 0, 1)
        found = [*dr.select(hit, colour, 0), *dr.select(hit, si.sh_frame.n, 0)]
        camera.put(film, block, rays, nothing, found)
        dr.eval(block.tensor())
    film.put_block(block)
    image = np.array(film.develop())[..., -len(CHANNELS) :]
    # Colours of sampled wavelengths may be negative
    image[..., :3] = np.clip(image[..., :3], 0, 1)
    return {name: image[..., n] for n, name in enumerate(CHANNELS)}


def guides_of(si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Float]:
    """RGB of a surface's albedo (grey in spectral variants) and its shading normal."""
    albedo = _albedo(si, active)
    colour = dr.clip(_grey_or_rgb(albedo), 0, 1)
    return [*dr.select(active, colour, 0), *dr.select(active, si.sh_frame.n, 0)]


def _grey_or_rgb(value: mi.UnpolarizedSpectrum) -> mi.Color3f:
    is_grey = mi.is_spectral or mi.is_monochromatic
    return mi.Color3f(channel_mean(value) if is_grey else value)


def _albedo(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
    return mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si, active))


@dr.syntax
def _follow(scene, query, sampler, ray, going, throughput):
    """Follows rays through perfectly specular surfaces, to the first surface that has a smooth
    lobe."""
    si, bounces = dr.zeros(mi.SurfaceInteraction3f), mi.UInt32(0)
    context = mi.BSDFContext()
    while going:
        pi = query.closest(scene, ray, coherent=True, active=going)
        si = query.interaction(pi, ray)
        bsdf = si.bsdf()
        numbers = sampler.next_1d(going), sampler.next_2d(going)
        bs, weight = sample_bsdf(bsdf, context, si, *numbers, going)
        # Does the surface only scatter specularly?
        is_specular = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        is_specular |= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        is_specular &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        going &= si.is_valid() & is_specular & (bounces < _MOST_BOUNCES)
        weight = mi.unpolarized_spectrum(weight)
        throughput = dr.select(going, throughput * weight, throughput)
        ray = dr.select(going, query.starts.along(si, si.to_world(bs.wo)), ray)
        bounces += 1
    return si, throughput, bounces
