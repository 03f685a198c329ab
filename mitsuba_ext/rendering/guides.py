"""What guides a denoiser: albedo and normal of what the camera sees, in mirrors and through glass
too."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.estimator import Sample
from ..transport.path_decisions import SceneQuery
from . import camera
from .camera_samples import CameraSamples
from .plan import check_extent

#: The channels, as layers of an EXR call them.
CHANNELS = (*(f"albedo.{letter}" for letter in "RGB"), *(f"normal.{letter}" for letter in "XYZ"))

#: Samples per pixel.
_SPP = 32

#: Samples of a pass, about.
_PASS_SAMPLES = 1 << 22

#: Surfaces, at most, that a camera ray passes or is mirrored by.
_MOST_BOUNCES = 16


def render_guides(
    scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery, seed: int = 0
) -> dict[str, np.ndarray]:
    """Albedo and shading normal of the first surface that is not perfectly specular: where camera
    rays end that mirrors and glass send on. Replaces the contents of the film.

    Args:
        query: How a ray meets the scene.

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
            scene, query, sampler, mi.Ray3f(rays.ray), mi.Bool(True), mi.Color3f(1)
        )
        nothing = Sample(mi.Spectrum(0), mi.Bool(False))
        camera.put(film, block, rays, nothing, guides_of(si, si.is_valid(), throughput))
        dr.eval(block.tensor())
    film.put_block(block)
    image = np.array(film.develop())
    return {name: image[..., n - len(CHANNELS)] for n, name in enumerate(CHANNELS)}


def guides_of(
    si: mi.SurfaceInteraction3f, active: mi.Bool, throughput: mi.Color3f | float = 1.0
) -> list[mi.Float]:
    """RGB of the albedo, times what specular surfaces have left of it, and the shading normal."""
    albedo = _colour(si.bsdf().eval_diffuse_reflectance(si, active)) * throughput
    return [*dr.select(active, dr.clip(albedo, 0, 1), 0), *dr.select(active, si.sh_frame.n, 0)]


def _colour(value: mi.Spectrum) -> mi.Color3f:
    """A reflectance as RGB; grey in spectral variants, where it belongs to a few wavelengths."""
    value = mi.unpolarized_spectrum(value)
    if mi.is_spectral or mi.is_monochromatic:
        return mi.Color3f(dr.mean(value))
    return mi.Color3f(value)


@dr.syntax
def _follow(scene, query, sampler, ray, going, throughput):
    """Follows rays through what reflects and refracts like a mirror: to the first surface with a
    lobe that is not."""
    si, bounces = dr.zeros(mi.SurfaceInteraction3f), mi.UInt32(0)
    context = mi.BSDFContext()
    while going:
        pi = query.closest(scene, ray, coherent=True, active=going)
        si = query.interaction(pi, ray)
        bsdf = si.bsdf()
        bs, weight = bsdf.sample(context, si, sampler.next_1d(going), sampler.next_2d(going), going)
        # Is there anything but mirror images here?
        is_specular = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        is_specular |= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        is_specular &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        going &= si.is_valid() & is_specular & (bounces < _MOST_BOUNCES)
        throughput = dr.select(going, throughput * _colour(weight), throughput)
        ray = dr.select(going, si.spawn_ray(si.to_world(bs.wo)), ray)
        bounces += 1
    return si, throughput, bounces
