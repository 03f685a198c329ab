"""Connections of the vertices of camera paths to lights through smooth glass and metal, and through
slightly rough glass.

Sources: J. Hanika, M. Droske, L. Fascione, *Manifold Next Event Estimation*, EGSR 2015; T. Zeltner,
I. Georgiev, W. Jakob, *Specular Manifold Sampling for Rendering High-Frequency Caustics and
Glints*, SIGGRAPH 2020. Ours differs in this: one vertex of each path is connected, and light that
scattering finds counts where trials do not find its chain (``shares.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_bsdf
from ....transport.estimator import CameraRays
from ....transport.heroes import Heroes
from ....transport.numbers import hashed_2d
from ....transport.path_channels import PathChannels
from ....transport.path_decisions import SceneQuery
from ....transport.vertex import PathState, Vertex
from ..emission import EmittedRay, LightEmission
from ..stored_interaction import needs_whole_interaction
from .casters import Casters
from .chain import Chains, RayState, some_wavelengths
from .chosen_vertices import ChosenVertex, ChosenVertices
from .history import MOST_SURFACES, History
from .microfacets import random_offsets
from .seed_learner import ChainRecords
from .seeds import SeedMap
from .shares import counted, most_trials, share_of_scattering
from .solver import Found, Miss, Queue, Search, Seed, Solver, Target, Tasks, missed

#: In a scene with glass: the fraction of trials that search for a reflection; of those that search
#: for refractions, the fraction that stops at one surface though others follow (a lamp in a block
#: of glass); and the fraction that begins straight towards the light.
_REFLECTED, _SINGLE, _STRAIGHT = 0.25, 0.1, 0.5

#: The most trials of a chain whose last surface is rough: chains that need more are left to
#: connections of that surface.
_MOST_ROUGH_TRIALS = 64

#: The numbers of hashes that no trial uses.
_LIGHT_NUMBERS = 0xFFFF0000

T = TypeVar("T")


@dataclass
class ChainLight:
    """The light of a chain.

    Attributes:
        L: The radiance that it brings, throughput included, · the probability of finding it.
        ratio: The density of scattering / the density of lights.
        shadow_count: The number of shadow rays.
        first: The first point on a caster.
        cells: The cells of light path expressions.
    """

    L: mi.Spectrum
    ratio: mi.Float
    shadow_count: mi.UInt32
    first: mi.Point3f
    cells: list[mi.UInt32]


class ManifoldConnections:
    """Connects vertices to lights through chains of casters.

    A chain is one reflection, or one or two refractions. Light that scattering finds through such a
    chain counts where connections rarely find it (:meth:`weight`).

    Parameters:
        query: How rays intersect the scene.
        max_depth: Longest path in segments.
        seeds: Learned seeds.
        most_trials: Trials of a chain end after this number.

    Attributes:
        casters: The casters.
    """

    def __init__(
        self, scene: mi.Scene, query: SceneQuery, casters: Casters, max_depth: int, seeds: SeedMap,
        most_trials: int,
    ) -> None:
        self._scene, self._query, self.casters, self._seeds = scene, query, casters, seeds
        self._ctx = Heroes(scene).context()
        self._emission = LightEmission(scene)
        self._max_depth = dr.opaque(mi.UInt32, max_depth)
        self._most_trials = dr.opaque(mi.UInt32, most_trials)
        self._is_whole = needs_whole_interaction(scene)
        self._chains = Chains(scene, query, casters, self._ctx)
        self._solver = Solver(self._chains, query.starts, self._seed)

    def vertices(
        self, lanes: int, channels: PathChannels | None, stride: mi.UInt32
    ) -> ChosenVertices:
        """What a pass with ``lanes`` paths stores, empty. One in ``stride`` paths is connected."""
        events = 0 if channels is None else channels.colours
        return ChosenVertices(lanes, self._connects, self._is_whole, stride, events)

    def most_surfaces(self, depth: mi.UInt32) -> mi.UInt32:
        """The most surfaces of a chain that begins at a vertex at ``depth``."""
        used = dr.minimum(depth + 2, self._max_depth)
        return dr.minimum(self._max_depth - used, MOST_SURFACES)

    def _connects(self, vertex: Vertex) -> mi.Bool:
        """Whether a vertex has connections through casters. Rough casters have none."""
        connects = vertex.is_smooth & (self.most_surfaces(vertex.depth) > 0)
        return connects & ~self.is_rough(vertex.si) if self.are_rough else connects

    # ---- Connections ----

    def gather(
        self, vertices: ChosenVertices, rays: CameraRays, channels: PathChannels | None,
        records: bool,
    ) -> tuple[mi.Spectrum, list[mi.Spectrum], mi.UInt32, ChainRecords | None]:
        """The radiance of one connection for each path, throughput included; the part that each
        channel of a light path expression gains; the number of shadow rays; and the chains, if
        they are recorded.

        Each step is a kernel of its own, with lanes only for paths for which there is something to
        do."""
        lanes = dr.arange(mi.UInt32, dr.width(rays.ray))
        chosen, light = self._chosen(vertices, rays, lanes, mi.Bool(True))
        target = self._target(light)
        leaf = self._seeds.leaf(chosen.si.p, target, chosen.exists)
        most = self.most_surfaces(chosen.depth)
        tasks = Tasks(
            Search(chosen.si, target, chosen.seed, most, leaf, self._offsets(chosen.seed))
        )
        searched = Queue(chosen.exists & (light.probability > 0))
        dr.eval(tasks.words)
        found = self._solver.find(tasks, searched)
        solved = Queue(found.length > 0)
        dr.eval(found)
        path, active = solved.all()
        brought = self._light_of(
            dr.gather(Found, found, path, active), *self._chosen(vertices, rays, path, active),
            channels,
        )  # fmt: skip
        light_of_path, ratio, shadow_count, *cells = (
            _of_paths(value, path, active, tasks.count)
            for value in (brought.L, brought.ratio, brought.shadow_count, *brought.cells)
        )
        first = _of_paths(brought.first, path, active, tasks.count) if records else None
        dr.eval(light_of_path, ratio, shadow_count, cells, first)
        most = most_trials(ratio, self._most_trials)
        dr.eval(most)
        bright = Queue(dr.max(dr.abs(light_of_path)) > 0)
        trials = self._solver.count(tasks, bright, found, most)
        L = light_of_path * counted(trials, ratio)
        parts = [] if channels is None else channels.parts(cells, L)
        if not records:
            return L, parts, shadow_count, None
        pattern = (found.length << 2) | found.transmits
        weight = dr.max(dr.abs(mi.unpolarized_spectrum(L)))
        chains = ChainRecords(
            chosen.si.p, target.p, first, pattern, weight,
            dr.mean(mi.unpolarized_spectrum(light_of_path)), ratio, trials,
        )  # fmt: skip
        return L, parts, shadow_count, chains

    def _chosen(
        self, vertices: ChosenVertices, rays: CameraRays, path: mi.UInt32, active: mi.Bool
    ) -> tuple[ChosenVertex, EmittedRay]:
        """The chosen vertices of paths, and a point of a light for each."""
        chosen = vertices.load(path, active)
        si = chosen.si
        si.time = dr.gather(mi.Float, rays.ray.time, path, active)
        si.wavelengths = dr.gather(type(si.wavelengths), rays.ray.wavelengths, path, active)
        numbers = _HashedNumbers(chosen.seed, mi.UInt32(_LIGHT_NUMBERS))
        return chosen, self._emission.sample(numbers, si.time, si.wavelengths, chosen.exists)

    def _target(self, light: EmittedRay) -> Target:
        return Target(
            dr.select(light.is_infinite, mi.Point3f(-light.ray.d), light.start.p),
            light.is_infinite,
        )

    def _light_of(
        self, found: Found, chosen: ChosenVertex, light: EmittedRay,
        channels: PathChannels | None,
    ) -> ChainLight:
        """The light of chains."""
        si, active = chosen.si, chosen.exists
        target = self._target(light)
        start = self._query.starts.along(si, found.d)
        end = self._chains.trace(
            start, found.length, found.transmits, mi.Bool(False), active, weighs=True,
            channels=channels, offsets=self._offsets(chosen.seed),
        )
        miss = missed(end, target)
        active &= miss.is_sound
        value, pdf = eval_bsdf(si.bsdf(), self._ctx, si, si.to_local(found.d), active)
        emitted, cosine = self._emitted(light, end, active)
        by_us = light.probability * dr.select(
            light.is_infinite, light.pdf_direction, light.pdf_position
        )
        is_delta = light.is_delta_position | light.is_delta_direction
        ratio = self._ratio(
            pdf * end.chance, end.by_last, end, miss, target, by_us, cosine, is_delta
        )
        L = chosen.β * value * end.weight * emitted * miss.density
        tested = active & (dr.max(dr.abs(L)) > 0) & (ratio < 1)
        visible = tested & ~self._scene.ray_test(_last_ray(end, target), active=tested)
        cells = []
        if channels is not None:
            at = Vertex(si, si.bsdf(), PathState(*[None] * 6, events=chosen.events))
            wo = si.to_local(found.d)
            cells = channels.at_end(at, wo, value, end.symbols(), light.emitter, visible)
        shadow_count = dr.select(tested, mi.UInt32(1), 0)
        L = dr.select(visible, L, 0)
        return ChainLight(L, ratio, shadow_count, end.first, cells)

    def _emitted(
        self, light: EmittedRay, end: RayState, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """What a light emits towards the end of a chain: radiance · cosine / density per area
        (intensity / probability of a point, radiance / density per solid angle of a light at
        infinity), and the cosine."""
        is_surface = ~light.is_infinite & ~light.is_delta_position
        start = mi.SurfaceInteraction3f(light.start)
        start.wi = start.to_local(-end.d)
        cosine = dr.abs(dr.dot(self._emission.front(start), end.d))
        cosine = dr.select(is_surface, cosine, 1)
        radiance = light.emitter.eval(start, active & is_surface)
        emitted = radiance * cosine / (light.probability * light.pdf_position)
        ref = dr.zeros(mi.Interaction3f)
        ref.p, ref.wavelengths, ref.time = end.p, start.wavelengths, start.time
        is_point = active & light.is_delta_position
        ds, intensity = light.emitter.sample_direction(ref, mi.Point2f(0.5), is_point)
        intensity = intensity * dr.square(ds.dist) / light.probability
        emitted = dr.select(is_point, intensity, emitted)
        # Its weight contains the density of the disk on which light paths begin
        return dr.select(light.is_infinite, light.weight * light.pdf_position, emitted), cosine

    def _ratio(
        self, pdf: mi.Float, by_last: mi.Float | None, end: RayState, miss: Miss, target: Target,
        by_us: mi.Float, cosine: mi.Float, is_delta: mi.Bool,
    ) -> mi.Float:
        """The density with which other techniques find a chain / the density with which we choose
        its end and its offsets.

        Args:
            pdf: The density with which scattering finds all directions of the chain, divided by the
                densities of its offsets (as in :attr:`RayState.chance`).
            by_last: See :class:`RayState`.
            by_us: The density of the point on the light (of the direction, at infinity).
            cosine: At the light.
        """
        if not self.are_rough:
            return pdf * miss.density * dr.select(is_delta, 0, cosine / by_us)
        # Connections know the interpolated normal of a light, scattering the geometric one: the
        # ratio must be the same for both, and has no cosine
        by_scattering = dr.select(is_delta, 0, dr.rcp(by_us))
        distance = dr.select(target.is_infinite, 1, dr.squared_norm(target.p - end.o))
        ratio = pdf * miss.density * (by_scattering + distance * by_last)
        # Any ratio is unbiased, and this one bounds the number of trials
        return dr.select(by_last > 0, dr.maximum(ratio, 1 / _MOST_ROUGH_TRIALS), ratio)

    def _offsets(self, seed: mi.UInt32) -> mi.Vector4f | None:
        return random_offsets(seed) if self.are_rough else None

    def _seed(self, search: Search, trial: mi.UInt32) -> Seed:
        """Where a trial begins: at a learned seed, towards the light, towards a random point near a
        caster, or in a random direction on the side of that point. (Close to a caster, few points
        lead to a chain, but many directions do.)"""
        si, target, seed = search.si, search.target, search.seed
        a, b, c, e = (hashed_2d(seed, trial * 4 + i) for i in range(4))
        d = dr.normalize(self.casters.near(a.x, mi.Vector3f(b.x, b.y, a.y), e.x) - si.p)
        above = mi.Frame3f(dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, d)))
        is_random = self._seeds.is_left_out(e.y)
        d = dr.select(is_random, above.to_world(mi.warp.square_to_cosine_hemisphere(b)), d)
        transmits, length, is_open = mi.UInt32(0), mi.UInt32(1), mi.Bool(False)
        if self.casters.refract:
            straight = dr.select(
                target.is_infinite, mi.Vector3f(target.p), dr.normalize(target.p - si.p)
            )
            refracts = c.x >= _REFLECTED
            d = dr.select(refracts & (c.y < _STRAIGHT), straight, d)
            transmits = dr.select(refracts, mi.UInt32((1 << MOST_SURFACES) - 1), 0)
            is_open = c.x >= _REFLECTED + _SINGLE * (1 - _REFLECTED)
        first, pattern = self._seeds.seed(search.leaf, a.x, a.y)
        learned = self._seeds.is_used(e.y)
        return Seed(
            dr.select(learned, dr.normalize(first - si.p), d),
            dr.select(learned, pattern & 3, transmits),
            dr.select(learned, pattern >> 2, length),
            ~learned & is_open,
        )

    # ---- Paths that scattering finds ----

    def weight(
        self, path: PathState, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> mi.Float:
        """What counts of light at ``si`` that a path has hit through a chain."""
        is_infinite = ~si.is_valid()
        target = Target(dr.select(is_infinite, mi.Point3f(ds.d), si.p), is_infinite)
        n = dr.select(is_infinite, mi.Normal3f(-ds.d), self._emission.front(si))
        arrival = path.arrival
        by_last = dr.select(arrival.is_delta, 0, dr.rcp(arrival.pdf))
        ref = mi.Interaction3f(arrival.ref)
        return self._share(path.history, path.depth, target, ds, n, ref, by_last, active)

    def weight_of_connection(
        self, history: History, vertex: Vertex, ds: mi.DirectionSample3f, pdf: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """What counts of light to which the last vertex of a chain is connected. ``history``
        contains it, and ``pdf`` is the density with which scattering finds the light."""
        is_infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        target = Target(dr.select(is_infinite, mi.Point3f(ds.d), ds.p), is_infinite)
        ref = mi.Interaction3f(vertex.si)
        return self._share(
            history, vertex.depth + 1, target, ds, ds.n, ref, dr.rcp(pdf), active
        )

    def _share(
        self, h: History, depth: mi.UInt32, target: Target, ds: mi.DirectionSample3f,
        n: mi.Normal3f, ref: mi.Interaction3f, by_last: mi.Float, active: mi.Bool,
    ) -> mi.Float:
        """The share of other techniques in the light of the chain ``h``, which ends in ``target``,
        at ``depth``."""
        vertex = dr.zeros(mi.SurfaceInteraction3f)
        vertex.p, vertex.n, vertex.wavelengths = h.p, h.n, some_wavelengths()
        start = self._query.starts.along(vertex, h.d)
        chain = self._chains.trace(
            start, h.length, h.transmits, mi.Bool(False), active, offsets=h.offsets
        )
        miss = missed(chain, target)
        # Lights at infinity: the density of directions does not depend on the point
        position, direction = self._emission.densities(
            self._scene, ds.emitter, -chain.d, n, ref, active, True
        )
        index = self._emission.index(ds.emitter, active)
        direction *= self._emission.chance(index, active)
        by_us = dr.select(target.is_infinite, direction, position)
        cosine = dr.select(target.is_infinite, 1, dr.abs(dr.dot(n, chain.d)))
        pdf = h.pdf * chain.chance
        ratio = self._ratio(pdf, by_last, chain, miss, target, by_us, cosine, ds.delta)
        active &= miss.is_sound & (ratio < 1)
        search = Search(
            vertex, target, _hash_of(h.d), self.most_surfaces(depth - h.length - 1),
            self._seeds.leaf(h.p, target, active), h.offsets,
        )  # fmt: skip
        chain = Found(h.d, h.length, h.transmits)
        most = most_trials(ratio, self._most_trials)
        trials = self._solver.find_again(search, chain, most, active)
        return dr.select(active, share_of_scattering(trials, ratio), 1)

    @property
    def are_rough(self) -> bool:
        """Whether there are rough casters."""
        return self.casters.are_rough

    def is_rough(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Whether this surface is a rough caster."""
        return self.casters.is_rough(si.shape)


