"""The events that the random walk reports to learners, and the scout, which records where paths
scatter before learning begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scene.regions.surface_voxels import lit_normal
from .estimator import CameraRays
from .vertex import PathState, Vertex

#: About the number of paths that a scout records, and the number of vertices recorded of each.
_PATHS, _VERTICES = 1 << 16, 3

#: Longest path of a scout in segments.
SCOUT_DEPTH = _VERTICES + 1


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

    def scattering(self, vertex: Vertex, bs: mi.BSDFSample3f, active: mi.Bool) -> None:
        """Paths have gained all light at ``vertex``. ``bs`` is the direction in which they leave it
        (from the BSDF or the phase function), unless it is their last vertex."""

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

    def scattering(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.scattering(*arguments)

    def survival(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.survival(*arguments)

    def end(self, L: mi.Spectrum) -> None:
        for observer in self._observers:
            observer.end(L)

    def segment(self, *arguments: Any) -> None:
        for observer in self._observers:
            observer.segment(*arguments)


class Scout(Observer):
    """Records where paths scatter, for about 65,000 of the paths of one pass."""

    def begin(self, lanes: int, pixel: mi.UInt32 | None = None) -> None:
        stride = max(1, lanes // _PATHS)
        paths = -(-lanes // stride)
        self._lane = dr.arange(mi.UInt32, lanes)
        self._path = self._lane // stride
        self._is_recorded = self._lane == self._path * stride
        self._p = dr.zeros(mi.Point3f, paths * _VERTICES)
        self._n = dr.zeros(mi.Normal3f, paths * _VERTICES)
        self._seen = dr.zeros(mi.UInt32, paths * _VERTICES)
        dr.eval(self._path, self._is_recorded, self._p, self._n, self._seen)

    def vertex(self, vertex: Vertex, active: mi.Bool) -> None:
        si = vertex.si
        slot = self._path * _VERTICES + vertex.depth
        active = active & self._is_recorded & (vertex.depth < _VERTICES)
        dr.scatter(self._p, si.p, slot, active)
        dr.scatter(self._n, lit_normal(si), slot, active)
        dr.scatter(self._seen, mi.UInt32(1), slot, active)

    def vertices(self) -> tuple[mi.Point3f, mi.Normal3f]:
        """The positions of the vertices, and the geometric normals on the side that was hit."""
        slots = dr.compress(self._seen > 0)
        if len(slots) == 0:
            return mi.Point3f(), mi.Normal3f()
        p, n = dr.gather(mi.Point3f, self._p, slots), dr.gather(mi.Normal3f, self._n, slots)
        finite = dr.compress(dr.all(dr.isfinite(p) & dr.isfinite(n)))
        return dr.gather(mi.Point3f, p, finite), dr.gather(mi.Normal3f, n, finite)
