"""The decisions that a render uses to take its samples."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

import mitsuba as mi

from .estimator import Estimator
from .free_flight import Distances
from .numbers import Numbers
from .path_decisions import (
    ConnectionCount,
    DirectionSamples,
    EmitterSampling,
    Roulette,
    Scattering,
    SceneQuery,
    ShadowTest,
    SubpathSelection,
    Weights,
)


class PixelNumbers(Protocol):
    """A source of numbers for one purpose."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[Any, ...]:
        """The number for sample ``index`` of each pixel (counted over the whole render), and its
        weight (or two weights). ``sampler`` is the sensor's sampler."""


@dataclass(frozen=True)
class CameraSamples:
    """The sources of the numbers of camera rays. ``None`` stands for the sensor's sampler, as in
    Mitsuba.

    Attributes:
        aperture: Chooses points on the aperture, in two dimensions.
        time: Chooses times in the shutter interval.
        wavelength: Chooses the four wavelengths u + k/4. Each draw has a second weight, for
            radiance that all four wavelengths carry, where the density of u has the period 1/4.
        distance: Chooses the first distance of a path in a homogeneous medium.
    """

    aperture: PixelNumbers | None = None
    time: PixelNumbers | None = None
    wavelength: PixelNumbers | None = None
    distance: PixelNumbers | None = None


class WarpedLights(Protocol):
    """Warps the numbers that choose a light and a point on it."""

    def around(self, next_event: EmitterSampling) -> EmitterSampling:
        """``next_event``, with warped numbers."""


class Caustics(Protocol):
    """Finds light that smooth surfaces lead to the vertices of a walk."""

    def around(self, walk: Any) -> Estimator:
        """The estimator that traces the paths of ``walk``, and adds this light."""


@dataclass(frozen=True)
class Decisions(CameraSamples):
    """The decisions of a stage, one for each slot of an integrator. ``None`` stands for the
    decision of Mitsuba's ``path``.

    Attributes:
        directions: Draws the primary samples that choose the lobe and the direction of a BSDF
            sample.
        scattering: Chooses the direction in which a path continues.
        next_event: Chooses a light and the point on it to connect to.
        light_numbers: Warps the primary samples of ``next_event``.
        roulette: The probability with which a path continues.
        flights: Draws the random numbers that choose how far a path flies in a medium.
        connections: The number of points on lights to which a vertex is connected.
        mis: The MIS weights of connections and of scattering.
        shadow_test: Decides whether the shadow ray of a connection is traced.
        caustics: Finds light that smooth surfaces lead to a vertex.
        query: How rays intersect the scene.
        subpath_selection: Chooses the vertices of light paths to which a vertex is connected.
        light_paths: How many light paths are traced, and what is done with them (only integrators
            with light paths know its type).
    """

    directions: DirectionSamples | None = None
    scattering: Scattering | None = None
    next_event: EmitterSampling | None = None
    light_numbers: WarpedLights | None = None
    roulette: Roulette | None = None
    flights: Distances | None = None
    connections: ConnectionCount | None = None
    mis: Weights | None = None
    shadow_test: ShadowTest | None = None
    caustics: Caustics | None = None
    query: SceneQuery | None = None
    subpath_selection: SubpathSelection | None = None
    light_paths: Any = None

    @property
    def camera(self) -> CameraSamples:
        """Only the sources of the numbers of camera rays."""
        return CameraSamples(**{name: getattr(self, name) for name in CAMERA_SLOTS})

    def of_walk(self) -> dict[str, Any]:
        """The parameters of :class:`~mitsuba_ext.transport.walk.Walk` that these decisions set."""
        chosen = {name: getattr(self, name) for name in _WALK_SLOTS}
        if self.light_numbers is not None:
            chosen["next_event"] = self.light_numbers.around(self.next_event or EmitterSampling())
        chosen["distance"] = self.flights
        return {name: decision for name, decision in chosen.items() if decision is not None}


#: The slots of camera rays.
CAMERA_SLOTS = tuple(field.name for field in fields(CameraSamples))

#: The slots that a walk has.
_WALK_SLOTS = (
    "directions", "scattering", "next_event", "roulette", "connections", "mis", "shadow_test",
    "query",
)  # fmt: skip
