"""The fraction of camera samples with zero radiance, for integrators that do not count them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi

#: The approximate number of samples, for which the standard error is at most 0.1 %.
_SAMPLES = 1 << 18


def zero_radiance_share(integrator: mi.Integrator, scene: mi.Scene, seed: int) -> float | None:
    """The fraction of camera samples with zero radiance; ``None`` if the integrator cannot trace
    single camera samples (a light tracer, or an integrator for gradients)."""
    import drjit as dr
    import mitsuba as mi

    from ..rendering import camera
    from ..transport.decisions import CameraSamples

    if not isinstance(integrator, mi.SamplingIntegrator):
        return None
    sensor = scene.sensors()[0]
    width, height = camera.film_extent(sensor.film())
    spp = max(1, _SAMPLES // (width * height))
    try:
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()
        camera.tell_film(sampler, sensor.film())
        sampler.seed(seed, width * height * spp)
        rays = camera.sample_rays(sensor, sampler, spp, spp, CameraSamples())
        L = integrator.sample(scene, sampler, rays.ray, None, mi.Bool(True))[0]
    except Exception:  # sample() has another signature, the sampler cannot be copied, …
        return None
    return float(dr.mean(dr.select(dr.max(dr.abs(L)) == 0, mi.Float(1), mi.Float(0)))[0])
