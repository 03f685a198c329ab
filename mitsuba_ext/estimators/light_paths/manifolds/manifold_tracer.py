"""The estimator with connections through casters: a walk, and one chain for each path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ....rendering.device import SampleBytes, device_of
from ....transport.estimator import CameraRays, Sample
from ....transport.frozen import frozen
from ....transport.numbers import Numbers, copied, go_to, reached, schedule_state
from ....transport.path_program import PathProgram
from ....transport.walk import Walk
from .chosen_vertices import ChosenVertices
from .connections import ManifoldConnections
from .history import NEVER, History
from .seed_learner import ChainRecords

#: Bytes that a sample stores besides its ray: a vertex, a task and its result.
SAMPLE_BYTES = 288

#: Is told the chains (:class:`ChainRecords`), the samples and the pixels of a pass.
Recorder = Callable[..., None]


class ManifoldProgram(PathProgram):
    """Follows paths whose vertices are connected to lights through casters, and weighs light that
    they hit behind casters against these connections.

    Parameters:
        connections: The connections.
        vertices: What is stored of the paths of this pass.
        lanes: Number of paths.
    """

    def __init__(
        self, connections: ManifoldConnections, vertices: ChosenVertices, lanes: int
    ) -> None:
        self._connections, self.subpaths, self._lanes = connections, vertices, lanes

    def begin(self, ray):
        return History(
            mi.Point3f(ray.o), mi.Normal3f(0), mi.Vector3f(ray.d), mi.Float(0),
            mi.UInt32(NEVER), mi.UInt32(0),
            dr.arange(mi.UInt32, self._lanes), mi.Float(0),
            mi.Vector4f(0) if self._connections.are_rough else None,
        )  # fmt: skip

    def leave(self, vertex, bs):
        h, si = vertex.path.history, vertex.si
        goes_on = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if self._connections.are_rough:
            goes_on |= self._connections.is_rough(si)
        transmits = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission)
        onward, _ = h.past(self._connections.casters, si, bs.wo, transmits)
        begun = replace(
            onward, p=si.p, n=si.n, d=si.to_world(bs.wo), pdf=mi.Float(1), length=mi.UInt32(0),
            transmits=mi.UInt32(0),
        )
        history = dr.select(goes_on, onward, begun)
        total = h.total + self.subpaths.importance(vertex)
        return replace(history, pdf=history.pdf * bs.pdf, total=total)

    @dr.syntax
    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf):
        mis = weights.connection(ds, pdf, scattering_pdf)
        if dr.hint(self._connections.are_rough, mode="scalar"):
            h, si = vertex.path.history, vertex.si
            wo = si.to_local(ds.d)
            transmits = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) < 0
            onward, own = h.past(self._connections.casters, si, wo, transmits)
            own &= self._connections.is_rough(si) & (pdf > 0) & (scattering_pdf > 0)
            own &= self.subpaths.is_connected(h.lane)
            onward = replace(onward, pdf=onward.pdf * scattering_pdf)
            # A branch: few connections belong to chains
            if dr.hint(own, label="connections in chains"):
                mis *= self._connections.weight_of_connection(
                    onward, vertex, ds, scattering_pdf, own
                )
        return mis

    @dr.syntax
    def emission(self, weights, scene, si, ds, path, pdf):
        length = path.history.length
        own = (length > 0) & (length != NEVER) & (ds.emitter != None)  # noqa: E711
        own &= self.subpaths.is_connected(path.history.lane)
        mis = weights.emission(path.arrival.pdf, pdf)
        # A branch: few paths take it
        if dr.hint(own, label="weight of chains"):
            others = dr.select(path.arrival.is_delta, 1, mis)
            mis = others * self._connections.weight(path, si, ds, own)
        return mis


@dataclass
class ManifoldTracer:
    """Traces camera paths, and connects one vertex of each through casters. It is an
    :class:`Estimator`.

    Parameters:
        walk: Traces the camera paths.
        connections: The connections.
        record: Called with chains, samples and pixels of each pass; ``None`` if nothing learns
            from them.
        stride: One in ``stride`` paths is connected; the others are those of ``walk``.
    """

    walk: Walk
    connections: ManifoldConnections
    record: Recorder | None
    stride: mi.UInt32

    @property
    def most_lanes(self) -> int:
        """The most samples of a pass."""
        return device_of(mi.Float).lanes(SampleBytes(SAMPLE_BYTES))

    def __call__(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        # Evaluated now, since several kernels read the rays; the walk needs no differentials
        rays = replace(rays, ray=mi.RayDifferential3f(mi.Ray3f(rays.ray)))
        dr.eval(rays)
        trace = _traced if self.walk.observer.can_be_frozen else _traced.__wrapped__
        # Chains are recorded on the host, which a frozen function cannot do
        tracer, records = replace(self, record=None), self.record is not None
        (sample, chains), place = trace(tracer, scene, sampler, rays, mi.Bool(active), records)
        go_to(sampler, place)
        if records:
            self.record(chains, sample, rays.pixel)
        return sample

    def trace(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool, records: bool
    ) -> tuple[Sample, ChainRecords | None]:
        """The samples of these rays, and their chains if they are recorded."""
        lanes = dr.width(rays.ray)
        channels = self.walk.channels
        vertices = self.connections.vertices(lanes, channels, self.stride)
        program = ManifoldProgram(self.connections, vertices, lanes)
        walk = replace(self.walk, program=program)
        sample, direct = walk.unclamped(scene, sampler, rays, active)
        vertices.schedule()
        # With the state of the sampler: a later kernel would trace the walk again to find it
        schedule_state(sampler)
        dr.eval(sample, direct)
        L, parts, tested, chains = self.connections.gather(vertices, rays, channels, records)
        sample = replace(sample, L=sample.L + L, shadow_count=sample.shadow_count + tested)
        if channels is not None:
            gained = channels.colours_of(parts, rays)
            sample.aovs = [value + more for value, more in zip(sample.aovs, gained)]
        return walk.clamped(sample, direct), chains


@frozen
def _traced(
    tracer: ManifoldTracer, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool,
    records: bool,
) -> tuple[tuple[Sample, ChainRecords | None], Any]:
    """The samples and chains of ``tracer``, and the position that the sampler has reached."""
    numbers = copied(sampler)
    return tracer.trace(scene, numbers, rays, active, records), reached(numbers)
