"""The share of camera samples with zero radiance, for integrators that do not count them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi

#: Approximate number of samples. The standard error of the share is then at most 0.1 %.
_SAMPLES = 1 << 18


def zero_radiance_share(integrator: mi.Integrator, scene: mi.Scene, seed: int) -> float | None:
    """The share of camera samples whose radiance is zero; ``None`` if the integrator cannot trace
    single camera samples (a light tracer, or one for gradients)."""
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
    except Exception:  # sample() of another signature, a sampler that cannot be copied, …
        return None
    return float(dr.mean(dr.select(dr.max(dr.abs(L)) == 0, mi.Float(1), mi.Float(0)))[0])