class _HashedNumbers:
    """Random numbers by a hash of the seed of each lane and a number that counts."""

    def __init__(self, seed: mi.UInt32, index: mi.UInt32) -> None:
        self._seed, self._index = seed, index

    def next_2d(self, active=True):
        self._index = self._index + 1
        return hashed_2d(self._seed, self._index)

    def next_1d(self, active=True):
        return self.next_2d(active).x


def _hash_of(d: mi.Vector3f) -> mi.UInt32:
    """A seed for random numbers, from a direction that was sampled."""
    x, y, z = (dr.reinterpret_array(mi.UInt32, value) for value in d)
    return mi.sample_tea_32(x ^ z, y)[0]


def _of_paths(value: T, path: mi.UInt32, active: mi.Bool, count: int) -> T:
    """Values for some of ``count`` paths, and 0 for the others."""
    result = dr.zeros(type(value), count)
    dr.scatter(result, value, path, active)
    return result


def _last_ray(end: RayState, target: Target) -> mi.Ray3f:
    """The ray from the end of a chain to the light."""
    way = target.p - end.o
    distance = dr.norm(way)
    ray = mi.Ray3f(end.o, dr.select(target.is_infinite, mi.Vector3f(target.p), way / distance))
    ray.maxt = dr.select(
        target.is_infinite, dr.largest(mi.Float), distance * (1 - mi.math.ShadowEpsilon)
    )
    return ray
