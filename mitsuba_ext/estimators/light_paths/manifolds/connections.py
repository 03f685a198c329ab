"""Connections of camera vertices to lights through smooth glass and mirrors.

Source: T. Zeltner, I. Georgiev, W. Jakob, *Specular Manifold Sampling for Rendering High-Frequency
Caustics and Glints*, SIGGRAPH 2020.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.bsdfs import _index
from ....transport.bsdfs import eval_bsdf
from ....transport.heroes import Heroes
from ....transport.mis import power_heuristic
from ....transport.numbers import hashed_2d
from ....transport.path_decisions import SceneQuery
from ....transport.path_program import PathProgram, Subpaths
from ....util.arrays import from_numpy
from ..emission import LightEmission
from .casters import caster_shapes
from ..stored_interaction import as_float, from_words, needs_whole_interaction, to_words
from .chain import Chains, is_caster
from .solver import Solver, Target, Tasks, missed

#: The number of surfaces behind the last diffuse vertex, where no connection finds the path.
NEVER = 255
WORDS = 40


class ManifoldConnections(Subpaths):
    def __init__(self, scene, query: SceneQuery, max_depth: int, most: int) -> None:
        self._scene, self._query = scene, query
        self._heroes = Heroes(scene)
        self._ctx = self._heroes.context()
        shapes = caster_shapes(scene)
        self.bsdfs = list({id(s.bsdf()): s.bsdf() for s in shapes}.values())
        indices = [_index(b) for b in self.bsdfs]
        table = np.zeros(max(indices) + 1, bool)
        table[indices] = True
        self.table = mi.Bool(table)
        every = mi.ShapePtr
        self._shapes = dr.gather(
            mi.ShapePtr, scene.shapes_dr(),
            mi.UInt32([i for i, s in enumerate(scene.shapes()) if any(s is x for x in shapes)]),
        )
        self._count = len(shapes)
        self._emission = LightEmission(scene)
        self._max_depth, self.most = dr.opaque(mi.UInt32, max_depth), most
        self._refracts = any(
            int(b.flags()) & int(mi.BSDFFlags.DeltaTransmission) for b in self.bsdfs
        )
        self._chains = Chains(scene, query, shapes, self.table, self._ctx)
        self._is_whole = needs_whole_interaction(scene)
        self._solver = Solver(self._chains, query.starts, self._seed)

    def begin(self, lanes: int) -> None:
        self.lanes = lanes
        self._words = dr.empty(mi.Float, lanes * WORDS)
        self._totals = dr.zeros(mi.Float, lanes)

    def gather(self, scene, sampler, vertex, active):
        number = sampler.next_1d()
        seed = mi.UInt32(number * 4294967040.0)
        h = vertex.path.history
        w = self.importance(vertex, active)
        total = h.total + w
        u = hashed_2d(seed, mi.UInt32(0xFFFFFFFF)).x
        taken = active & (w > 0) & (u * total <= w)
        words = [*vertex.path.β, w, as_float(seed), as_float(vertex.depth)]
        words += to_words(vertex.si, self._is_whole)
        words += [mi.Float(0)] * (WORDS - len(words))
        dr.scatter(self._words, mi.ArrayXf(words), h.lane, taken)
        dr.scatter(self._totals, total, h.lane, active & (w > 0))
        return mi.Spectrum(0), mi.UInt32(0)

    def importance(self, vertex, active):
        most = self._most_at(vertex.depth)
        eligible = mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth) & (most > 0)
        return dr.select(eligible, dr.max(vertex.path.β), 0)

    def _most_at(self, depth):
        room = self._max_depth - dr.minimum(depth + 2, self._max_depth)
        return dr.minimum(room, self.most)

    @dr.syntax
    def connect(self, rays):
        """The light of one chain for each path."""
        count = self.lanes
        index = dr.arange(mi.UInt32, count)
        total = dr.gather(mi.Float, self._totals, index)
        active = total > 0
        w = dr.gather(mi.ArrayXf, self._words, index, active, shape=(WORDS, count))
        β = mi.Spectrum(*(w[i] for i in range(3))) * dr.select(active, total / w[3], 0)
        seed, depth = dr.reinterpret_array(mi.UInt32, w[4]), dr.reinterpret_array(mi.UInt32, w[5])
        si = from_words([w[i] for i in range(6, WORDS)], self._is_whole)
        si.time, si.wavelengths = rays.ray.time, rays.ray.wavelengths
        light = self._emission.sample(
            _Hashed(seed, mi.UInt32(0xFFFF0000)), si.time, si.wavelengths, active
        )
        target = Target(
            dr.select(light.is_infinite, mi.Point3f(-light.ray.d), light.start.p), light.is_infinite
        )
        most = dr.select(active, self._most_at(depth), 0)
        tasks = Tasks(si, target, seed, most)
        dr.eval(tasks.words)
        solution = self._solver.find(tasks)
        dr.eval(solution)
        found = active & (solution.pattern != 0)
        transmits = dr.select((solution.pattern & 1) != 0, mi.UInt32(3), 0)
        d, count = solution.d, mi.Float(solution.count)
        end = self._chains.trace(
            self._query.starts.along(si, d), solution.pattern >> 2, transmits, mi.Bool(False), found
        )
        miss = missed(end, target)
        found &= miss.is_sound
        out, o, p, weight = end.d, end.o, end.p, end.weight
        density, chance = miss.density, end.chance
        # ---- Its light ----
        wo = si.to_local(d)
        value, pdf = eval_bsdf(si.bsdf(), self._ctx, si, wo, found)
        start = light.start
        start.wi = start.to_local(-out)
        is_surface = ~light.is_infinite & ~light.is_delta_position
        emitted = light.emitter.eval(start, found & is_surface)
        cosine = dr.abs(dr.dot(self._emission.front(start), out))
        emitted *= cosine / (light.probability * light.pdf_position)
        # Radiance / density
        sky = light.weight * light.pdf_position
        ref = dr.zeros(mi.Interaction3f)
        ref.p = p
        ds, intensity = light.emitter.sample_direction(ref, mi.Point2f(0.5), found & light.is_delta_position)
        intensity = intensity * dr.square(ds.dist) / light.probability
        emitted = dr.select(light.is_infinite, sky, dr.select(light.is_delta_position, intensity, emitted))
        # ---- MIS with paths that the BSDFs sample ----
        to_area = dr.select(is_surface, cosine, 1)
        by_bsdf = pdf * chance * density * to_area
        by_us = light.probability * dr.select(
            light.is_infinite, light.pdf_direction, light.pdf_position
        )
        is_delta = light.is_delta_position | light.is_delta_direction
        mis = dr.select(is_delta, 1, power_heuristic(by_us, by_bsdf))
        L = β * value * weight * emitted * (density * count * mis)
        tested = found & (dr.max(dr.abs(L)) > 0)
        distance = dr.norm(target.p - o)
        ray = mi.Ray3f(
            o, dr.select(target.is_infinite, mi.Vector3f(target.p), (target.p - o) / distance),
        )
        ray.maxt = dr.select(target.is_infinite, dr.largest(mi.Float), distance * (1 - mi.math.ShadowEpsilon))
        visible = tested & ~self._scene.ray_test(ray, active=tested)
        return dr.select(visible, L, 0), dr.select(tested, mi.UInt32(1), 0)

    def _seed(self, seed, index, si, target):
        base = index * 4
        a, b, c = (hashed_2d(seed, base + i) for i in range(3))
        which = dr.minimum(mi.UInt32(a.x * self._count), self._count - 1)
        shape = dr.gather(mi.ShapePtr, self._shapes, which)
        ps = shape.sample_position(si.time, b)
        d = dr.normalize(ps.p - si.p)
        transmits, is_open = mi.UInt32(0), mi.Bool(False)
        if self._refracts:
            straight = dr.select(target.is_infinite, mi.Vector3f(target.p), dr.normalize(target.p - si.p))
            transmits = dr.select(c.x < 0.25, mi.UInt32(0), 3)
            is_open = (transmits != 0) & (a.y < 0.9)
            d = dr.select((transmits != 0) & (c.y < 0.5), straight, d)
        return transmits, is_open, d

    @dr.syntax
    def by_bsdf(self, history, si, ds, active):
        """The MIS weight of light that a path has hit through a chain."""
        chain = self._chains.trace(
            mi.Ray3f(history.o, history.d), history.length, history.transmits, mi.Bool(False), active
        )
        is_infinite = ~si.is_valid()
        target = Target(dr.select(is_infinite, mi.Point3f(ds.d), si.p), is_infinite)
        miss = missed(chain, target)
        n = dr.select(is_infinite, mi.Normal3f(-ds.d), self._emission.front(si))
        position, direction = self._emission.densities(
            self._scene, ds.emitter, -chain.d, n, self._centre(si), active, True
        )
        cosine = dr.select(is_infinite, 1, dr.abs(dr.dot(n, chain.d)))
        by_us = dr.select(is_infinite, direction * self._emission.chance(self._emission.index(ds.emitter, active), active), position)
        sound = active & miss.is_sound
        by_bsdf = history.pdf * chain.chance * miss.density * cosine
        return dr.select(sound, power_heuristic(by_bsdf, by_us), 1)

    def _centre(self, si):
        ref = dr.zeros(mi.Interaction3f)
        ref.p = si.p
        return ref


@dataclass
class History:
    """The casters that a path has met since the last vertex that was connected.

    Attributes:
        o, d, pdf: Origin and direction of the ray that left the vertex, and its density.
        length: The number of casters; NEVER where no connection finds the path.
        transmits: Bit i tells whether caster i has transmitted the ray.
    """

    o: mi.Point3f
    d: mi.Vector3f
    pdf: mi.Float
    length: mi.UInt32
    transmits: mi.UInt32
    lane: mi.UInt32
    total: mi.Float


class _Hashed:
    def __init__(self, seed, index) -> None:
        self.seed, self.index = seed, index

    def next_2d(self, active=True):
        self.index = self.index + 1
        return hashed_2d(self.seed, self.index)

    def next_1d(self, active=True):
        return self.next_2d().x


class ManifoldProgram(PathProgram):
    """Camera paths whose vertices are connected to lights through chains of casters. Paths that
    such a connection can find are left to it.

    The history is the number of casters since the last vertex that was connected.
    """

    def __init__(self, subpaths: ManifoldConnections) -> None:
        self.subpaths = subpaths

    def begin(self, ray):
        return History(
            mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(0), mi.UInt32(NEVER), mi.UInt32(0),
            dr.arange(mi.UInt32, self.subpaths.lanes), mi.Float(0),
        )

    def leave(self, vertex, bs):
        h, most = vertex.path.history, self.subpaths.most
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        transmitted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
        passes = is_caster(self.subpaths.table, vertex.bsdf) & (h.length < most)
        # Only chains of refractions have more than one surface
        passes &= (h.length == 0) | (transmitted & (h.transmits != 0))
        si = vertex.si
        ray = self.subpaths._query.starts.along(si, si.to_world(bs.wo))
        bit = dr.select(transmitted, mi.UInt32(1) << h.length, 0)
        return History(
            dr.select(is_delta, h.o, ray.o), dr.select(is_delta, h.d, ray.d),
            dr.select(is_delta, h.pdf, bs.pdf),
            dr.select(is_delta, dr.select(passes, h.length + 1, NEVER), 0),
            dr.select(is_delta, h.transmits | bit, 0), h.lane,
            h.total + self.subpaths.importance(vertex, True),
        )

    def emission(self, weights, scene, si, ds, path, pdf):
        h = path.history
        own = (h.length != NEVER) & (h.length > 0) & (ds.emitter != None)
        mis = self.subpaths.by_bsdf(h, si, ds, own)
        return dr.select(own, mis, weights.emission(path.arrival.pdf, pdf))


@dataclass
class ManifoldTracer:
    """A walk, and one chain for each of its paths."""

    walk: Any
    make: Any

    def __call__(self, scene, sampler, rays, active):
        subpaths = self.make()
        subpaths.begin(dr.width(rays.ray))
        walk = replace(self.walk, program=ManifoldProgram(subpaths))
        dr.schedule(rays)
        sample = walk(scene, sampler, rays, active)
        dr.eval(sample, subpaths._words, subpaths._totals)
        L, tested = subpaths.connect(rays)
        return replace(sample, L=sample.L + L, shadow_count=sample.shadow_count + tested)
