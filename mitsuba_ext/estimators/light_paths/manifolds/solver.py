"""Solves for specular chains between a point and a light.

Sources: T. Zeltner, I. Georgiev, W. Jakob, *Specular Manifold Sampling for Rendering High-Frequency
Caustics and Glints*, SIGGRAPH 2020, sections 3 and 4.1 (a random seed, Newton's method, Bernoulli
trials). The unknown is the first direction of a chain, as in W. Jakob, S. Marschner, *Manifold
Exploration*, SIGGRAPH 2012, section 5, not the position of its vertices: a ray finds the surfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.scene_query import RayStarts
from ..stored_interaction import as_float
from .chain import Chains, RayState, some_wavelengths

#: Newton's steps of one trial. Those that converge need 3 to 6.
_MOST_STEPS = 20
#: A chain has converged where it misses the light by less than this angle, and the next step turns
#: the first direction by less than that one. The step is then taken: its error is of second order.
_LEAST_ERROR, _LEAST_TURN = 1e-4, 1e-3
#: A step that does not help is halved, down to this share.
_LEAST_SHARE = 1 / 64
#: Two trials have found the same chain if their first directions differ by less than this angle:
#: more than rounding, less than the distance of different chains.
_SAME = 3e-4
#: How many paths a lane takes: see :class:`Queue`.
_PATHS_PER_LANE = 32


@dataclass
class Target:
    """Where a chain should end.

    Attributes:
        p: A point; for lights at infinity, the direction towards the light.
        is_infinite: Whether it is a direction.
    """

    p: mi.Point3f
    is_infinite: mi.Bool


@dataclass
class Miss:
    """By how far the end of a chain misses its target.

    Attributes:
        error: The angle.
        step_s, step_t: Newton's step.
        density: Solid angle of first directions per area perpendicular to the ray (per solid angle,
            for lights at infinity).
        is_sound: Whether the target is in front of the ray.
    """

    error: mi.Float
    step_s: mi.Float
    step_t: mi.Float
    density: mi.Float
    is_sound: mi.Bool


def missed(end: RayState, target: Target) -> Miss:
    """By how far the chain ``end`` misses ``target``."""
    way = target.p - end.o  # where the ray really starts
    to_target = dr.select(target.is_infinite, mi.Vector3f(target.p), way)
    frame = mi.Frame3f(end.d)
    local = frame.to_local(to_target)
    distance = dr.select(target.is_infinite, mi.Float(1), local.z)
    is_sound = end.is_sound & (local.z > 0)
    moved = [
        dr.select(target.is_infinite, d, p + distance * d)
        for p, d in ((end.p_s, end.d_s), (end.p_t, end.d_t))
    ]
    s, t = (frame.to_local(x) for x in moved)
    det = s.x * t.y - s.y * t.x
    inverse = dr.select(det != 0, dr.rcp(det), 0)
    return Miss(
        dr.sqrt(dr.square(local.x) + dr.square(local.y)) / local.z,
        (local.x * t.y - local.y * t.x) * inverse, (s.x * local.y - s.y * local.x) * inverse,
        dr.abs(inverse), is_sound & (det != 0),
    )


@dataclass
class Search:
    """From where a chain is searched for.

    Attributes:
        si: The vertex; only its position and normal are set.
        target: Where the chain should end.
        seed: The seed of the path's random numbers.
        most: The most surfaces of the chain.
        leaf: The leaf of learned seeds.
        offsets: The offsets of its surfaces; ``None`` if all casters are smooth.
    """

    si: mi.SurfaceInteraction3f
    target: Target
    seed: mi.UInt32
    most: mi.UInt32
    leaf: mi.UInt32
    offsets: mi.Vector4f | None


# Not a dataclass: loops only read it
class Tasks:
    """What is searched for: one chain for each path of a pass, or none.

    Attributes:
        words: For each: the vertex (position and normal), the target, the seed of its random
            numbers, the longest chain, with a bit for lights at infinity, the leaf, and offsets.
        count: Number of paths.
    """

    _INFINITE = 256

    def __init__(self, searches: Search) -> None:
        v, self.count = searches, dr.width(searches.seed)
        mark = v.most | dr.select(v.target.is_infinite, mi.UInt32(self._INFINITE), 0)
        words = [*v.si.p, *v.si.n, *v.target.p, as_float(v.seed), as_float(mark)]
        words.append(as_float(v.leaf))
        words += [] if v.offsets is None else [*v.offsets]
        self._size = len(words)
        self.words = dr.empty(mi.Float, self.count * self._size)
        dr.scatter(self.words, mi.ArrayXf(words), dr.arange(mi.UInt32, self.count))

    def at(self, path: mi.UInt32, active: mi.Bool) -> Search:
        """The search of a path."""
        w = dr.gather(mi.ArrayXf, self.words, path, active, shape=(self._size, dr.width(path)))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(path))
        si.p, si.n = mi.Point3f(w[0], w[1], w[2]), mi.Normal3f(w[3], w[4], w[5])
        si.wavelengths = some_wavelengths()
        seed, mark, leaf = (dr.reinterpret_array(mi.UInt32, w[i]) for i in (9, 10, 11))
        target = Target(mi.Point3f(w[6], w[7], w[8]), (mark & self._INFINITE) != 0)
        offsets = mi.Vector4f(*(w[i] for i in range(12, 16))) if self._size > 12 else None
        return Search(si, target, seed, mark & (self._INFINITE - 1), leaf, offsets)


@dataclass
class Seed:
    """Where a trial begins.

    Attributes:
        d: The first direction.
        transmits: Bit i tells whether surface i of the chain transmits or reflects.
        length: The number of surfaces.
        is_open: Whether the chain is as long as the casters that it meets instead.
    """

    d: mi.Vector3f
    transmits: mi.UInt32
    length: mi.UInt32
    is_open: mi.Bool


@dataclass
class Found:
    """The chains that were found, one for each path.

    Attributes:
        d: The first direction.
        length: The number of surfaces; 0 if none was found.
        transmits: Bit i tells whether surface i transmits or reflects.
    """

    d: mi.Vector3f
    length: mi.UInt32
    transmits: mi.UInt32


# Not a dataclass: loops only read it
class Queue:
    """The paths for which there is something to do. Lanes take several, one after the other.

    Dr.Jit works on 8 to 32 lanes at once, and all wait for the slowest, which may need thousands of
    trials: the sums of several paths differ less. Which lane takes which path does not depend on
    the time that others take: rounding in Embree depends on the rays that are traced together, and
    the same seed would not give the same image."""

    def __init__(self, active: mi.Bool) -> None:
        self._count = dr.width(active)
        each = dr.select(active, mi.UInt32(1), 0)
        place = dr.prefix_sum(each)
        self._paths = dr.empty(mi.UInt32, self._count)
        dr.scatter(self._paths, dr.arange(mi.UInt32, self._count), place, active)
        self._size = dr.gather(mi.UInt32, place + each, dr.opaque(mi.UInt32, self._count - 1))
        self._stride = (self._size + (_PATHS_PER_LANE - 1)) // _PATHS_PER_LANE
        dr.eval(self._size, self._stride, self._paths)

    def first(self) -> tuple[mi.UInt32, mi.Bool]:
        """The place of the first path of each lane, and whether there is one."""
        lane = dr.arange(mi.UInt32, -(-self._count // _PATHS_PER_LANE))
        return lane, lane < self._stride

    def next(self, place: mi.UInt32, ends: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The place of the next path where one ``ends``, and whether there is one."""
        place = place + dr.select(ends, self._stride, 0)
        return place, place < self._size

    def path(self, place: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The path at a place."""
        return dr.gather(mi.UInt32, self._paths, place, active)

    def all(self) -> tuple[mi.UInt32, mi.Bool]:
        """The paths, in the first lanes of a kernel with as many lanes as there are paths."""
        lane = dr.arange(mi.UInt32, self._count)
        exists = lane < self._size
        return self.path(lane, exists), exists


@dataclass
class NewtonWalk:
    """A trial: the first direction of a chain, which Newton's steps improve.

    Attributes:
        d, error: The best direction until now, and by how far its chain misses the target.
        step: The next step from there.
        share: How much of it is taken.
        steps: The number of steps.
        length, transmits: The chain.
    """

    d: mi.Vector3f
    error: mi.Float
    step: mi.Vector2f
    share: mi.Float
    steps: mi.UInt32
    length: mi.UInt32
    transmits: mi.UInt32


class Solver:
    """Finds chains from seeds by Newton's method, and estimates how likely that was.

    Parameters:
        chains: Traces chains.
        starts: Where rays start.
        seed: Draws the seed of a trial: from the seed of the path's random numbers, the number of
            the trial, vertex and target.
    """

    def __init__(self, chains: Chains, starts: RayStarts, seed: Callable[..., Seed]) -> None:
        self._chains, self._starts, self._seed = chains, starts, seed

    @dr.syntax
    def find(self, tasks: Tasks, queue: Queue) -> Found:
        """The chains that one trial for each path of ``queue`` finds."""
        found_d = dr.zeros(mi.Float, 3 * tasks.count)
        found_pattern = dr.zeros(mi.UInt32, tasks.count)
        count = dr.opaque(mi.UInt32, tasks.count)
        place, going = queue.first()
        walk = _new_walk()
        while dr.hint(going, label="first trial"):
            path = queue.path(place, going)
            search = tasks.at(path, going)
            solved, ends, pattern, d = self._advance(walk, search, mi.UInt32(0), going)
            for i in range(3):
                dr.scatter(found_d, d[i], path + i * count, solved)
            dr.scatter(found_pattern, pattern, path, solved)
            walk.steps = dr.select(ends, 0, walk.steps)
            place, going = queue.next(place, ends)
        index = dr.arange(mi.UInt32, tasks.count)
        d = mi.Vector3f(*(dr.gather(mi.Float, found_d, index + i * count) for i in range(3)))
        return Found(d, found_pattern >> 2, found_pattern & 3)

    @dr.syntax
    def count(
        self, tasks: Tasks, queue: Queue, found: Found, most: mi.UInt32
    ) -> mi.UInt32:
        """How many further trials it takes to find a chain again, at ``most``, for each path of
        ``queue``. Without a limit, the mean of this number is 1 / the probability of finding it."""
        result = dr.zeros(mi.UInt32, tasks.count)
        place, going = queue.first()
        walk, trial = _new_walk(), mi.UInt32(1)
        while dr.hint(going, label="further trials"):
            path = queue.path(place, going)
            search = tasks.at(path, going)
            solved, ends, pattern, d = self._advance(walk, search, trial, going)
            length, transmits = (
                dr.gather(mi.UInt32, x, path, solved) for x in (found.length, found.transmits)
            )
            expected = dr.gather(mi.Vector3f, found.d, path, solved)
            is_same = solved & _are_same(Found(expected, length, transmits), pattern, d)
            limit = dr.gather(mi.UInt32, most, path, going)
            finishes = is_same | (ends & (trial >= limit))
            dr.scatter(result, trial, path, finishes)
            walk.steps = dr.select(ends, 0, walk.steps)
            trial = dr.select(finishes, 1, trial + dr.select(ends, mi.UInt32(1), 0))
            place, going = queue.next(place, finishes)
        return result

    @dr.syntax
    def find_again(
        self, search: Search, chain: Found, most: mi.UInt32, active: mi.Bool
    ) -> mi.UInt32:
        """How many trials it takes to find ``chain``; ``most`` + 1 if ``most`` do not find it."""
        walk, trial = _new_walk(), mi.UInt32(1)
        going = active & (trial <= most)
        while dr.hint(going, label="trials for scattering"):
            solved, ends, pattern, d = self._advance(walk, search, trial, going)
            is_same = solved & _are_same(chain, pattern, d)
            walk.steps = dr.select(ends, 0, walk.steps)
            trial += dr.select(ends & ~is_same, mi.UInt32(1), 0)
            going &= ~is_same & (trial <= most)
        return trial

    def _advance(
        self, walk: NewtonWalk, search: Search, trial: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Bool, mi.UInt32, mi.Vector3f]:
        """Begins a trial or makes the next step. Returns whether it has found a chain, whether it
        has ended, and length, pattern and first direction of the chain."""
        begins = walk.steps == 0
        new = self._seed(search, trial)
        is_open = begins & new.is_open
        walk.transmits = dr.select(begins, new.transmits, walk.transmits)
        length = dr.select(is_open, search.most, dr.minimum(new.length, search.most))
        length = dr.select(begins, length, walk.length)
        d = dr.select(begins, new.d, _turned(walk.d, walk.step, walk.share))
        walk.error = dr.select(begins, dr.inf, walk.error)
        walk.share = dr.select(begins, 1, walk.share)
        ray = self._starts.along(search.si, d)
        end = self._chains.trace(
            ray, length, walk.transmits, is_open, active, offsets=search.offsets
        )
        walk.length = dr.select(begins, end.length, walk.length)
        miss = missed(end, search.target)

        # ----- Does it come closer? -----
        better = active & miss.is_sound & (miss.error < walk.error)
        walk.error = dr.select(better, miss.error, walk.error)
        walk.d = dr.select(better, d, walk.d)
        walk.step = dr.select(better, mi.Vector2f(miss.step_s, miss.step_t), walk.step)
        turn = dr.norm(walk.step)
        walk.share = dr.select(better, dr.minimum(1, 2 * walk.share), 0.5 * walk.share)
        # A step of more than a radian leaves what the derivatives describe
        walk.share = dr.minimum(walk.share, dr.rcp(turn))
        walk.steps += 1
        solved = better & (miss.error < _LEAST_ERROR) & (turn < _LEAST_TURN)
        fails = (walk.steps >= _MOST_STEPS) | (walk.share < _LEAST_SHARE)
        fails |= ~dr.isfinite(walk.error)
        pattern = (end.length << 2) | (walk.transmits & ((1 << end.length) - 1))
        return solved, active & (solved | fails), pattern, _turned(d, walk.step, mi.Float(1))


def _new_walk() -> NewtonWalk:
    walk = dr.zeros(NewtonWalk)
    walk.error = mi.Float(dr.inf)
    return walk


def _are_same(chain: Found, pattern: mi.UInt32, d: mi.Vector3f) -> mi.Bool:
    is_same = pattern == ((chain.length << 2) | chain.transmits)
    return is_same & (dr.squared_norm(d - chain.d) < _SAME**2)


def _turned(d: mi.Vector3f, step: mi.Vector2f, share: mi.Float) -> mi.Vector3f:
    """``d``, turned by a share of a step."""
    frame = mi.Frame3f(d)
    return dr.normalize(d + share * (step.x * frame.s + step.y * frame.t))
