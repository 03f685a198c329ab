"""The camera paths and the light paths of bidirectional path tracing in scenes with participating
media.

A segment between two vertices may cross index-matched surfaces, which are no vertices: the sums
stay the same there, and only the transmittance of the segment is carried on
(``medium_scattering.py`` says which). The density of a vertex contains it, as if the segment were
longer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import EmitterSampling
from ...transport.transmittance import for_weights
from .bidirectional_programs import BidirectionalProgram, LightSums
from .emission import EmittedRay
from .partial_sums import PartialSums, Sums


@dataclass
class SumsInMedia(Sums):
    """The sums of a subpath in a scene with media.

    Attributes:
        transmittance: The known transmittance of the current segment, so far.
        length: Its length so far; ``None`` for camera paths.
        before: For camera paths whose vertices are merged: the density of merging at the vertex
            before the last one; ``None`` between vertices.
        behind: At a surface that may let the path pass: the sums with which it then goes on;
            ``None`` between surfaces.
    """

    transmittance: mi.Float | None = None
    length: mi.Float | None = None
    before: mi.Float | None = None
    behind: SumsInMedia | None = None

    @classmethod
    def of(cls, sums: Sums, **more: Any) -> SumsInMedia:
        """``sums`` with ``more`` attributes."""
        return cls(**{field.name: getattr(sums, field.name) for field in fields(Sums)}, **more)


class BidirectionalProgramInMedia(BidirectionalProgram):
    """Weighs camera paths over all bidirectional techniques, in scenes with media."""

    weighs_transmittance = connects_all = True

    def begin(self, ray) -> SumsInMedia:
        lanes = dr.width(ray)
        sums = SumsInMedia.of(super().begin(ray), transmittance=dr.full(mi.Float, 1, lanes))
        if self.sums.merging_in_media is not None:
            sums.merging = dr.zeros(mi.Float, lanes)
        return sums

    def arrive(self, path, si, in_medium) -> SumsInMedia:
        passed = path.history.transmittance * in_medium.attenuation
        squared_distance = self._squared_distance(path, si)
        sums = self._arrived(path, si, squared_distance / for_weights(passed))
        # The environment has no distance
        seen = path.history.dVCM / self.sums.ratio(for_weights(passed))
        sums.dVCM = dr.select(si.is_valid(), sums.dVCM, seen)
        sums.merging = self.sums.merging_at(si, in_medium.mei.medium)
        behind = replace(path.history, transmittance=passed)
        before = path.history.merging
        return SumsInMedia.of(sums, transmittance=passed, before=before, behind=behind)

    def leave(self, vertex, bs) -> SumsInMedia:
        left, arrived = super().leave(vertex, bs), vertex.path.history
        left.merging = arrived.merging
        return _left(left, arrived.behind, bs)

    def _merging_before(self, vertex, d, squared_distance):
        ref, history = vertex.path.arrival.ref, vertex.path.history
        on_surface = dr.squared_norm(ref.n) > 0
        cosine = dr.abs(dr.dot(ref.n, d)) * dr.rsqrt(squared_distance)
        return self.sums.merging_before(
            history, squared_distance / for_weights(history.transmittance),
            dr.select(on_surface, cosine, 1), history.before,
        )  # fmt: skip


class LightSumsInMedia(LightSums):
    """Computes the partial sums along light paths in scenes with media.

    Parameters:
        sums, next_event: See :class:`LightSums`.
        scene: The scene.
    """

    def __init__(self, sums: PartialSums, next_event: EmitterSampling, scene: mi.Scene) -> None:
        super().__init__(sums, next_event)
        self._scene = scene

    def first(self, scene, query, emitted, pi, active) -> SumsInMedia:
        # The first vertex is not known yet
        lanes = dr.width(emitted.ray)
        none = self._sums.begin(dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes))
        if self._sums.splits:
            none.by_camera = dr.zeros(mi.Vector2f, lanes)
        one, zero = dr.full(mi.Float, 1, lanes), dr.zeros(mi.Float, lanes)
        return SumsInMedia.of(none, transmittance=one, length=zero)

    def arrive(self, history: SumsInMedia, vertex, start: EmittedRay) -> SumsInMedia:
        is_first = vertex.depth == 1
        passed = history.transmittance * vertex.medium.attenuation
        length = history.length + vertex.si.t
        behind = replace(history, transmittance=passed, length=length)
        si = mi.SurfaceInteraction3f(vertex.si)
        si.t = length
        known = for_weights(passed)
        first = self.at_first(self._scene, start, si, is_first, known)
        later = self._sums.arrive(
            history, si, dr.square(length) / known, is_first, by_light=True
        )
        sums = Sums(
            dr.select(is_first, first.dVCM, later.dVCM),
            dr.select(is_first, first.dVC, later.dVC),
            later.by_camera,
            is_caustic=~is_first & (history.dVCM == 0) if self._sums.merging is not None else None,
            by_kind=later.by_kind,
            merging=self._sums.merging_at(si, vertex.medium.mei.medium),
        )
        return SumsInMedia.of(sums, transmittance=passed, length=length, behind=behind)

    def leave(self, history: SumsInMedia, vertex, bs, reverse_pdf, passes) -> SumsInMedia:
        terms, medium = self._sums.terms, vertex.medium.mei.medium
        scatters = vertex.medium.scatters
        reverse = terms.reverse_density(
            mi.BSDFContext(), mi.BSDFPtr(None), vertex.si, medium, bs.wo, scatters
        )
        left = super().leave(
            history, vertex, bs, dr.select(scatters, reverse, reverse_pdf), passes & ~scatters
        )
        return _left(left, history.behind, bs)


def _left(sums: Sums, behind: SumsInMedia, bs: mi.BSDFSample3f) -> SumsInMedia:
    """The sums behind a vertex; ``behind`` if the sample ``bs`` passes it without turning."""
    passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    one = mi.Float(1)
    left = SumsInMedia.of(sums, transmittance=one)
    if behind.length is not None:
        left.length = mi.Float(0)
    left.is_caustic = None
    for field in fields(left):
        ours, theirs = getattr(left, field.name), getattr(behind, field.name)
        if ours is not None and theirs is not None:
            setattr(left, field.name, dr.select(passes, theirs, ours))
    return left
