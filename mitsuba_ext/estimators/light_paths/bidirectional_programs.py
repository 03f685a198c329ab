"""The camera paths and the light paths of bidirectional path tracing: their partial sums and MIS
weights, and how the sums are stored."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.heroes import Heroes
from ...transport.path_decisions import EmitterSampling
from ...transport.path_program import PathProgram, Subpaths
from ...transport.vertex import PathState, Vertex
from .choice.technique_observer import TechniqueObserver
from .emission import EmittedRay, LightEmission
from .light_program import LightProgram, StoredHistory
from .partial_sums import PartialSums, Sums, weight
from .scattering import cosine_of_delta
from .sensor import ConnectableSensor


class BidirectionalProgram(PathProgram):
    """Weighs camera paths over all bidirectional techniques: s vertices come from a light path (0:
    a camera path hits the light; 1: next event estimation), and t from a camera path (1: a light
    path's vertex is connected to the sensor). The history is the partial sums.

    Source: I. Georgiev, *Implementing Vertex Connection and Merging*, technical report, 2012.

    Parameters:
        scene: The scene.
        sums: Computes the partial sums.
        emission: Gives the densities of the rays with which light paths begin.
        sensor: The sensor to which light paths are connected; ``None`` to leave out t = 1.
        observer: Receives the densities of competing techniques; ``None`` if they are not needed.
        subpaths: Connects camera paths to light paths, and merges them.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sums: PartialSums,
        emission: LightEmission,
        sensor: ConnectableSensor | None,
        observer: TechniqueObserver | None = None,
        subpaths: Subpaths | None = None,
    ) -> None:
        self._ctx = Heroes(scene).context()
        self.sums, self._emission, self._sensor = sums, emission, sensor
        self._observer = observer if sums.splits else None
        self._origin = mi.Point3f(0)
        self.subpaths = subpaths

    def kernel_state(self) -> tuple:
        """The objects that kernels depend on."""
        return self.sums, self._emission, self._sensor, self.subpaths

    def begin(self, ray: mi.Ray3f) -> Sums:
        if self._sensor is None:
            return self.sums.begin(mi.Float(0), mi.Float(0))
        self._origin, pdf = self._sensor.origin(ray)
        dVCM = self.sums.image_count * self.sums.ratio(dr.rcp(pdf))
        return self.sums.begin(dVCM, dr.zeros(mi.Float, dr.width(pdf)))

    def arrive(self, path, si, in_medium) -> Sums:
        return self._arrived(path, si, self._squared_distance(path, si))

    def _squared_distance(self, path: PathState, si: mi.SurfaceInteraction3f) -> mi.Float:
        """The squared distance of ``si`` from the previous vertex, or from the point of the
        aperture where the path begins. It is 1 where the sensor's rays are parallel."""
        is_first = path.depth == 0
        ref = dr.select(is_first, self._origin, path.arrival.ref.p)
        squared = dr.squared_norm(si.p - ref)
        if self._sensor is not None and self._sensor.is_parallel:
            squared = dr.select(is_first, 1, squared)
        return squared

    def _arrived(
        self, path: PathState, si: mi.SurfaceInteraction3f, squared_distance: mi.Float
    ) -> Sums:
        """The sums at the vertex ``si``; see :meth:`PartialSums.arrive`."""
        is_first = path.depth == 0
        later = self.sums.arrive(path.history, si, squared_distance, is_first, by_light=False)
        # A ray that hits nothing keeps its density per solid angle
        return Sums(
            dr.select(si.is_valid(), later.dVCM, path.history.dVCM),
            dr.select(si.is_valid(), later.dVC, path.history.dVC),
            region=later.region,
            count=later.count,
            by_kind=later.by_kind,
        )

    def emission(self, weights, scene, si, ds, path, pdf) -> mi.Float:
        active = ds.emitter != None  # noqa: E711
        position, direction = self._emission.densities(
            scene, ds.emitter, -ds.d, self._emission.front(si), path.arrival.ref, active
        )
        # The density of next event estimation: per area for lights with a surface
        found = pdf * dr.select(
            si.is_valid(), dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist), 1
        )
        # dVCM holds the count of connections to light paths, but there is one to a light
        others = self.sums.ratio(found) * path.history.dVCM / self.sums.count
        emitted = self.sums.ratio(position * direction)
        others += emitted * path.history.dVC
        if self._observer is not None:
            self._observer.weighed(emitted * path.history.by_kind)
        # No other technique finds lights that the sensor sees directly
        return dr.select(path.depth == 0, 1, weight(others))

    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf) -> mi.Float:
        si, active = vertex.si, pdf > 0
        wo = si.to_local(ds.d)
        position, direction = self._emission.densities(
            scene, ds.emitter, -ds.d, ds.n, mi.Interaction3f(si), active
        )
        flags = ds.emitter.flags()
        is_point = mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
        has_area = ~is_point & ~mi.has_flag(flags, mi.EmitterFlags.Infinite)
        # The density with which a light path samples this segment, in the measure of next event
        # estimation
        emitted = position * direction * self.sums.cosine(si, wo)
        emitted *= dr.select(is_point, dr.rcp(dr.square(ds.dist)), 1)
        emitted *= dr.select(has_area, dr.rcp(dr.abs(dr.dot(ds.n, ds.d))), 1)
        inverse = dr.select(active, dr.rcp(pdf), 0)
        sums = vertex.path.history
        reverse = self._reverse_density(vertex, wo, active)
        others = self.sums.others(emitted * inverse, sums, reverse)
        others += dr.select(ds.delta, 0, self.sums.ratio(scattering_pdf * inverse))
        if self._observer is not None:
            self._observer.weighed(
                self.sums.by_kind(
                    emitted * inverse, sums, reverse, vertex.depth == 0, by_light=False
                )
            )
        return weight(others)

    def leave(self, vertex: Vertex, bs: mi.BSDFSample3f) -> Sums:
        si = vertex.si
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        active = si.is_valid() & ~is_delta
        reverse = self._reverse_density(vertex, bs.wo, active)
        cosine = dr.select(is_delta, cosine_of_delta(si, bs), self.sums.terms.cosine(si, bs.wo))
        cosine = dr.select(self.sums.is_open(si, bs.wo), cosine, 0)
        sums = self.sums.leave(
            vertex.path.history, cosine, bs.pdf, reverse, is_delta, vertex.depth == 0,
            by_light=False,
        )
        if self.sums.merging is not None:
            d = si.p - vertex.path.arrival.ref.p
            squared = dr.squared_norm(d)
            before = self._merging_before(vertex, d, squared)
            # The vertex before the first one is the sensor
            merges = si.is_valid() & is_delta & (vertex.depth > 0) & (squared > 0)
            sums.dVC += dr.select(merges, self.sums.ratio(cosine) * before, 0)
        return sums

    def _merging_before(
        self, vertex: Vertex, d: mi.Vector3f, squared_distance: mi.Float
    ) -> mi.Float | float:
        """:meth:`PartialSums.merging_before`; ``d`` leads here from the previous vertex."""
        cosine = dr.abs(dr.dot(vertex.path.arrival.ref.n, d)) * dr.rsqrt(squared_distance)
        return self.sums.merging_before(vertex.path.history, squared_distance, cosine)

    def _reverse_density(self, vertex: Vertex, wo: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The density with which a light path that arrives from ``wo`` goes on along the path."""
        medium = vertex.medium and vertex.medium.mei.medium
        terms = self.sums.terms
        return terms.reverse_density(self._ctx, vertex.bsdf, vertex.si, medium, wo, active)


class StoredSums(StoredHistory):
    """Stores the partial sums: ``last`` and ``dVC``; if they are split, also ``by_camera``, and the
    part of connections of ``by_kind``; and ``merging`` if it differs between vertices."""

    @classmethod
    def of(cls, sums: PartialSums) -> StoredSums:
        """For the sums that ``sums`` computes."""
        count = 5 if sums.splits else 2
        count += sums.merging_in_media is not None
        return cls(count, sums.selection is not None)

    def words(self, history: Sums) -> list[mi.Float]:
        words = [history.last, history.dVC]
        if self._splits:
            words += [*history.by_camera, history.by_kind.x]
        if self._merges:
            words.append(history.merging)
        return words

    def read(self, words, depth, region) -> Sums:
        sums = Sums(words[0], words[1], region=region)
        if self._splits:
            sums.by_camera = mi.Vector2f(words[2], words[3])
            sums.by_kind = mi.Vector2f(words[4], 0)
        if self._merges:
            sums.merging = words[-1]
        sums.is_caustic = (depth > 1) & (sums.dVCM == 0)
        return sums

    @property
    def _splits(self) -> bool:
        return self.word_count >= 5

    @property
    def _merges(self) -> bool:
        return self.word_count in (3, 6)


class LightSums(LightProgram):
    """Computes the partial sums along light paths.

    Parameters:
        sums: Computes them from one vertex to the next.
        next_event: The decision that samples points on lights for next event estimation at the
            vertices of camera paths.
    """

    is_weighed = True

    def __init__(self, sums: PartialSums, next_event: EmitterSampling) -> None:
        self._sums, self._next_event = sums, next_event
        self.stored = StoredSums.of(sums)

    def first(self, scene, query, emitted, pi, active) -> Sums:
        return self.at_first(scene, emitted, query.interaction(pi, emitted.ray), active)

    def at_first(
        self,
        scene: mi.Scene,
        emitted: EmittedRay,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
        transmittance: mi.Float | float = 1.0,
    ) -> Sums:
        """The sums at the first vertex after the light, ``si``. ``transmittance`` is the known
        transmittance of the segment."""
        is_delta = emitted.is_delta_position | emitted.is_delta_direction
        chosen = emitted.probability * emitted.pdf_position * emitted.pdf_direction
        # Densities per area, at the vertex (``arrives``) and at the light (``leaves``)
        arrives = chosen * self._sums.terms.cosine(si, si.wi)
        arrives /= dr.select(emitted.is_infinite, 1, dr.square(si.t))
        connected = self._connection_density(scene, emitted, si, active)
        leaves = dr.select(emitted.is_infinite, 1, emitted.cosine / dr.square(si.t))
        connected *= dr.select(is_delta, 1, leaves)
        inverse = dr.select(arrives > 0, dr.rcp(arrives), 0)
        if self._sums.terms.sees_media:
            # Emitted rays fly all the way; connections need not
            connected /= transmittance
        sums = self._sums.begin(
            self._sums.ratio(connected * inverse),
            dr.select(is_delta, 0, self._sums.ratio(leaves * inverse)),
        )
        if self._sums.splits:
            sums.by_camera = dr.zeros(mi.Vector2f, dr.width(inverse))
        return sums

    def _connection_density(self, scene, emitted, si, active) -> mi.Float:
        """The density with which next event estimation at ``si`` samples the point on the light:
        per solid angle, or the probability of choosing the light if it is a point or a
        direction."""
        next_event = self._next_event
        place = next_event.visit(next_event.begin(None, emitted.ray), scene, si, active)
        # The density of the BSDF sample is not known here: decisions that use it cannot be combined
        # with light paths
        d = -emitted.ray.d
        state = next_event.remember(place, scene, d, mi.Float(0), active)
        start, ds = emitted.start, dr.zeros(mi.DirectionSample3f, dr.width(si))
        ds.p, ds.n, ds.uv, ds.time = start.p, start.sh_frame.n, start.uv, si.time
        ds.d, ds.dist, ds.emitter = -emitted.ray.d, si.t, emitted.emitter
        ds.dist = dr.select(emitted.is_infinite, ds.dist, dr.norm(start.p - si.p))
        ref = mi.Interaction3f(si)
        is_delta = emitted.is_delta_position | (
            emitted.is_delta_direction & emitted.is_infinite
        )
        is_beam = emitted.is_delta_direction & ~emitted.is_infinite
        density = next_event.density(state, scene, ref, start, ds, active & ~is_delta & ~is_beam)
        if not _has_delta(scene):
            return density
        probability = next_event.probability(state, scene, ref, emitted.index, active & is_delta)
        return dr.select(is_beam, 0, dr.select(is_delta, probability, density))

    def arrive(self, history: Sums, vertex: Vertex, start: Any) -> Sums:
        si, is_first = vertex.si, vertex.depth == 1
        later = self._sums.arrive(history, si, dr.square(si.t), is_first, by_light=True)
        return Sums(
            dr.select(is_first, history.dVCM, later.dVCM),
            dr.select(is_first, history.dVC, later.dVC),
            later.by_camera,
            later.region,
            later.count,
            ~is_first & (history.dVCM == 0) if self._sums.merging is not None else None,
            later.by_kind,
        )

    def is_open(self, si, d) -> mi.Bool:
        return self._sums.is_open(si, d)

    def leave(self, history: Sums, vertex, bs, reverse_pdf, passes) -> Sums:
        si = vertex.si
        cosine = dr.select(passes, cosine_of_delta(si, bs), self._sums.terms.cosine(si, bs.wo))
        return self._sums.leave(
            history, cosine, bs.pdf, reverse_pdf, passes, vertex.depth == 1, by_light=True
        )


def _has_delta(scene: mi.Scene) -> bool:
    delta = int(mi.EmitterFlags.DeltaPosition) | int(mi.EmitterFlags.DeltaDirection)
    return any(int(e.flags()) & delta for e in scene.emitters())
