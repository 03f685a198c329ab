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
#: The number of tasks that a lane takes, one after the other: see :meth:`Solver.find`. (pool: 2.5
#: times as fast as one task for each lane.)
_TASKS_PER_LANE = 16
#: Trials end here. In pool, one chain in 10^6 needs more.
_MOST_TRIALS = 1 << 16


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
    way = target.p - end.p
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


# Not a dataclass: loops only read it
class Tasks:
    """What is searched for: one chain for each path of a pass, or none.

    Attributes:
        words: For each: the vertex (position and normal), the target, the seed of its random
            numbers, and the longest chain (0 where nothing is searched; a bit for lights at
            infinity).
        count: Number of paths.
    """

    _WORDS = 11
    _INFINITE = 256

    def __init__(
        self, si: mi.SurfaceInteraction3f, target: Target, seed: mi.UInt32, most: mi.UInt32
    ) -> None:
        self.count = dr.width(seed)
        mark = most | dr.select(target.is_infinite, mi.UInt32(self._INFINITE), 0)
        words = [*si.p, *si.n, *target.p, as_float(seed), as_float(mark)]
        self.words = dr.empty(mi.Float, self.count * self._WORDS)
        dr.scatter(self.words, mi.ArrayXf(words), dr.arange(mi.UInt32, self.count))

    def at(
        self, index: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, Target, mi.UInt32, mi.UInt32]:
        """Vertex, target, seed and longest chain of a path."""
        w = dr.gather(mi.ArrayXf, self.words, index, active, shape=(self._WORDS, dr.width(index)))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        si.p, si.n = mi.Point3f(w[0], w[1], w[2]), mi.Normal3f(w[3], w[4], w[5])
        si.wavelengths = some_wavelengths()
        seed, mark = (dr.reinterpret_array(mi.UInt32, word) for word in (w[9], w[10]))
        target = Target(mi.Point3f(w[6], w[7], w[8]), (mark & self._INFINITE) != 0)
        return si, target, seed, mark & (self._INFINITE - 1)


@dataclass
class Seed:
    """Where a trial begins.

    Attributes:
        d: The first direction.
        transmits: Bit i tells whether surface i of the chain transmits or reflects.
        is_open: Whether the chain is as long as the casters that it meets; if not, it has one.
    """

    d: mi.Vector3f
    transmits: mi.UInt32
    is_open: mi.Bool


@dataclass
class Found:
    """The chains that were found, one for each path.

    Attributes:
        d: The first direction.
        length: The number of surfaces; 0 if none was found.
        transmits: Bit i tells whether surface i transmits or reflects.
        trials: The number of further trials until one found the same chain. Its mean is 1 / the
            probability of finding it.
    """

    d: mi.Vector3f
    length: mi.UInt32
    transmits: mi.UInt32
    trials: mi.UInt32


