"""The traced random walk that all unidirectional integrators share.

The walk is Mitsuba's ``path``: next event estimation, multiple importance sampling with the power
heuristic, Russian roulette. With the default decisions it draws the same random numbers in the
same order, so a render of one pass returns the same image. It differs where ``path`` loses light:
on masks with nothing behind them, and between surfaces that are very close (``scene_query.py``). In
scenes with participating media, it is ``volpath`` (``media.py``). A technique replaces one decision
(``path_decisions.py``). Dr.Jit inlines Python while it traces, so a replaced decision costs only
its own work, and a default one costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from ..startup.garbage import garbage_left_alone
from ..util.arrays import channel_mean
from .chromatic_media import media_of
from .connection import Connection, Connector, can_be_hit, emission
from .estimator import CameraRays, Sample
from .free_flight import Distances
from .heroes import Heroes
from .no_media import NoMedia
from .observer import Observer
from .path_channels import PathChannels
from .path_decisions import (
    AlwaysTest,
    ConnectionCount,
    DirectionSamples,
    EmitterSampling,
    Roulette,
    Scattering,
    SceneQuery,
    ShadowTest,
    Weights,
)
from .path_program import PathProgram
from .replay import FirstPass
from .vertex import Arrival, FlightEnd, PathState, Vertex


@dataclass
class Walk:
    """A path tracer whose decisions can be replaced. It is an :class:`Estimator`.

    Parameters:
        max_depth: Longest path in segments; 1 shows emitters only, 2**32 − 1 stands for no limit.
        rr_depth: Depth at which Russian roulette begins.
        hide_emitters: Whether camera rays pass through area lights, and do not see the environment.
        directions: Draws the primary samples that choose the lobe and the direction of a BSDF
            sample.
        scattering: Chooses the direction in which a path continues.
        next_event: Chooses a light and the point on it to connect to.
        connections: The number of points to which a vertex is connected, and the random numbers
            that choose them.
        shadow_test: Decides whether the shadow ray of a connection is traced.
        roulette: The probability with which a path continues.
        query: How rays intersect the scene.
        distance: Draws the random numbers that choose how far a path flies in a medium.
        mis: The MIS weights of connections and of scattering.
        program: Follows the paths for the estimator that uses them. It keeps their history, from
            which it computes MIS weights, where paths end, and the light of other subpaths.
        observer: Receives the events of the walk.
        replay: Propagates derivatives along the paths, or prepares to; ``None`` for images.
        clamp_direct, clamp_indirect: The largest mean over the channels of the light that a path
            of one or two segments, or all longer ones together, may add to a sample: brighter
            light is scaled to it. 0 for any. (Observers learn of light as it was before.)
        channels: Adds the light to the channels of light path expressions; ``None`` if there are
            none.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool = False
    directions: DirectionSamples = field(default_factory=DirectionSamples)
    scattering: Scattering = field(default_factory=Scattering)
    next_event: EmitterSampling = field(default_factory=EmitterSampling)
    connections: ConnectionCount = field(default_factory=ConnectionCount)
    shadow_test: ShadowTest = field(default_factory=AlwaysTest)
    roulette: Roulette = field(default_factory=Roulette)
    query: SceneQuery = field(default_factory=SceneQuery)
    distance: Distances = field(default_factory=Distances)
    mis: Weights = field(default_factory=Weights)
    program: PathProgram = field(default_factory=PathProgram)
    observer: Observer = field(default_factory=Observer)
    replay: FirstPass | None = None
    clamp_direct: float = 0.0
    clamp_indirect: float = 0.0
    channels: PathChannels | None = None

    #: See :class:`~mitsuba_ext.transport.estimator.Estimator`.
    can_be_frozen = True

    def __call__(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        """Traces one path for each of the rays."""
        sample, direct = self.unclamped(scene, sampler, rays, active)
        return self.clamped(sample, direct)

    def unclamped(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> tuple[Sample, mi.Spectrum | None]:
        """The samples, not clamped, and the direct light in each of them (``None`` where nothing
        :attr:`clamps`)."""
        with garbage_left_alone():
            return self._trace(scene, sampler, rays, active)

    def clamped(self, sample: Sample, direct: mi.Spectrum | None) -> Sample:
        """``sample``, clamped. ``direct`` is its direct light."""
        if direct is None:
            return sample
        indirect = _at_most(sample.L - direct, self.clamp_indirect)
        return replace(sample, L=_at_most(direct, self.clamp_direct) + indirect)

    @dr.syntax
    def _trace(self, scene, sampler, rays, active) -> tuple[Sample, mi.Spectrum | None]:
        # What the scene lacks is left out of the kernel: these are Python booleans
        has_emitters = len(scene.emitters()) > 0
        connects = has_emitters and self.max_depth > 1
        can_hit_emitters = has_emitters and can_be_hit(scene)
        sees_environment = scene.environment() is not None and not self.hide_emitters

        media = media_of(
            scene, self.hide_emitters, self.distance, self.query.has_chromatic_media,
            self.program.connects_all,
        )  # fmt: skip
        heroes = Heroes(scene, rays.hero_weight)
        ctx = heroes.context()
        connector = Connector(
            scene, self.next_event, self.connections, self.shadow_test, self.scattering,
            self.query, heroes, self.mis, self.program, self.observer, media, self.replay,
            self.channels,
        )  # fmt: skip
        makes_one, makes_many = connects and connector.single, connects and connector.many
        # In media, transmittance uses random numbers; `volpath` draws them before the BSDF's
        makes_early, makes_one = makes_one and media.exist, makes_one and not media.exist
        has_subpaths = self.program.subpaths is not None
        replays_media = self.replay is not None and self.replay.flights and media.exist

        # --------------------- Configure the loop state ----------------------
        pixel = rays.pixel
        ray = mi.Ray3f(rays.ray)
        L = mi.Spectrum(0)                              # Radiance accumulator
        direct = mi.Spectrum(0) if self.clamps else None  # The part of it that is direct light
        path = PathState(                               # Throughput, and how the path got here
            β=mi.Spectrum(1),
            η=mi.Float(1),
            sampling_weight=mi.Float(1),
            depth=mi.UInt32(0),
            arrival=Arrival(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)),
            hero_is_alone=heroes.begin(),
            history=self.program.begin(ray),
            events=self.channels and self.channels.begin(),
            sums=self.channels and self.channels.sums(),
        )
        valid = mi.Bool(sees_environment and self.max_depth > 0)  # Whether it has met anything
        scatter_count, shadow_count, connection_count = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
        active = mi.Bool(active) & (self.max_depth > 0)
        directions_state = self.directions.begin(sampler, ray, pixel)
        scattering_state = self.scattering.begin(sampler, ray)
        next_event_state = self.next_event.begin(sampler, ray, pixel)
        shadow_state = self.shadow_test.begin(sampler, ray)
        roulette_state = self.roulette.begin(sampler, ray, pixel)
        detour = self.replay.begin() if replays_media else None
        self.observer.camera(rays)

        inside = media.begin(sampler, rays)
        ray, inside = media.launch(inside, path.β, sampler, rays, ray, active)
        pi = self._first(scene, rays, ray, media, active)
        if dr.hint(self.hide_emitters, mode="scalar"):
            ray, pi = media.behind(self.query, scene, ray, pi, active)

        while dr.hint(active, label="walk"):
            si = self.query.interaction(pi, ray)
            if dr.hint(media.exist and has_subpaths, mode="scalar"):
                L += self.program.subpaths.along(sampler, ray, si, inside, path, active)
            if dr.hint(replays_media, mode="scalar"):
                start = FlightEnd(si, path.β, None)
            si, path.β, in_medium = media.fly(inside, sampler, ray, si, path.β, active)
            path.sampling_weight = media.sampling_weight(path, in_medium)
            path.history = self.program.arrive(path, si, in_medium)

            if dr.hint(replays_media, mode="scalar"):
                end, detour, active = self.replay.flown(
                    sampler, ray, inside, start, FlightEnd(si, path.β, in_medium), detour, L,
                    active, partial(self._closest, scene, media, path.depth),
                )  # fmt: skip
                si, path.β, in_medium = end.si, end.β, end.in_medium

            # ----- How much does this vertex emit towards the previous one? -----
            if dr.hint(can_hit_emitters, mode="scalar"):
                count = self.connections.weight(path.depth - 1)
                emitted, mis, hit, light_pdf = emission(
                    scene, self.query, si, path, self.next_event, next_event_state, self.mis,
                    self.program, count,
                )
                emitted = media.visible_emission(emitted, path, si, valid)
                L = dr.fma(path.β, emitted, L)
                if dr.hint(self.clamps, mode="scalar"):
                    direct += dr.select(path.depth <= 1, path.β * emitted, 0)
                self.observer.emission(
                    path, hit, path.β * emitted, mis, light_pdf, active
                )
                if dr.hint(self.channels is not None, mode="scalar"):
                    self.channels.emitted(path, hit.emitter, path.β * emitted, active)
                if dr.hint(self.replay is not None, mode="scalar"):
                    seen = active & (path.arrival.pdf > 0)
                    if dr.hint(self.hide_emitters, mode="scalar"):
                        seen &= media.sees_light(path, si, valid)
                    self.replay.emitted(si, path, mis, hit.emitter, seen)

            # ----- Should we continue tracing to reach one more vertex? -----
            vertex = Vertex(
                si, si.bsdf(ray), path, pixel, in_medium, self.channels and self.channels.lobes()
            )
            active_next, active_em = media.goes_on(vertex, self.max_depth, active)

            # ----- Which points of which lights do we connect to? -----
            self.observer.vertex(vertex, active_em)
            place = self._visit(connects, next_event_state, scene, si, active_em)
            if dr.hint(makes_many, mode="scalar"):
                gathered, connections, shadow_rays, shadow_state = connector.gather(
                    shadow_state, scattering_state, place, ctx, sampler, vertex, active_em, inside
                )
                L += gathered
                connection_count += connections
                shadow_count += shadow_rays
            if dr.hint(makes_early, mode="scalar"):
                gathered, connections, shadow_rays, shadow_state = connector.gather_one(
                    shadow_state, scattering_state, place, ctx, sampler, vertex, active_em, inside
                )
                L += gathered
                connection_count += connections
                shadow_count += shadow_rays
            connection = self._connect(
                connector, makes_one, makes_early, place, sampler, vertex, active_em
            )
            wo = si.to_local(connection.ds.d)
            if dr.hint(has_subpaths, mode="scalar"):
                gathered, shadow_rays = self.program.subpaths.gather(
                    scene, sampler, vertex, active_em
                )
                L += gathered
                shadow_count += shadow_rays

            # ----- Evaluate the BSDF towards the light and choose where to scatter -----
            turns = media.turns(vertex, active_next)
            sample_1, sample_2, directions_weight, directions_state = self.directions.draw(
                directions_state, sampler, vertex, turns
            )
            bsdf_value, light_pdf, bs, sample_weight, scattering_state = self.scattering.sample(
                scattering_state, ctx, vertex, wo, sample_1, sample_2
            )
            bsdf_value = heroes.connect(path.hero_is_alone, bsdf_value, vertex.bsdf, si, wo)
            bsdf_weight, hero_count, hero_is_alone = heroes.scatter(
                path.hero_is_alone, sample_weight, vertex.bsdf, si, bs
            )

            # ----- Does the light reach this vertex? -----
            if dr.hint(makes_one, mode="scalar"):
                unoccluded, considered, tested, visible, shadow_state = connector.unoccluded(
                    shadow_state, connector.survival_sample(sampler), vertex, path.β, connection,
                    bsdf_value, light_pdf, 1.0, active_em,
                )  # fmt: skip
                L[visible] += unoccluded
                connection_count += dr.select(considered, 1, 0)
                shadow_count += dr.select(tested, 1, 0)
            bs, bsdf_weight = media.scatter(
                vertex, sample_1, sample_2, bs, bsdf_weight, self.directions.gives_directions
            )
            self.observer.direction(vertex, sample_2, directions_weight, L, turns)
            self.observer.scattering(vertex, bs, active)
            if dr.hint(self.replay is not None, mode="scalar"):
                self.replay.scattered(vertex, bs, sample_1, sample_2, L, turns)

            if dr.hint(self.clamps, mode="scalar"):
                direct = dr.select(path.depth == 0, L, direct)

            # ----- Move on to the next vertex -----
            bsdf_weight = si.to_world_mueller(bsdf_weight, -bs.wo, si.wi)
            ray = self.query.starts.along(si, si.to_world(bs.wo))
            valid |= si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            β, history = path.β * (bsdf_weight * directions_weight), self.program.leave(vertex, bs)
            known, history = self.program.known(vertex, bs, β, history, active_next)
            if dr.hint(known is not None, mode="scalar"):
                L += known
            onward = PathState(
                β=β,
                η=path.η * bs.eta,
                sampling_weight=path.sampling_weight
                * (directions_weight * hero_count * vertex.sampling_weight),
                depth=path.depth + dr.select(si.is_valid(), mi.UInt32(1), 0),
                arrival=Arrival(mi.Interaction3f(si), bs.pdf, is_delta),
                hero_is_alone=hero_is_alone,
                history=history,
                events=self.channels
                and self.channels.left(vertex, bs, sample_weight, active_next),
                sums=path.sums,
            )
            path = media.leave(vertex, bs, onward)
            active_next = media.is_within(path.depth, self.max_depth, active_next)
            remembered = self._leave(connects, place, scene, ray.d, bs.pdf, active_em)
            next_event_state = media.kept(bs, next_event_state, remembered)
            inside = media.cross(inside, si, ray.d)

            # ----- Russian roulette -----
            late = path.depth >= self.rr_depth
            rr_active = late | self.program.ends_early
            carries = dr.max(path.β) != 0  # False for NaN
            survival, roulette_state = self.program.survival(
                self.roulette, roulette_state, vertex, path, late, active_next & rr_active & carries
            )
            rr_continue = sampler.next_1d() < survival
            self.observer.survival(
                path, dr.select(rr_active, survival, 1), media.scattered(bs, active_next)
            )
            active = active_next & (~rr_active | rr_continue) & carries
            path.β[rr_active] *= dr.rcp(survival)

            ray, inside = media.launch(inside, path.β, sampler, rays, ray, active)
            pi = self._closest(scene, media, path.depth, ray, active)
            scatter_count += dr.select(active, 1, 0)
            self.observer.segment(path.arrival.ref.p, ray(pi.t), active & pi.is_valid())

        self.observer.end(L)
        if replays_media:
            self.replay.end(detour, L)
        sample = Sample(L, valid, scatter_count, shadow_count, connection_count)
        if self.channels is not None:
            sample.aovs = self.channels.values(path.sums, rays)
        return sample, direct

    @property
    def clamps(self) -> bool:
        """Whether light is clamped, so that the image is biased."""
        return self.clamp_direct > 0 or self.clamp_indirect > 0

    def _first(self, scene, rays: CameraRays, ray, media: NoMedia, active):
        """The first surface that each path meets."""
        # Rays in media may be shorter than the camera rays
        if rays.first is None or media.exist:
            return self.query.closest(scene, ray, coherent=media.coherent, active=active)
        return dr.copy(rays.first)  # the loop of the walk changes it

    def _closest(self, scene, media: NoMedia, depth, ray, active):
        """The first surface that each path meets, ``depth`` vertices after the camera."""
        pi = self.query.closest(scene, ray, coherent=False, active=active)
        if media.exist and self.hide_emitters:
            _, pi = media.behind(self.query, scene, ray, pi, active & (depth == 0))
        return pi

    def _visit(self, connects: bool, state, scene, si, active):
        """What the next event decision knows about a vertex."""
        return self.next_event.visit(state, scene, si, active) if connects else state

    def _leave(self, connects: bool, place, scene, d, pdf, active):
        """The state of the next event decision when it leaves a vertex."""
        return self.next_event.remember(place, scene, d, pdf, active) if connects else place

    def _connect(
        self, connector, connects: bool, is_made: bool, place, sampler, vertex, active
    ) -> Connection:
        """The one connection of a vertex. It is empty if the vertex has none, or if its connection
        ``is_made`` already."""
        if connects:
            return connector.one(place, sampler, vertex, active)
        if not is_made:
            sampler.next_2d()  # Keeps the later numbers the same as in `path`
        return Connection(dr.zeros(mi.DirectionSample3f), mi.Spectrum(0), None)


def _at_most(L: mi.Spectrum, limit: float) -> mi.Spectrum:
    """``L``, darkened so that the mean of its channels is not above the ``limit``; 0 for none."""
    if limit == 0:
        return L
    limit = dr.opaque(mi.Float, limit)
    mean = channel_mean(L)
    return dr.select(mean > limit, L * (limit / dr.maximum(mean, limit)), L)
