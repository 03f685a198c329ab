"""What the techniques of bidirectional path tracing tell those who compare them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

from ..transport.estimator import CameraRays, Sample
from ..transport.observer import Observer, Observers


class TechniqueObserver(Observer):
    """Is told what each technique finds. What camera paths find by themselves (s = 0 and 1) the
    walk tells by the methods of :class:`Observer`.

    Attributes:
        compares_with_camera: Does it want to know with what density camera paths find by themselves
            what others find? It is :meth:`PartialSums.by_camera`, here ``by_camera``, in units of
            the density of the technique that found it, connections counted. It costs two words of
            each stored vertex.
    """

    compares_with_camera = False

    def start(self, rays: CameraRays) -> None:
        """A pass begins, with these camera rays. What is told of camera paths is radiance, which
        the importance of their rays multiplies; splats hold it already."""

    def joined(
        self,
        s: mi.UInt32,
        t: mi.UInt32,
        value: mi.Spectrum,
        mis: mi.Float,
        by_camera: mi.Vector2f | tuple[()],
        active: mi.Bool,
    ) -> None:
        """The camera path of each lane was connected to a light path (s, t ≥ 2), and gains
        ``value``, the MIS weight ``mis`` included."""

    def splatted(
        self,
        s: mi.UInt32,
        position: mi.Point2f,
        value: mi.Spectrum,
        mis: mi.Float,
        by_camera: mi.Vector2f | tuple[()],
        active: mi.Bool,
    ) -> None:
        """Vertices of light paths were connected to the sensor (t = 1), and bring ``value``, the
        MIS weight included, to a position on the film (``Splats``)."""

    def traced(self, camera: Sample, whole: Sample) -> None:
        """A pass has been traced: what camera paths brought, connections to light paths included,
        and what all techniques brought."""


class TechniqueObservers(Observers):
    """Tells several observers the same."""

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
