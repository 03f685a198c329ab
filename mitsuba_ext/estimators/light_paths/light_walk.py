"""The traced random walk of light paths, which stores its vertices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...rendering.device import device_of
from ...startup.garbage import garbage_left_alone
from ...transport.chromatic_media import media_of
from ...transport.estimator import CameraRays
from ...transport.free_flight import Distances
from ...transport.frozen import frozen
from ...transport.heroes import Heroes
from ...transport.no_media import NoMedia
from ...transport.numbers import Numbers, copied, go_to, reached, schedule_state
from ...transport.path_channels import PathChannels
from ...transport.path_decisions import Roulette, SceneQuery
from ...transport.vertex import Arrival, PathState, Vertex
from .emission import EmittedRay, LightEmission
from .light_directions import LightDirections
from .light_media import medium_at_start
from .light_program import LightProgram
from .light_vertices import Layout, VertexCache, VertexStore, bytes_per_vertex
from .scattering import delta_correction, evaluate

#: Largest number of vertices of a path that are stored in a round; most paths have fewer. A round
#: stores fewer if the vertices of all paths would take more than half of the memory of a pass.
STRIDE = 8

#: Largest number of bounces: a path that is still alive is stuck where nothing absorbs light.
_MOST_BOUNCES = 1 << 14


@dataclass
class LightPaths:
    """The state of the light paths, one in each lane, at a vertex that is not stored yet.

    Attributes:
        ray, pi: The ray that led to the vertex, and its intersection.
        emitted: Radiance / density of the emitted ray.
        β: Throughput up to the vertex, without emission.
        sampling_weight: See :class:`~mitsuba_ext.transport.vertex.PathState`.
        history: What the :class:`LightProgram` knows about the path so far: at the first vertex,
            the history at the vertex itself; later, the history behind the previous vertex.
        depth: Segments between the light and the vertex.
        hero_is_alone: Whether only the first wavelength is left; ``None`` where nothing disperses
            light.
        scatter_count: Rays traced in directions that were sampled from a BSDF.
        inside: The state between two vertices (``transport/media.py``); ``None`` without media.
        active: Paths that have not ended.
        events: The state of light path expressions; ``None`` without any.
        start: The rays with which the paths began, if ``LightWalk.program`` needs them in scenes
            with media.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    emitted: mi.Spectrum
    β: mi.Spectrum
    sampling_weight: mi.Float
    history: Any
    depth: mi.UInt32
    hero_is_alone: mi.Bool | None
    scatter_count: mi.UInt32
    inside: Any
    active: mi.Bool
    events: list[mi.UInt32] | None = None
    start: EmittedRay | None = None


