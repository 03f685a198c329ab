"""How paths find lights: vertices are connected to points on lights, or scattered rays hit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .heroes import Heroes
from .no_media import NoMedia
from .observer import Observer
from .path_channels import PathChannels
from .path_decisions import (
    AlwaysTest,
    ConnectionCount,
    EmitterSampling,
    LightNumbers,
    Scattering,
    SceneQuery,
    ShadowTest,
    Weights,
)
from .path_program import PathProgram
from .replay import FirstPass
from .transmittance import for_weights
from .vertex import PathState, Vertex

#: The golden ratio: its multiples, modulo one, are evenly spread.
_GOLDEN = 0.6180339887


@dataclass
class Connection:
    """A point on a light, seen from a vertex.

    Attributes:
        ds: The direction towards it.
        weight: Its radiance / density.
        choice: What the next event decision returned about its choice.
    """

    ds: mi.DirectionSample3f
    weight: mi.Spectrum
    choice: Any


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class Connector:
    """Connects vertices to lights: chooses points, traces shadow rays, and applies MIS weights.

    The parameters are the program of the walk, and the decisions that concern connections.
    """

    def __init__(
        self,
        scene: mi.Scene,
        next_event: EmitterSampling,
        connections: ConnectionCount,
        shadow_test: ShadowTest,
        scattering: Scattering,
        query: SceneQuery,
        heroes: Heroes,
        weights: Weights,
        program: PathProgram,
        observer: Observer,
        media: NoMedia,
        replay: FirstPass | None = None,
        channels: PathChannels | None = None,
    ) -> None:
        self._media, self._replay, self._channels = media, replay, channels
        self._scene, self._query, self._heroes = scene, query, heroes
        self._weights, self._program = weights, program
        self._next_event, self._connections = next_event, connections
        self._shadow_test, self._scattering, self._observer = shadow_test, scattering, observer
        #: Whether any vertex has one connection, and whether any has more than one.
        self.single = connections.first <= 1 or connections.later <= 1
        self.many = connections.first > 1 or connections.later > 1

    def one(
        self, place: Any, sampler: mi.Sampler, vertex: Vertex, active: mi.Bool
    ) -> Connection:
        """The connection of vertices that have only one. Its density is 0 where there is none."""
        dimension = self._next_event.choice_dimension
        choice = None
        if dimension > 0:
            choice = sampler.next_1d() if dimension == 1 else sampler.next_2d()
        # `volpath` draws no numbers where there is no connection
        point = sampler.next_2d(active) if self._media.exist else sampler.next_2d()
        connection = self._choose(place, LightNumbers(point, choice), vertex, active)
        if self._connections.first != 1 or self._connections.later != 1:
            count = self._connections.weight(vertex.depth)
            # Vertices without connections still connect to lights that no BSDF sample can hit
            is_made = (count == 1) | ((count == 0) & connection.ds.delta)
            connection.ds.pdf = dr.select(is_made, connection.ds.pdf, 0)
            connection.weight = dr.select(is_made, connection.weight, 0)
        return connection

    def _choose(self, place, numbers: LightNumbers, vertex: Vertex, active) -> Connection:
        return Connection(
            *self._next_event.sample(place, self._scene, numbers, vertex.si, active)
        )

    def unoccluded(
        self,
        state: Any,
        survival_sample: mi.Float | None,
        vertex: Vertex,
        β: mi.Spectrum,
        connection: Connection,
        bsdf_value: mi.Spectrum,
        pdf: mi.Float,
        count: mi.Float | float,
        active: mi.Bool,
        inside: Any = None,
        sampler: mi.Sampler | None = None,
    ) -> tuple[mi.Spectrum, mi.Bool, mi.Bool, mi.Bool, Any]:
        """The light that a connection adds to a path.

        Parameters:
            state: The state of the shadow test.
            survival_sample: See :meth:`survival_sample`.
            β: Multiplies the result.
            bsdf_value, pdf: The BSDF's value towards the light (cosine included), and the density
                with which scattering finds this direction.
            count: Number of the vertex's connections.
            inside, sampler: For scenes with media: the path's state in them, and random numbers.

        Returns:
            The light that arrives if unoccluded, with its MIS weight; three masks: the connection
            was considered, a shadow ray was traced, it was unoccluded; the new state.
        """
        si, ds, local_value = vertex.si, connection.ds, bsdf_value
        bsdf_value = si.to_world_mueller(bsdf_value, -si.to_local(ds.d), si.wi)
        mis: mi.Float | float = 1.0
        if not self._program.weighs_transmittance:
            mis = self._mis(vertex, ds, count * ds.pdf, pdf)
        contribution = bsdf_value * connection.weight
        value = β * contribution * mis
        considered = active & (ds.pdf != 0)
        # A connection that cannot contribute needs no shadow ray
        tested = considered & (dr.max(dr.abs(value)) > 0)
        worth = self._program.worth(vertex, ds)
        value, contribution = value * worth, contribution * worth
        if self._replay is not None:
            tested = considered  # its derivative need not be zero
        weight, tested, state = self._roulette(state, connection, survival_sample, si, tested)
        value *= weight
        if self._media.exist:
            finds_way = self._replay is not None and self._replay.flights
            T, known, way = self._media.transmittance(
                self._query, self._scene, vertex, ds, inside, finds_way, sampler, tested
            )
            if self._program.weighs_transmittance:
                # What finds the light otherwise flies all the way, with this probability
                value *= self._mis(vertex, ds, count * ds.pdf / for_weights(known), pdf)
            value, contribution = value * T, contribution * T
            visible = tested & (dr.max(T) > 0)
        else:
            T, way = 1.0, None
            visible = tested & ~self._query.occluded(self._scene, si, ds, tested)
        if self._replay is not None:
            self._replay.connected(vertex, ds, β * (mis * weight) * T, visible, way)
        if self._channels is not None:
            self._channels.connected(vertex, ds, local_value, value, visible)
        self._observer.connection(
            connection.choice, vertex, ds, contribution, value, pdf, visible, tested
        )
        return value, considered, tested, visible, state

    def _mis(self, vertex: Vertex, ds, pdf, scattering_pdf) -> mi.Float:
        """The MIS weight of a connection to a light."""
        return self._program.connection(
            self._weights, self._scene, vertex, ds, pdf, scattering_pdf
        )

    def survival_sample(self, sampler: mi.Sampler) -> mi.Float | None:
        """The number that decides whether a connection is tested; ``None`` if all are."""
        return None if isinstance(self._shadow_test, AlwaysTest) else sampler.next_1d()

    def _roulette(self, state, connection, survival_sample, si, active):
        """Lets the shadow test drop connections; the surviving ones have the weight 1/p. Returns
        the weight, which connections survive, and the state of the shadow test."""
        p, state = self._shadow_test.probability(
            state, connection.choice, si, connection.ds, active
        )
        if p is None:
            return mi.Float(1), active, state
        survives = survival_sample < p
        # p > 0 wherever a lane survives: the random number is not negative
        return dr.select(survives, dr.rcp(p), 0), active & survives, state

    def gather_one(
        self,
        shadow_state: Any,
        scattering_state: Any,
        place: Any,
        ctx: mi.BSDFContext,
        sampler: mi.Sampler,
        vertex: Vertex,
        active: mi.Bool,
        inside: Any,
    ) -> tuple[mi.Spectrum, mi.UInt32, mi.UInt32, Any]:
        """Like :meth:`gather`, for vertices that have one connection, in a scene with media."""
        connection = self.one(place, sampler, vertex, active)
        bsdf_value, pdf = self._value(
            scattering_state, ctx, vertex, connection.ds, active
        )
        value, considered, tested, visible, shadow_state = self.unoccluded(
            shadow_state, self.survival_sample(sampler), vertex, vertex.path.β, connection,
            bsdf_value, pdf, 1.0, active, inside, sampler,
        )  # fmt: skip
        counts = (dr.select(which, mi.UInt32(1), 0) for which in (considered, tested))
        return dr.select(visible, value, 0), *counts, shadow_state

    def _value(self, scattering_state, ctx, vertex: Vertex, ds, active):
        """The value of the BSDF (or phase function) towards a light, cosine included, and the
        density with which scattering finds this direction."""
        wo = vertex.si.to_local(ds.d)
        value, pdf = self._scattering.eval_pdf(scattering_state, ctx, vertex, wo, active)
        value = self._heroes.connect(
            vertex.path.hero_is_alone, value, vertex.bsdf, vertex.si, wo
        )
        if self._media.exist:
            value, pdf = self._media.eval(vertex, ds.d, value, pdf, active)
        return value, pdf

    @dr.syntax
    def gather(
        self,
        shadow_state: Any,
        scattering_state: Any,
        place: Any,
        ctx: mi.BSDFContext,
        sampler: mi.Sampler,
        vertex: Vertex,
        active: mi.Bool,
        inside: Any,
    ) -> tuple[mi.Spectrum, mi.UInt32, mi.UInt32, Any]:
        """Connects vertices that have more than one connection.

        Returns:
            The light that the connections add to the path, throughput included; the number of
            connections that were considered, and of shadow rays; the new state of the shadow test.
        """
        dimension = self._next_event.choice_dimension
        chosen = self._connections.begin(sampler, dimension)
        # One number for all connections: each vertex draws the same number of random numbers
        survival_sample = self.survival_sample(sampler)
        total, index = mi.Spectrum(0), mi.UInt32(0)
        connection_count, shadow_count = mi.UInt32(0), mi.UInt32(0)
        count = self._connections.weight(vertex.depth)
        active = active & (count > 1)
        # Where there is no connection, nothing is added
        share = vertex.path.β / dr.maximum(count, 1)
        # Without media, the loop draws no numbers
        drawn = sampler if self._media.exist else None
        while active:
            numbers, weight = self._connections.numbers(
                chosen, index, dimension, active
            )
            connection = self._choose(place, numbers, vertex, active)
            bsdf_value, pdf = self._value(scattering_state, ctx, vertex, connection.ds, active)
            value, considered, tested, visible, shadow_state = self.unoccluded(
                shadow_state, _turned(survival_sample, index), vertex, share * weight,
                connection, bsdf_value, pdf, count, active, inside, drawn,
            )  # fmt: skip
            total[visible] += value
            connection_count += dr.select(considered, 1, 0)
            shadow_count += dr.select(tested, 1, 0)
            index += 1
            active &= mi.Float(index) < count
        return total, connection_count, shadow_count, shadow_state


def _turned(sample: mi.Float | None, index: mi.UInt32) -> mi.Float | None:
    """The random number of connection ``index``: uniform if ``sample`` is, and evenly spread over
    the indices."""
    if sample is None:
        return None
    turned = dr.fma(mi.Float(index), _GOLDEN, sample)
    return turned - dr.floor(turned)


def emission(
    scene: mi.Scene,
    query: SceneQuery,
    si: mi.SurfaceInteraction3f,
    path: PathState,
    next_event: EmitterSampling,
    state: Any,
    weights: Weights,
    program: PathProgram,
    count: mi.Float | float = 1.0,
) -> tuple[mi.Spectrum, mi.Float, mi.DirectionSample3f, mi.Float]:
    """The radiance that ``si`` (or the environment, if nothing was hit) emits towards the previous
    vertex, times the MIS weight of scattering; this weight; the direction from the previous vertex,
    and the density with which connections find it (0 where they cannot).

    Parameters:
        query: The decision that found ``si``.
        next_event, state: The decision whose connections could have found the light as well, and
            its state when the path left the previous vertex.
        weights, program: What weighs scattering against connections and other techniques.
        count: Number of connections of the previous vertex.
    """
    arrival = path.arrival
    ds = mi.DirectionSample3f(scene, si, arrival.ref)
    ds.emitter = query.emitter(si, ds.emitter)
    is_connectable = ~arrival.is_delta & (ds.emitter != None)  # noqa: E711
    pdf = next_event.density(state, scene, arrival.ref, si, ds, is_connectable)
    weight = program.emission(weights, scene, si, ds, path, count * pdf)
    return ds.emitter.eval(si, arrival.pdf > 0) * weight, weight, ds, pdf


def can_be_hit(scene: mi.Scene) -> bool:
    """Whether there is a light that a scattered ray can hit."""
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    return any(not (int(e.flags()) & int(delta)) for e in scene.emitters())
