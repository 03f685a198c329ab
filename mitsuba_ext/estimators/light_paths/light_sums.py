"""The partial sums of MIS weights along light paths, and how they are stored."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import EmitterSampling
from .emission import EmittedRay
from .light_program import LightProgram, StoredHistory
from .partial_sums import PartialSums, Sums, arrival_cosine
from .scattering import cosine_of_delta, geometric_cosine


class StoredSums(StoredHistory):
    """Stores the partial sums: ``last`` and ``dVC``; if they are split, also ``by_camera``, and the
    part of connections of ``by_kind``."""

    @classmethod
    def of(cls, sums: PartialSums) -> StoredSums:
        """For the sums that ``sums`` computes."""
        return cls(5 if sums.splits else 2, sums.selection is not None)

    def words(self, history: Sums) -> list[mi.Float]:
        words = [history.last, history.dVC]
        if self.word_count > 2:
            words += [*history.by_camera, history.by_kind.x]
        return words

    def read(self, words, depth, region) -> Sums:
        sums = Sums(words[0], words[1], region=region)
        if self.word_count > 2:
            sums.by_camera = mi.Vector2f(words[2], words[3])
            sums.by_kind = mi.Vector2f(words[4], 0)
        sums.is_caustic = (depth > 1) & (sums.dVCM == 0)
        return sums


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
        self, scene: mi.Scene, emitted: EmittedRay, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> Sums:
        """The sums at the first vertex after the light, ``si``."""
        is_delta = emitted.is_delta_position | emitted.is_delta_direction
        chosen = emitted.probability * emitted.pdf_position * emitted.pdf_direction
        # Densities per area, at the vertex (``arrives``) and at the light (``leaves``)
        arrives = chosen * arrival_cosine(si) / dr.select(emitted.is_infinite, 1, dr.square(si.t))
        connected = self._connection_density(scene, emitted, si, active)
        leaves = dr.select(emitted.is_infinite, 1, emitted.cosine / dr.square(si.t))
        connected *= dr.select(is_delta, 1, leaves)
        inverse = dr.select(arrives > 0, dr.rcp(arrives), 0)
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

    def arrive(self, history: Sums, si, depth) -> Sums:
        is_first = depth == 1
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
        cosine = dr.select(passes, cosine_of_delta(si, bs), geometric_cosine(si, bs.wo))
        return self._sums.leave(
            history, cosine, bs.pdf, reverse_pdf, passes, vertex.depth == 1, by_light=True
        )



def _has_delta(scene: mi.Scene) -> bool:
    delta = int(mi.EmitterFlags.DeltaPosition) | int(mi.EmitterFlags.DeltaDirection)
    return any(int(e.flags()) & delta for e in scene.emitters())