@dataclass
class LightWalk:
    """Traces light paths: the mirror image of :class:`~mitsuba_ext.transport.walk.Walk`.

    It works in rounds, each of which stores a limited number of vertices of each path. If one round
    is enough, one kernel emits the paths and walks. If not, all rounds share a kernel.

    A path draws 6 random numbers for the emitted ray and 4 for each bounce; it draws more in scenes
    with media.

    Parameters:
        emission: Samples the rays with which paths begin.
        max_depth: Longest path from light to sensor, in segments. Vertices up to the depth
            ``max_depth`` − 1 are stored, since one more segment leads to the sensor.
        rr_depth: Depth at which Russian roulette begins.
        program: Follows the paths for the estimator that uses their vertices.
        roulette: The Russian roulette. It is given the throughput without the light's power, since
            dim lights are already chosen rarely.
        query: Intersects rays with the scene.
        stored_lobes: Flags of BSDFs. Vertices are stored where the BSDF has one of them, or, if
            this is ``None``, a smooth lobe. ``program`` treats other vertices as specular.
        outside: In scenes with media, the medium outside of all boundaries (:func:`outer_medium`);
            ``None`` if paths should pass through media as if through a vacuum.
        connects: Whether stored vertices are connected: the throughput at a vertex in a medium then
            contains the coefficient of scattering, which photons do not have.
        channels: Reads the events of the paths for light path expressions; ``None`` without any.
    """

    emission: LightEmission
    max_depth: int
    rr_depth: int
    program: LightProgram = field(default_factory=LightProgram)
    roulette: Roulette = field(default_factory=Roulette)
    query: SceneQuery = field(default_factory=SceneQuery)
    stored_lobes: int | None = None
    outside: mi.MediumPtr | None = None
    connects: bool = False
    channels: PathChannels | None = None

    @property
    def layout(self) -> Layout:
        """The layout of the stored vertices."""
        is_whole = self.emission.needs_whole_interaction
        events = 0 if self.channels is None else self.channels.colours
        has_medium = self.outside is not None and self.connects
        return Layout(dr.size_v(mi.Spectrum), self.program.stored, is_whole, events, has_medium)

    def run(
        self,
        scene: mi.Scene,
        numbers: Numbers,
        time: mi.Float,
        wavelengths: mi.Spectrum,
        active: mi.Bool,
    ) -> tuple[VertexCache | None, mi.UInt32]:
        """Like :meth:`run_in_rounds`, but the vertices of all rounds are joined.

        Returns:
            The vertices, ``None`` if there are none; and for each path, the rays traced in
            directions that were sampled from a BSDF.
        """
        rounds: list[VertexCache] = []
        scatter_count = self.run_in_rounds(scene, numbers, time, wavelengths, active, rounds.append)
        return VertexCache.joined(rounds) if rounds else None, scatter_count

    def run_in_rounds(
        self,
        scene: mi.Scene,
        numbers: Numbers,
        time: mi.Float,
        wavelengths: mi.Spectrum,
        active: mi.Bool,
        take: Callable[[VertexCache], None],
    ) -> mi.UInt32:
        """Traces light paths until all have ended. ``take`` is called with the vertices of each
        round that has any: at most ``STRIDE`` per path.

        Parameters:
            time, wavelengths: Time and wavelengths of each path, the same as for the camera path in
                its lane.
            active: Lanes that emit. It has the width of the paths.

        Returns:
            For each path, the rays traced in directions that were sampled from a BSDF.
        """
        lanes = dr.width(active)
        room = device_of(mi.Float).pass_bytes // 2 // (lanes * bytes_per_vertex(self.layout))
        stride = min(STRIDE, max(1, room))
        schedule_state(numbers)
        # Each vertex is one segment deeper than the one before, except in media
        if self.max_depth <= stride + 1 and not self._media(scene).exist:
            store = VertexStore(self.layout, lanes, max(1, self.max_depth - 1))
            walked = self._whole(scene, numbers, time, wavelengths, active, store)
            self._take(scene, numbers, store, walked, time, wavelengths, take)
            return walked[0]
        paths, place = self._begin(scene, numbers, time, wavelengths, active)
        go_to(numbers, place)
        dr.eval(paths)
        goes_on = True
        while goes_on:
            schedule_state(numbers)
            # Fresh copies: kernels would otherwise differ in which of the inputs are the same array
            dr.make_opaque(paths)
            time, wavelengths = paths.ray.time, paths.ray.wavelengths
            store = VertexStore(self.layout, lanes, stride)
            walked = self._go_on(scene, numbers, paths, store)
            paths = walked[0]
            goes_on = self._take(scene, numbers, store, walked, time, wavelengths, take)
        return paths.scatter_count

    def _take(self, scene, numbers, store, walked, time, wavelengths, take) -> bool:
        """Evaluates what a round has ``walked``, and gives its vertices to ``take``. Returns
        whether paths go on."""
        state, number, place = walked
        go_to(numbers, place)
        # In the same kernel: evaluating the sampler's state later would trace the walk again
        schedule_state(numbers)
        dr.eval(state, number, store.words, store.totals)
        count, going_on = store.totals.numpy()
        if count > 0:
            disperses = Heroes(scene).begin() is not None
            take(VertexCache.packed(store, int(count), number, time, wavelengths, disperses))
        return going_on > 0

    @frozen
    def _whole(
        self, scene, numbers, time, wavelengths, active, store
    ) -> tuple[mi.UInt32, mi.UInt32, Any]:
        """Emits the paths, and walks until all have ended. Returns their numbers of rays."""
        with garbage_left_alone():
            numbers = copied(numbers)
            paths = self._emitted(scene, numbers, time, wavelengths, active)
            numbers, paths, number = self._trace(scene, numbers, paths, store)
        return paths.scatter_count, number, reached(numbers)

    @frozen
    def _begin(self, scene, numbers, time, wavelengths, active) -> tuple[LightPaths, Any]:
        with garbage_left_alone():
            numbers = copied(numbers)
            return self._emitted(scene, numbers, time, wavelengths, active), reached(numbers)

    @frozen
    def _go_on(self, scene, numbers, paths, store) -> tuple[LightPaths, mi.UInt32, Any]:
        with garbage_left_alone():
            numbers, paths, number = self._trace(scene, copied(numbers), paths, store)
        return paths, number, reached(numbers)

    def _emitted(self, scene, numbers, time, wavelengths, active) -> LightPaths:
        """Emits a ray in each lane, and traces it."""
        active = mi.Bool(active) & (self.max_depth > 1)
        emitted = self.emission.sample(numbers, time, wavelengths, active)
        active &= dr.max(emitted.weight) > 0
        ray, inside = self._launch(scene, numbers, emitted, active)
        pi = self.query.closest(scene, ray, coherent=False, active=active)
        active &= self._media(scene).meets(pi, inside)
        history = self.program.first(scene, self.query, emitted, pi, active)
        width = dr.width(emitted.ray)
        # The same width as in later rounds and in all renders: otherwise, kernels would differ
        ray.maxt, ray.time = (x + dr.zeros(mi.Float, width) for x in (ray.maxt, ray.time))
        paths = LightPaths(
            ray, pi, emitted.weight, dr.full(mi.Spectrum, 1, width),
            dr.full(mi.Float, 1, width), history, dr.full(mi.UInt32, 1, width),
            Heroes(scene).begin(), dr.zeros(mi.UInt32, width), inside, active,
        )  # fmt: skip
        if self.channels is not None:
            paths.events = self.channels.begin_light(emitted.emitter)
        if paths.hero_is_alone is not None:
            paths.hero_is_alone = dr.zeros(mi.Bool, width)
        if self.outside is not None and self.program.is_weighed:
            paths.start = emitted
        return paths

    @dr.syntax
    def _trace(self, scene, numbers, paths, store) -> tuple[Numbers, LightPaths, mi.UInt32]:
        """Returns the state of the paths, and the number of vertices that each has stored."""
        heroes, media, directions = Heroes(scene), self._media(scene), self._directions()
        ctx = heroes.context()
        ctx.mode = mi.TransportMode.Importance
        # The next place for a vertex of a path, and the place behind its last one
        place, end = store.places()
        last_depth = dr.opaque(mi.UInt32, self.max_depth - 1)
        rr_depth = dr.opaque(mi.UInt32, self.rr_depth)
        # A copy: the loop's mask is not the paths' mask
        active = mi.Bool(paths.active)
        # No part of the loop's state, since it does not change
        start, paths = paths.start, replace(paths, start=None)

        while dr.hint(active, label="light walk"):
            si = self.query.interaction(paths.pi, paths.ray)
            si, β, in_medium = media.fly(paths.inside, numbers, paths.ray, si, paths.β, active)
            bsdf = si.bsdf(paths.ray)
            vertex = Vertex(si, bsdf, paths, None, in_medium)
            history = self.program.arrive(paths.history, vertex, start)
            stores = self._stores(bsdf)

            # ----- Store the vertex if it can be connected -----
            is_stored = active & self._is_stored(media, vertex, stores)
            store.write(
                place, si, paths.emitted * self._carried(media, β, vertex), history, paths.depth,
                paths.hero_is_alone, is_stored, paths.events, paths.inside,
            )  # fmt: skip
            place += dr.select(is_stored, 1, 0)

            # ----- Sample the BSDF -----
            active_next = self._goes_on(media, vertex, last_depth, active)
            sample_1, sample_2 = numbers.next_1d(), numbers.next_2d()
            bs, weight = directions.sample(bsdf, ctx, si, sample_1, sample_2, active_next)
            weight, reverse_pdf, passes, hero_count, hero_is_alone = self._scatter(
                heroes, vertex, bs, weight, stores, active_next
            )
            bs, weight = media.scatter(vertex, sample_1, sample_2, bs, weight)
            history = self.program.leave(history, vertex, bs, reverse_pdf, passes)
            events = self.channels and self.channels.left_by_light(vertex, bs, active_next)
            β = β * weight
            sampling_weight = paths.sampling_weight * hero_count

            # ----- Russian roulette -----
            carries = dr.max(β) != 0  # False for NaN in Dr.Jit
            depth = media.depth_behind(bs, paths.depth)
            active_next = media.is_within(depth, self.max_depth, active_next)
            rr_active = depth >= rr_depth
            survival = self._survival(paths, si, bsdf, β, sampling_weight, depth, hero_is_alone,
                                      active_next & rr_active & carries)
            rr_continue = numbers.next_1d() < survival
            active_next &= (~rr_active | rr_continue) & carries
            β[rr_active] *= dr.rcp(survival)

            # ----- Move on to the next vertex -----
            ray = self.query.starts.along(si, si.to_world(bs.wo))
            inside = media.cross(paths.inside, si, ray.d)
            carried = paths.emitted * β
            ray, inside = media.launch(
                inside, carried, numbers, CameraRays(ray), ray, active_next
            )
            pi = self.query.closest(scene, ray, coherent=False, active=active_next)
            scatter_count = paths.scatter_count + dr.select(active_next, 1, 0)
            active_next &= media.meets(pi, inside) & (scatter_count < _MOST_BOUNCES)
            paths = LightPaths(
                ray, pi, paths.emitted, β, sampling_weight, history, depth, hero_is_alone,
                scatter_count, inside, active_next, events,
            )  # fmt: skip
            active = active_next & (place < end)
        paths = replace(paths, start=start)
        return numbers, paths, store.finish(place, paths.active)

    def _directions(self) -> LightDirections:
        """The object that samples directions."""
        # MIS weights of camera paths make up for light that the samples of BSDFs do not find
        return LightDirections(self.emission.not_reciprocal, mixes=not self.program.is_weighed)

    def _media(self, scene: mi.Scene) -> NoMedia:
        """The object that handles media."""
        if self.outside is None:
            return NoMedia()
        chromatic = self.query.has_chromatic_media
        return media_of(scene, False, Distances(), chromatic, connects_all=True)

    def _launch(self, scene, numbers, emitted: EmittedRay, active) -> tuple[mi.Ray3f, Any]:
        """An emitted ray, which ends where it scatters in a medium, and the state there."""
        media = self._media(scene)
        if not media.exist:
            return emitted.ray, None
        medium = medium_at_start(self.query, scene, emitted, self.outside, active)
        rays = CameraRays(emitted.ray, medium=medium)
        inside = media.begin(numbers, rays)
        # States of a loop have the width of its lanes
        inside.channel = inside.channel + dr.zeros(mi.UInt32, dr.width(medium))
        return media.launch(inside, emitted.weight, numbers, rays, emitted.ray, active)

    def _is_stored(self, media: NoMedia, vertex: Vertex, stores) -> mi.Bool:
        """Whether ``vertex`` is stored."""
        return stores | vertex.medium.scatters if media.exist else stores

    def _goes_on(self, media: NoMedia, vertex: Vertex, last_depth, active) -> mi.Bool:
        """The ``active`` paths that may leave ``vertex``."""
        if media.exist:
            return media.goes_on(vertex, self.max_depth, active)[0]
        return active & (vertex.depth < last_depth)

    def _carried(self, media: NoMedia, β: mi.Spectrum, vertex: Vertex) -> mi.Spectrum:
        """The throughput that is stored with ``vertex``."""
        return β if self.connects else media.arriving(β, vertex)

    def _scatter(self, heroes, vertex: Vertex, bs, weight, stores, active):
        """The weight of a BSDF sample, the density of the reverse direction, ``passes`` of
        :meth:`LightProgram.leave`, the factor of the sampling weight (:meth:`Heroes.scatter`), and
        whether only the hero wavelength is left."""
        bsdf, si, is_alone = vertex.bsdf, vertex.si, vertex.path.hero_is_alone
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        weight, hero_count, hero_is_alone = heroes.scatter(is_alone, weight, bsdf, si, bs)
        value, reverse_pdf = evaluate(heroes, is_alone, bsdf, si, bs.wo, active & ~is_delta)
        value *= dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0)
        weight = dr.select(is_delta, weight * delta_correction(si, bs), value)
        active &= self.program.is_open(si, bs.wo)
        passes = is_delta | ~stores
        return dr.select(active, weight, 0), reverse_pdf, passes, hero_count, hero_is_alone

    def _stores(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Whether vertices with this BSDF are stored."""
        lobes = mi.BSDFFlags.Smooth if self.stored_lobes is None else self.stored_lobes
        return mi.has_flag(bsdf.flags(), lobes)

    def _survival(self, paths, si, bsdf, β, sampling_weight, depth, hero_is_alone, active):
        """The survival probability of Russian roulette. η is 1, since refraction does not scale
        the flux that light paths carry."""
        arrival = Arrival(mi.Interaction3f(si), mi.Float(1), mi.Bool(False))
        path = PathState(β, mi.Float(1), sampling_weight, depth, arrival, hero_is_alone)
        return self.roulette.survival(None, Vertex(si, bsdf, path), path, active)[0]
