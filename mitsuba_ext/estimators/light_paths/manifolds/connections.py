"""Connections of the vertices of camera paths to lights through smooth glass and mirrors.

Sources: J. Hanika, M. Droske, L. Fascione, *Manifold Next Event Estimation*, EGSR 2015; T. Zeltner,
I. Georgiev, W. Jakob, *Specular Manifold Sampling for Rendering High-Frequency Caustics and
Glints*, SIGGRAPH 2020. Ours differs in this: one vertex of each path is connected, and the MIS
weights leave out the probability of finding a chain, so that both sides can compute them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_bsdf
from ....transport.estimator import CameraRays
from ....transport.heroes import Heroes
from ....transport.mis import power_heuristic
from ....transport.numbers import hashed_2d
from ....transport.path_decisions import SceneQuery
from ....transport.vertex import PathState
from ..emission import EmittedRay, LightEmission
from ..stored_interaction import needs_whole_interaction
from .casters import Casters
from .chain import Chains, RayState, some_wavelengths
from .chosen_vertices import ChosenVertices
from .seed_learner import ChainRecords
from .seeds import SeedMap
from .solver import Found, Queue, Seed, Solver, Target, Tasks, Vertex, missed

#: The most surfaces of a chain: in and out of a piece of glass.
MOST_SURFACES = 2

#: In a scene with glass: the fraction of trials that search for a reflection; of those that search
#: for refractions, the fraction that stops at one surface though others follow (a lamp in a block
#: of glass); and the fraction that begins straight towards the light.
_REFLECTED, _SINGLE, _STRAIGHT = 0.25, 0.1, 0.5

#: The numbers of hashes that no trial uses.
_LIGHT_NUMBERS = 0xFFFF0000


class ManifoldConnections:
    """Connects vertices to lights through chains of casters.

    A chain is one reflection, or one or two refractions. Light that scattering finds through such a
    chain is weighed against connections (:meth:`weight`).

    Parameters:
        query: How rays intersect the scene.
        max_depth: Longest path in segments.
        seeds: Learned seeds.
    """

    def __init__(
        self, scene: mi.Scene, query: SceneQuery, casters: Casters, max_depth: int, seeds: SeedMap
    ) -> None:
        self._scene, self._query, self._casters, self._seeds = scene, query, casters, seeds
        self._ctx = Heroes(scene).context()
        self._emission = LightEmission(scene)
        self._max_depth = dr.opaque(mi.UInt32, max_depth)
        self._is_whole = needs_whole_interaction(scene)
        self._chains = Chains(scene, query, casters, self._ctx)
        self._solver = Solver(self._chains, query.starts, self._seed)

    def vertices(self, lanes: int) -> ChosenVertices:
        """What a pass with ``lanes`` paths stores, empty."""
        return ChosenVertices(lanes, self.most_surfaces, self._is_whole)

    def most_surfaces(self, depth: mi.UInt32) -> mi.UInt32:
        """The most surfaces of a chain that begins at a vertex at ``depth``."""
        used = dr.minimum(depth + 2, self._max_depth)
        return dr.minimum(self._max_depth - used, MOST_SURFACES)

    # ---- Connections ----

    def gather(
        self, vertices: ChosenVertices, rays: CameraRays, records: bool
    ) -> tuple[mi.Spectrum, mi.UInt32, ChainRecords | None]:
        """The radiance of one connection for each path, throughput included; the number of shadow
        rays; and the chains, if they are recorded.

        Each step is a kernel of its own, with lanes only for paths for which there is something to
        do."""
        lane = dr.arange(mi.UInt32, dr.width(rays.ray))
        si, _β, depth, light, seed, active = self._chosen(vertices, rays, lane, mi.Bool(True))
        target = self._target(light)
        leaf = self._seeds.leaf(si.p, target, active)
        tasks = Tasks(Vertex(si, target, seed, self.most_surfaces(depth), leaf))
        searched = Queue(active & (light.probability > 0))
        dr.eval(tasks.words)
        found = self._solver.find(tasks, searched)
        solved = Queue(found.length > 0)
        dr.eval(found)
        path, active = solved.all()
        of_path = dr.gather(Found, found, path, active)
        L, tested, first = self._light_of(of_path, *self._chosen(vertices, rays, path, active))
        light_of_path = dr.zeros(mi.Spectrum, tasks.count)
        shadow_count = dr.zeros(mi.UInt32, tasks.count)
        dr.scatter(light_of_path, L, path, active)
        dr.scatter(shadow_count, dr.select(tested, mi.UInt32(1), 0), path, active)
        first_of_path = dr.zeros(mi.Point3f, tasks.count) if records else None
        if records:
            dr.scatter(first_of_path, first, path, active)
        dr.eval(light_of_path, shadow_count, first_of_path)
        lit = Queue(dr.max(dr.abs(light_of_path)) > 0)
        trials = self._solver.count(tasks, lit, found)
        L = light_of_path * mi.Float(trials)
        if not records:
            return L, shadow_count, None
        pattern = (found.length << 2) | found.transmits
        weight = dr.max(dr.abs(mi.unpolarized_spectrum(L)))
        chains = ChainRecords(si.p, target.p, first_of_path, pattern, weight, trials)
        return L, shadow_count, chains

    def _chosen(
        self, vertices: ChosenVertices, rays: CameraRays, path: mi.UInt32, active: mi.Bool
    ) -> tuple:
        """The chosen vertices of paths, as :meth:`ChosenVertices.load` returns them, and a point of
        a light for each."""
        si, β, depth, seed, active = vertices.load(path, active)
        si.time = dr.gather(mi.Float, rays.ray.time, path, active)
        si.wavelengths = dr.gather(type(si.wavelengths), rays.ray.wavelengths, path, active)
        numbers = _HashedNumbers(seed, mi.UInt32(_LIGHT_NUMBERS))
        light = self._emission.sample(numbers, si.time, si.wavelengths, active)
        return si, β, depth, light, seed, active

    def _target(self, light: EmittedRay) -> Target:
        return Target(
            dr.select(light.is_infinite, mi.Point3f(-light.ray.d), light.start.p),
            light.is_infinite,
        )

    def _light_of(
        self, found: Found, si: mi.SurfaceInteraction3f, β: mi.Spectrum, depth: mi.UInt32,
        light: EmittedRay, seed: mi.UInt32, active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Bool, mi.Point3f]:
        """The radiance that chains bring, · the probability of finding them; whether there was a
        shadow ray; and the first point on a caster."""
        target = self._target(light)
        start = self._query.starts.along(si, found.d)
        end = self._chains.trace(
            start, found.length, found.transmits, mi.Bool(False), active, weighs=True
        )
        miss = missed(end, target)
        active &= miss.is_sound
        value, pdf = eval_bsdf(si.bsdf(), self._ctx, si, si.to_local(found.d), active)
        emitted, cosine = self._emitted(light, end, active)
        by_us = light.probability * dr.select(
            light.is_infinite, light.pdf_direction, light.pdf_position
        )
        by_us *= self._seeds.chance(self._seeds.leaf(start.o, target, active))
        mis = power_heuristic(by_us, pdf * end.chance * miss.density * cosine)
        mis = dr.select(light.is_delta_position | light.is_delta_direction, 1, mis)
        L = β * value * end.weight * emitted * (miss.density * mis)
        tested = active & (dr.max(dr.abs(L)) > 0)
        visible = tested & ~self._scene.ray_test(_last_ray(end, target), active=tested)
        return dr.select(visible, L, 0), tested, end.first

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

    def _seed(self, vertex: Vertex, trial: mi.UInt32) -> Seed:
        """Where a trial begins: at a learned seed, towards a random point near a caster, or towards
        the light."""
        si, target, seed = vertex.si, vertex.target, vertex.seed
        a, b, c, e = (hashed_2d(seed, trial * 4 + i) for i in range(4))
        d = dr.normalize(self._casters.near(a.x, mi.Vector3f(b.x, b.y, a.y), e.x) - si.p)
        transmits, length, is_open = mi.UInt32(0), mi.UInt32(1), mi.Bool(False)
        if self._casters.refract:
            straight = dr.select(
                target.is_infinite, mi.Vector3f(target.p), dr.normalize(target.p - si.p)
            )
            refracts = c.x >= _REFLECTED
            d = dr.select(refracts & (c.y < _STRAIGHT), straight, d)
            transmits = dr.select(refracts, mi.UInt32((1 << MOST_SURFACES) - 1), 0)
            is_open = c.x >= _REFLECTED + _SINGLE * (1 - _REFLECTED)
        first, pattern = self._seeds.seed(vertex.leaf, a.x, a.y)
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
        """The MIS weight of light at ``si`` that a path has hit through a chain."""
        h = path.history
        start = dr.zeros(mi.Ray3f)
        start.o, start.d, start.maxt = h.o, h.d, dr.largest(mi.Float)
        start.wavelengths = some_wavelengths()
        chain = self._chains.trace(start, h.length, h.transmits, mi.Bool(False), active)
        is_infinite = ~si.is_valid()
        target = Target(dr.select(is_infinite, mi.Point3f(ds.d), si.p), is_infinite)
        miss = missed(chain, target)
        n = dr.select(is_infinite, mi.Normal3f(-ds.d), self._emission.front(si))
        # Lights at infinity: the density of directions does not depend on the point
        ref = mi.Interaction3f(path.arrival.ref)
        position, direction = self._emission.densities(
            self._scene, ds.emitter, -chain.d, n, ref, active, True
        )
        index = self._emission.index(ds.emitter, active)
        direction *= self._emission.chance(index, active)
        by_us = self._seeds.chance(self._seeds.leaf(h.o, target, active))
        by_us *= dr.select(is_infinite, direction, position)
        by_scattering = h.pdf * miss.density
        by_scattering *= dr.select(is_infinite, 1, dr.abs(dr.dot(n, chain.d)))
        return dr.select(active & miss.is_sound, power_heuristic(by_scattering, by_us), 1)

    def ray(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
        """The ray that leaves ``si`` in the direction ``d``."""
        return self._query.starts.along(si, d)

    def passes(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Whether chains pass through this surface."""
        return self._casters.contain(si.shape)


class _HashedNumbers:
    """Random numbers by a hash of the seed of each lane and a number that counts."""

    def __init__(self, seed: mi.UInt32, index: mi.UInt32) -> None:
        self._seed, self._index = seed, index

    def next_2d(self, active=True):
        self._index = self._index + 1
        return hashed_2d(self._seed, self._index)

    def next_1d(self, active=True):
        return self.next_2d(active).x


def _last_ray(end: RayState, target: Target) -> mi.Ray3f:
    """The ray from the end of a chain to the light."""
    way = target.p - end.o
    distance = dr.norm(way)
    ray = mi.Ray3f(end.o, dr.select(target.is_infinite, mi.Vector3f(target.p), way / distance))
    ray.maxt = dr.select(
        target.is_infinite, dr.largest(mi.Float), distance * (1 - mi.math.ShadowEpsilon)
    )
    return ray
