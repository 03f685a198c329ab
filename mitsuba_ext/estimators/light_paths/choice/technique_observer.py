"""Observers that receive the contributions of each technique of bidirectional path tracing."""

from __future__ import annotations

import mitsuba as mi

from ....transport.estimator import CameraRays, Sample
from ....transport.observer import Observer
from ..partial_sums import CompetingDensities
from .candidates import Available


class TechniqueObserver(Observer):
    """Receives the contributions of each technique. The walk reports the contributions of camera
    paths alone (s = 0 and 1) through the methods of :class:`Observer`.

    Attributes:
        compares: Whether the methods receive ``competing``, which takes three words of each stored
            vertex. (It is ``None`` otherwise.)
    """

    compares = False
    can_be_frozen = False

    def start(self, rays: CameraRays, available: Available) -> None:
        """A pass begins, with these camera rays, and with all techniques that are available. The
        values reported for camera paths are radiance, not yet multiplied by the importance of the
        rays. The values of splats include it."""

    def joined(
        self,
        s: mi.UInt32,
        t: mi.UInt32,
        value: mi.Spectrum,
        mis: mi.Float,
        competing: CompetingDensities | None,
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
        competing: CompetingDensities | None,
        active: mi.Bool,
    ) -> None:
        """Vertices of light paths were connected to the sensor (t = 1). This adds ``value``, the
        MIS weight ``mis`` included, at a position on the film (``Splats``)."""

    def merged(
        self,
        value: mi.Spectrum,
        mis: mi.Float,
        competing: CompetingDensities | None,
        active: mi.Bool,
        in_medium: bool = False,
    ) -> None:
        """The camera path in each lane was merged with a light path, on a surface or
        ``in_medium``. This adds ``value`` to its radiance, the MIS weight ``mis`` included."""

    def photon(self, value: mi.Spectrum, active: mi.Bool) -> None:
        """The camera path in each lane was merged with a vertex of a light path; merging is the
        only technique. This adds ``value`` to its radiance."""

    def searched(self, count: mi.UInt32) -> None:
        """At a vertex of the camera path in each lane, ``count`` vertices were looked at."""

    def weighed(self, by_kind: mi.Vector2f) -> None:
        """A technique of camera paths alone has been weighed; its contribution is reported next
        (``emission``, ``connection``). See :class:`CompetingDensities` for ``by_kind``."""

    def found_by(self, light_path: mi.UInt32) -> None:
        """The number of the light path to which the contribution belongs that is reported next
        (``joined``, ``splatted``, ``merged``)."""

    def traced(self, camera: Sample, whole: Sample) -> None:
        """A pass has been traced. ``camera`` holds the samples of camera paths, connections to
        light paths included; ``whole`` holds the samples of all techniques."""
