"""Observers that are told the contributions of each technique of bidirectional path tracing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

from ..transport.estimator import CameraRays, Sample
from ..transport.observer import Observer, Observers


class TechniqueObserver(Observer):
    """Is told the contributions of each technique. The walk reports the contributions of camera
    paths alone (s = 0 and 1) by the methods of :class:`Observer`.

    Attributes:
        compares_with_camera: Should the methods be given ``by_camera``? For a path that another
            technique found, these are the densities with which a camera path alone finds it
            (:meth:`PartialSums.by_camera`), divided by the density of that technique times its
            number of connections. They take two words of each stored vertex.
    """

    compares_with_camera = False

    def start(self, rays: CameraRays) -> None:
        """A pass begins, with these camera rays. The values reported for camera paths are radiance:
        the importance of the rays has yet to multiply them. The values of splats include it."""

    def joined(
        self,
        s: mi.UInt32,
        t: mi.UInt32,
        value: mi.Spectrum,
        mis: mi.Float,
        by_camera: mi.Vector2f | tuple[()],
        active: mi.Bool,
    ) -> None:
        """The camera path in each lane was connected to a light path (s, t ≥ 2). This adds
        ``value`` to its radiance, the MIS weight ``mis`` included."""

    def splatted(
        self,
        s: mi.UInt32,
        position: mi.Point2f,
        value: mi.Spectrum,
        mis: mi.Float,
        by_camera: mi.Vector2f | tuple[()],
        active: mi.Bool,
    ) -> None:
        """Vertices of light paths were connected to the sensor (t = 1). This adds ``value``, the
        MIS weight ``mis`` included, at a position on the film (``Splats``)."""

    def traced(self, camera: Sample, whole: Sample) -> None:
        """A pass has been traced. ``camera`` holds the samples of camera paths, connections to
        light paths included; ``whole`` those of all techniques."""


class TechniqueObservers(Observers):
    """Passes each call on to several observers."""

    def __init__(self, observers: Sequence[TechniqueObserver]) -> None:
        super().__init__(observers)
        self._techniques = observers
        self.compares_with_camera = any(o.compares_with_camera for o in observers)

    def start(self, rays: CameraRays) -> None:
        for observer in self._techniques:
            observer.start(rays)

    def joined(self, *arguments: Any) -> None:
        for observer in self._techniques:
            observer.joined(*arguments)

    def splatted(self, *arguments: Any) -> None:
        for observer in self._techniques:
            observer.splatted(*arguments)

    def traced(self, *arguments: Any) -> None:
        for observer in self._techniques:
            observer.traced(*arguments)
