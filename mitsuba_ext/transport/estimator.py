"""The interface between a render and its estimator of radiance: camera rays in, samples out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import drjit as dr
import mitsuba as mi


@dataclass
class CameraRays:
    """The rays of a pass, one in each lane.

    Attributes:
        ray: The rays themselves.
        pixel: The number of the ray's pixel, row by row in the film's extent; ``None`` for rays
            that belong to no film.
        importance: The sensor's importance, a factor of the radiance along the ray.
        position: Where on the film (in pixels) the result is added.
        weight: Importance weight of a sample; 1.0 where all count the same.
        hero_weight: A further factor, for paths on which only the first wavelength is left
            (``heroes.py``). The estimator applies it.
        medium: The participating medium in which the rays begin; ``None`` in a vacuum.
        distance: The primary sample that chooses the first distance in a homogeneous medium;
            ``None`` if the sampler chooses it.
        first: The first surface that each ray meets; ``None`` if it is not known.
    """

    ray: mi.RayDifferential3f
    pixel: mi.UInt32 | None = None
    importance: mi.Spectrum | float = 1.0
    position: mi.Point2f | None = None
    weight: mi.Float | float = 1.0
    hero_weight: mi.Float | float = 1.0
    medium: mi.Medium | None = None
    distance: mi.Float | None = None
    first: mi.PreliminaryIntersection3f | None = None


@dataclass
class Splats:
    """Contributions of light paths that reach the sensor. They can land in any pixel, not only
    where a camera ray begins, and there may be more or fewer of them than camera rays.

    Attributes:
        value: Radiance times importance; the mean over all camera samples of a pixel's splats is
            added to it.
        position: Where on the film, in pixels of its crop window plus that window's offset.
        wavelengths: The wavelengths of ``value``, in spectral variants.
        active: Which lanes have something to add.
        sample: For Markov chains: the number of the camera ray to whose sample each splat belongs.
        channels: The part of ``value`` that belongs to each light path expression.
    """

    value: mi.Spectrum
    position: mi.Point2f
    wavelengths: mi.Spectrum | None
    active: mi.Bool
    sample: mi.UInt32 | None = None
    channels: list[mi.Spectrum] = field(default_factory=list)


@dataclass
class Sample:
    """The result of one camera ray.

    Attributes:
        L: Radiance estimate.
        valid: Whether the path hit a surface that scattered it (or the visible environment); this
            becomes alpha. ``L`` need not be zero elsewhere: a null surface may be lit.
        scatter_count: Rays traced in directions that a BSDF chose.
        shadow_count: Shadow rays traced. Counts are arrays of any width; only their sum matters.
        connection_count: Connections to a light that were considered: ``path`` traces a shadow ray
            for each of them.
        aovs: Values of arbitrary output variables, if the estimator finds any.
        splats: Contributions to other pixels.
    """

    L: mi.Spectrum
    valid: mi.Bool
    scatter_count: mi.UInt32 = field(default_factory=lambda: dr.zeros(mi.UInt32))
    shadow_count: mi.UInt32 = field(default_factory=lambda: dr.zeros(mi.UInt32))
    connection_count: mi.UInt32 = field(default_factory=lambda: dr.zeros(mi.UInt32))
    aovs: list[mi.Float] = field(default_factory=list)
    splats: list[Splats] = field(default_factory=list)


class Estimator(Protocol):
    """Estimates the radiance along camera rays.

    Attributes:
        can_be_frozen: Whether a call may be recorded as a whole (``frozen.py``). It then reads no
            array on the host, and makes no splats. Estimators without this attribute are not
            recorded.
    """

    def __call__(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        """One sample for each lane of ``rays``. ``sampler`` may be anything that has ``next_1d``
        and ``next_2d`` (``numbers.py``)."""
