"""The events that the random walk reports to learners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

from .estimator import CameraRays
from .vertex import PathState, Vertex


class Observer:
    """Receives the events of a walk while it is traced. Subclasses override the methods that they
    need, and scatter into arrays of their own; they return nothing and do not change the walk.

    No observer is a dataclass: Dr.Jit would treat a dataclass used in a loop as part of its state.
    """

    #: Whether a pass that it observes may be recorded (``frozen.py``): false if the observer
    #: rebinds attributes while the pass is traced.
    can_be_frozen = True

    def camera(self, rays: CameraRays) -> None:
        """The camera rays of the pass that begins."""

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        """A pass of ``lanes`` paths begins; ``pixel`` is the film pixel of each. The render calls
        this before the walk is traced, so that observers can allocate arrays."""

    def emission(
        self,
        path: PathState,
        ds: mi.DirectionSample3f,
        value: mi.Spectrum,
        mis: mi.Float,
        pdf: mi.Float,
        active: mi.Bool,
    ) -> None:
        """``path`` may have hit a light, in the direction ``ds`` from its last vertex, and gains
        ``value``, the MIS weight ``mis`` included. ``pdf`` is the density with which a connection
        finds this direction; 0 where no connection can."""

    def vertex(self, vertex: Vertex, active: mi.Bool) -> None:
        """A path is about to connect ``vertex`` to lights."""

    def connection(
        self,
        choice: Any,
        vertex: Vertex,
        ds: mi.DirectionSample3f,
        contribution: mi.Spectrum,
        value: mi.Spectrum,
        pdf: mi.Float,
        visible: mi.Bool,
        tested: mi.Bool,
    ) -> None:
        """A shadow ray was traced where ``tested``. ``choice`` is what the next event decision
        returned about its choice; ``contribution`` is BSDF · radiance / pdf; ``value`` is this
        times MIS weight and throughput: what the path gains where the light is ``visible``; ``pdf``
        is the density with which scattering finds the direction."""

    def subpath(
        self,
        vertex: Vertex,
        region: mi.UInt32,
        probability: mi.Float,
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """``vertex`` was connected to a vertex of another subpath, in a region that was chosen with
        this probability, and the path gains ``value``: 0 also where there was no vertex to choose,
        or the connection is occluded."""

    def direction(
        self,
        vertex: Vertex,
        sample: mi.Point2f,
        weight: mi.Float | float,
        L: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """The primary sample ``sample``, of density 1 / ``weight``, chose the direction in which a
        path continues. The path has gathered the radiance ``L`` so far."""

    def survival(self, path: PathState, probability: mi.Float, active: mi.Bool) -> None:
        """Russian roulette lets a path continue with this probability; ``path`` is its state for
        the next vertex, whose throughput is not yet divided by the probability."""

    def end(self, L: mi.Spectrum) -> None:
        """All paths of the pass have ended, with the radiance estimates ``L``."""

    def segment(self, p: mi.Point3f, q: mi.Point3f, active: mi.Bool) -> None:
        """A path went from ``p`` to ``q``."""


class Observers(Observer):
    """Forwards each event to several observers."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = observers

    def camera(self, rays: CameraRays) -> None:
        for observer in self._observers:
            observer.camera(rays)

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        for observer in self._observers:
            observer.begin(lanes, pixel)

    @property
    def can_be_frozen(self) -> bool:
        return all(observer.can_be_frozen for observer in self._observers)

    def emission(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.emission(*arguments)

    def vertex(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.vertex(*arguments)

    def connection(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.connection(*arguments)

    def subpath(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.subpath(*arguments)

    def direction(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.direction(*arguments)

    def survival(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.survival(*arguments)

    def end(self, L: mi.Spectrum) -> None:
        for observer in self._observers:
            observer.end(L)

    def segment(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.segment(*arguments)
