"""The samples of a pass, from camera rays to the image block: the functions that ``frozen.py``
records."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.decisions import CameraSamples
from ..transport.estimator import CameraRays, Estimator, Sample
from ..transport.frozen import frozen
from . import camera
from .mask_samples import LabelledSamples, Labels


class GradientsError(Exception):
    """The radiance depends on parameters for which gradients are enabled."""


@frozen(any_width=True)
def put_samples(
    estimator: Estimator,
    samples: CameraSamples,
    scene: mi.Scene,
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    lanes: camera.PassLanes,
    spp: int,
    weight: mi.Float | float,
    block: mi.ImageBlock,
    tally: mi.UInt64,
    labels: Labels | None,
) -> LabelledSamples | None:
    """Takes the samples of a pass, and puts them into a block. Kernels have the width of the lanes,
    whatever the width of tables. They read the state of the sampler, which has the same width.

    Parameters:
        estimator: Takes the samples. It must not read arrays on the host.
        samples: Chooses points of the aperture, times and wavelengths.
        spp: Samples per pixel of the whole render.
        weight: The weight of each sample.
        tally: Counts of rays, to which the rays of the pass are added.
        labels: Labels the samples for masks; ``None`` if there are none.

    Returns:
        The labelled samples, if there are masks.

    Raises:
        GradientsError: The radiance has gradients.
    """
    rays = _rays(samples, sensor, sampler, lanes, spp)
    labelled = None if labels is None else labels.of(scene, rays, weight)
    sample = _estimated(estimator, scene, sampler, rays)
    camera.put(sensor.film(), block, rays, sample, sample.aovs, weight)
    count_rays(tally, sample)
    return labelled


@frozen(any_width=True)
def look(
    estimator: Estimator,
    samples: CameraSamples,
    scene: mi.Scene,
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    lanes: camera.PassLanes,
    spp: int,
) -> mi.Spectrum:
    """The radiance of samples from which observers learn. They are not added to the film. The
    parameters, and what is raised, are as for :func:`put_samples`."""
    rays = _rays(samples, sensor, sampler, lanes, spp)
    return _estimated(estimator, scene, sampler, rays).L


def _rays(
    samples: CameraSamples, sensor: mi.Sensor, sampler: mi.Sampler, lanes: camera.PassLanes,
    spp: int,
) -> CameraRays:  # fmt: skip
    taken = lanes.lanes(sensor.film())
    numbers = camera.draw_numbers(sensor, sampler, taken, samples)
    return camera.camera_rays(sensor, taken, numbers, spp)


@frozen(any_width=True)
def _estimated(
    estimator: Estimator, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays
) -> Sample:
    """The samples of these rays. It is recorded alone where the sensor, or what else is found along
    the rays, cannot be recorded.

    Raises:
        GradientsError: The radiance has gradients.
    """
    sample = estimator(scene, sampler, rays, mi.Bool(True))
    if dr.grad_enabled(sample.L):
        raise GradientsError
    return sample


def recorded(estimator: Estimator) -> Estimator:
    """``estimator``, recorded alone."""

    def estimate(
        scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        return _estimated(estimator, scene, sampler, rays)

    return estimate


def count_rays(tally: mi.UInt64, sample: Sample) -> None:
    """Adds the counts of a pass to ``tally``."""
    counts = (
        sample.scatter_count,
        sample.shadow_count,
        sample.connection_count,
        dr.select(dr.max(dr.abs(sample.L)) == 0, 1, 0),
    )
    for index, count in enumerate(counts):
        dr.scatter_add(tally, mi.UInt64(count), mi.UInt32(index))
