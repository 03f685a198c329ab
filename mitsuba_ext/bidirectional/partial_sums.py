"""What a subpath has to know of itself for the MIS weights of all techniques that could have made
the path that it becomes a part of.

Source: I. Georgiev, *Implementing Vertex Connection and Merging*, technical report, 2012: the
quantities dVCM and dVC, without merging. All ratios of densities are raised to the heuristic's
exponent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from ..transport.path_decisions import EmitterSampling, SubpathSelection
from .both_ends import from_both_ends

if TYPE_CHECKING:
    from .emission import EmittedRay


@dataclass
class Sums:
    """The partial sums of a subpath at its last vertex (Eqs. 31 to 36 of the report).

    Attributes:
        dVCM: 1 / density of the last vertex, times the count of the technique that connects the
            last two; at the first vertex, times the ratio of the densities with which a connection
            and emission find the point of the light.
        dVC: The sum over the techniques that connect earlier vertices of the subpath.
        by_camera: For light paths, from the second vertex on, where :class:`PartialSums` follows
            it: the two terms of dVC in which a camera path finds the whole path (s = 0 and 1), not
            raised to the exponent.
        region, count: Where the vertices that are connected are chosen by regions (elsewhere
            ``()``): the region of the last vertex; and what multiplies ``dVCM`` where the
            technique that connects the last two is such a connection.
    """

    dVCM: mi.Float
    dVC: mi.Float
    by_camera: mi.Vector2f | tuple[()] = ()
    region: Any = ()
    count: Any = ()

    @property
    def last(self) -> mi.Float:
        """``dVCM``, times the count of connections that are chosen by regions."""
        return self.dVCM if isinstance(self.count, tuple) else self.dVCM * self.count


class PartialSums:
    """Computes the sums along light paths.

    Parameters:
        next_event: The decision with which the other end's vertices are connected to points of
            lights.
        connections: To how many of the vertices of a light path a vertex of a camera path is
            connected (s, t ≥ 2), on average, in units of all of them. All other techniques are used
            once for each pair of paths.
        exponent: 1 for the balance heuristic, 2 for the power heuristic.
        follows_camera: Is ``by_camera`` of :class:`Sums` wanted?
        selection: Chooses the vertices of light paths by regions; what it expects for a pair of
            regions multiplies ``connections``. ``None`` where all vertices are alike.
    """

    def __init__(
        self,
        next_event: EmitterSampling,
        connections: mi.Float | float = 1.0,
        exponent: int = 2,
        follows_camera: bool = False,
        selection: SubpathSelection | None = None,
    ) -> None:
        self._next_event, self.exponent, self.selection = next_event, exponent, selection
        self.follows_camera = follows_camera
        #: The count of the connections, in weights.
        self.count = self.ratio(mi.Float(connections))

    def ratio(self, x: mi.Float) -> mi.Float:
        """A ratio of densities, raised to the exponent."""
        return dr.square(x) if self.exponent == 2 else x

    def root(self, ratio: mi.Float) -> mi.Float:
        """The inverse of :meth:`ratio`."""
        return dr.sqrt(ratio) if self.exponent == 2 else ratio

    def first(
        self, scene: mi.Scene, emitted: EmittedRay, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> Sums:
        """At the first vertex after the light, ``si``."""
        is_delta = emitted.is_delta_position | emitted.is_delta_direction
        chosen = emitted.probability * emitted.pdf_position * emitted.pdf_direction
        # Per area at the vertex; per area at the light
        arrives = chosen * _cosine(si) / dr.select(emitted.is_infinite, 1, dr.square(si.t))
        connected = self._connection_density(scene, emitted, si, active)
        leaves = dr.select(emitted.is_infinite, 1, emitted.cosine / dr.square(si.t))
        connected *= dr.select(is_delta, 1, leaves)
        inverse = dr.select(arrives > 0, dr.rcp(arrives), 0)
        sums = self.begin(
            self.ratio(connected * inverse),
            dr.select(is_delta, 0, self.ratio(leaves * inverse)),
        )
        if self.follows_camera:
            sums.by_camera = dr.zeros(mi.Vector2f, dr.width(inverse))
        return sums

    def begin(self, dVCM: mi.Float, dVC: mi.Float) -> Sums:
        """The sums where a subpath begins."""
        if self.selection is None:
            return Sums(dVCM, dVC)
        lanes = dr.width(dVCM)
        region, count = dr.zeros(mi.UInt32, lanes), dr.full(mi.Float, 1, lanes)
        return Sums(dVCM, dVC, region=region, count=count)

    def others(self, density: mi.Float, sums: Sums, reverse_pdf: mi.Float) -> mi.Float:
        """Where a subpath's last vertex is connected to something: the ratios, to that technique,
        of all techniques that find this vertex from the other side, summed.

        Parameters:
            density: With which the other side finds the vertex, in units of the technique's density
                (per area, where the technique itself has density 1).
            reverse_pdf: Of going on from there to the subpath's vertex before, per solid angle.
        """
        return self.ratio(density) * (sums.last + self.ratio(reverse_pdf) * sums.dVC)

    def _connection_density(self, scene, emitted, si, active) -> mi.Float:
        """With which a connection from ``si`` finds the point of the light: per solid angle, or
        the probability of choosing the light if it is a point or a direction."""
        place = self._next_event.visit(
            self._next_event.begin(None, emitted.ray), scene, si, active
        )
        # With what density scattering finds the light is not known here: decisions that ask for it
        # have no place beside light paths
        d = -emitted.ray.d
        state = self._next_event.remember(place, scene, d, mi.Float(0), active)
        start, ds = emitted.start, dr.zeros(mi.DirectionSample3f, dr.width(si))
        ds.p, ds.n, ds.uv, ds.time = start.p, start.sh_frame.n, start.uv, si.time
        ds.d, ds.dist, ds.emitter = -emitted.ray.d, si.t, emitted.emitter
        ds.dist = dr.select(emitted.is_infinite, ds.dist, dr.norm(start.p - si.p))
        ref = mi.Interaction3f(si)
        is_delta = emitted.is_delta_position | (
            emitted.is_delta_direction & emitted.is_infinite
        )
        is_beam = emitted.is_delta_direction & ~emitted.is_infinite
        density = self._next_event.density(
            state, scene, ref, start, ds, active & ~is_delta & ~is_beam
        )
        if not _has_delta(scene):
            return density
        probability = self._next_event.probability(
            state, scene, ref, emitted.index, active & is_delta
        )
        return dr.select(is_beam, 0, dr.select(is_delta, probability, density))

    def arrive(
        self,
        sums: Sums,
        si: mi.SurfaceInteraction3f,
        squared_distance: mi.Float,
        is_first: mi.Bool,
        by_light: bool,
    ) -> Sums:
        """From a vertex to the next one, ``si``, at this distance: solid angles become areas.

        Parameters:
            is_first: Is it the first vertex of the subpath?
            by_light: Is the subpath that of a light?
        """
        inverse = dr.rcp(dr.maximum(_cosine(si), 1e-12))
        region, count = (), ()
        if self.selection is not None:
            region = self.selection.region(from_both_ends(si), si.is_valid())
            ends = (region, sums.region) if by_light else (sums.region, region)
            expected = self.selection.expected(*ends, si.is_valid() & ~is_first)
            # What connects the first vertex to the end of the path is no such connection
            count = dr.select(is_first, 1, self.ratio(expected))
        return Sums(
            sums.dVCM * self.ratio(squared_distance * inverse),
            sums.dVC * self.ratio(inverse),
            () if isinstance(sums.by_camera, tuple) else sums.by_camera * inverse,
            region,
            count,
        )

    def leave(
        self,
        sums: Sums,
        cosine: mi.Float,
        pdf: mi.Float,
        reverse_pdf: mi.Float,
        is_delta: mi.Bool,
        is_first: mi.Bool | bool = False,
    ) -> Sums:
        """A direction was sampled.

        Parameters:
            cosine: Between it and the geometric normal, not negative.
            pdf, reverse_pdf: Its density, and that of the opposite way through the vertex, per
                solid angle.
            is_delta: Did a discrete distribution choose it? Then no other technique connects here.
            is_first: Is this the first vertex after the light?
        """
        leaves = cosine * dr.select(pdf > 0, dr.rcp(pdf), 0)
        smooth = self.others(leaves, sums, reverse_pdf)
        # The technique that connects behind a vertex has other vertices on both sides
        dVCM = self.count * self.ratio(dr.select(pdf > 0, dr.rcp(pdf), 0))
        return Sums(
            dr.select(is_delta, 0, dVCM),
            dr.select(is_delta, sums.dVC * self.ratio(cosine), smooth),
            self._leave_by_camera(sums, cosine, leaves, reverse_pdf, is_delta, is_first),
            sums.region,
            sums.count,
        )

    def by_camera(
        self, density: mi.Float, sums: Sums, reverse_pdf: mi.Float, is_first: mi.Bool | bool
    ) -> mi.Vector2f | tuple[()]:
        """The ratios of the densities with which a camera path finds everything by itself (s = 0
        and 1) to that of connecting to a light path's last vertex, as :meth:`others`, but not
        raised to the exponent; ``()`` where they are not followed."""
        if isinstance(sums.by_camera, tuple):
            return ()
        first = mi.Vector2f(reverse_pdf * self.root(sums.dVC), self.root(sums.dVCM))
        return density * dr.select(is_first, first, reverse_pdf * sums.by_camera)

    def _leave_by_camera(self, sums, cosine, leaves, reverse_pdf, is_delta, is_first):
        smooth = self.by_camera(leaves, sums, reverse_pdf, is_first)
        if isinstance(smooth, tuple):
            return ()
        hit = mi.Vector2f(self.root(sums.dVC), 0)
        return dr.select(
            is_delta, dr.select(is_first, hit, sums.by_camera) * cosine, smooth
        )


def weight(others: mi.Float) -> mi.Float:
    """The weight of a technique, from the sum of the others' ratios to it."""
    return dr.select(dr.isfinite(others), dr.rcp(1 + others), 0)


def _cosine(si: mi.SurfaceInteraction3f) -> mi.Float:
    """Between the direction of arrival and the geometric normal."""
    return dr.abs(dr.dot(si.n, si.to_world(si.wi)))


def _has_delta(scene: mi.Scene) -> bool:
    delta = int(mi.EmitterFlags.DeltaPosition) | int(mi.EmitterFlags.DeltaDirection)
    return any(int(e.flags()) & delta for e in scene.emitters())