class Solver:
    """Finds chains from random seeds by Newton's method, and estimates how likely that was.

    Parameters:
        chains: Traces chains.
        starts: Where rays start.
        seed: Draws the seed of a trial: from the seed of the path's random numbers, the number of
            the trial, vertex and target.
    """

    def __init__(self, chains: Chains, starts: RayStarts, seed: Callable[..., Seed]) -> None:
        self._chains, self._starts, self._seed = chains, starts, seed

    @dr.syntax
    def find(self, tasks: Tasks) -> Found:
        """The chains that first trials find. Further trials follow until one finds it again.

        Dr.Jit works on 8 to 32 lanes at once, and all wait for the slowest, which may need
        thousands of trials. So a lane takes several tasks, one after the other: their sums differ
        less."""
        lanes = -(-tasks.count // _TASKS_PER_LANE)
        result = dr.zeros(mi.Float, 3 * tasks.count)
        result_pattern = dr.zeros(mi.UInt32, tasks.count)
        result_trials = dr.zeros(mi.UInt32, tasks.count)
        count, stride = dr.opaque(mi.UInt32, tasks.count), dr.opaque(mi.UInt32, lanes)

        # --------------------- Configure the loop state ----------------------
        task = dr.arange(mi.UInt32, lanes)
        trial, steps = mi.UInt32(0), mi.UInt32(0)
        transmits, length = mi.UInt32(0), mi.UInt32(0)
        best_d, best_error = mi.Vector3f(0), mi.Float(dr.inf)
        step, share = mi.Vector2f(0), mi.Float(1)       # Newton's next step, and how much of it
        found_d, found_pattern = mi.Vector3f(0), mi.UInt32(0)
        going = task < count

        while dr.hint(going, label="manifold walk"):
            si, target, seed, most = tasks.at(task, going)
            tried = going & (most > 0)

            # ----- A new trial, or the next step -----
            begins = steps == 0
            new = self._seed(seed, trial, si, target)
            is_open = begins & new.is_open
            transmits = dr.select(begins, new.transmits, transmits)
            length = dr.select(begins, dr.select(is_open, most, 1), length)
            d = dr.select(begins, new.d, _turned(best_d, step, share))
            best_error = dr.select(begins, dr.inf, best_error)
            share = dr.select(begins, 1, share)
            end = self._chains.trace(self._starts.along(si, d), length, transmits, is_open, tried)
            length = dr.select(begins, end.length, length)
            miss = missed(end, target)

            # ----- Does it come closer? -----
            better = tried & miss.is_sound & (miss.error < best_error)
            best_error = dr.select(better, miss.error, best_error)
            best_d = dr.select(better, d, best_d)
            step = dr.select(better, mi.Vector2f(miss.step_s, miss.step_t), step)
            turn = dr.norm(step)
            share = dr.select(better, dr.minimum(1, 2 * share), 0.5 * share)
            # A step of more than a radian leaves what the derivatives describe
            share = dr.minimum(share, dr.rcp(turn))
            steps += 1
            solved = better & (miss.error < _LEAST_ERROR) & (turn < _LEAST_TURN)
            fails = (steps >= _MOST_STEPS) | (share < _LEAST_SHARE) | ~dr.isfinite(best_error)
            ends = solved | fails | ~tried

            # ----- The first trial, or one of those that follow -----
            pattern = (end.length << 2) | (transmits & ((1 << end.length) - 1))
            solution = _turned(d, step, mi.Float(1))
            is_first = solved & (trial == 0)
            found_d = dr.select(is_first, solution, found_d)
            found_pattern = dr.select(is_first, pattern, found_pattern)
            is_same = solved & (trial > 0) & (pattern == found_pattern)
            is_same &= dr.squared_norm(solution - found_d) < _SAME**2
            finishes = ends & ((found_pattern == 0) | is_same | (trial >= _MOST_TRIALS))
            record = going & finishes & (found_pattern != 0)
            for i in range(3):
                dr.scatter(result, found_d[i], task + i * count, record)
            dr.scatter(result_pattern, found_pattern, task, record)
            dr.scatter(result_trials, trial, task, record)

            # ----- Move on to the next trial, or the next task -----
            steps = dr.select(ends, 0, steps)
            trial = dr.select(finishes, 0, trial + dr.select(ends, 1, 0))
            found_pattern = dr.select(finishes, 0, found_pattern)
            task += dr.select(finishes, stride, 0)
            going = task < count
        index = dr.arange(mi.UInt32, tasks.count)
        d = mi.Vector3f(*(dr.gather(mi.Float, result, index + i * count) for i in range(3)))
        return Found(d, result_pattern >> 2, result_pattern & 3, result_trials)


def _turned(d: mi.Vector3f, step: mi.Vector2f, share: mi.Float) -> mi.Vector3f:
    """``d``, turned by a share of a step."""
    frame = mi.Frame3f(d)
    return dr.normalize(d + share * (step.x * frame.s + step.y * frame.t))
