"""Solves for specular chains between a point and a light."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..stored_interaction import as_float
from .chain import Chains, RayState

MAX_STEPS = 20
TOLERANCE = 1e-4
LEAST_TURN = 1e-3
LEAST_STEP = 1 / 64
SAME = 1e-6
TASKS_PER_LANE = 16
MOST_TRIALS = 2000


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
    """What is searched for: one chain for each lane of a pass, or none.

    Attributes:
        words: For each: the vertex (position and normal), the target, the seed of its random
            numbers, and the longest chain (0 where nothing is searched; a bit for lights at
            infinity).
        count: Number of lanes.
    """

    WORDS = 16

    def __init__(self, si, target: Target, seed, most) -> None:
        self.count = dr.width(seed)
        mark = most | dr.select(target.is_infinite, mi.UInt32(256), 0)
        words = [*si.p, *si.n, *target.p, as_float(seed), as_float(mark)]
        words += [mi.Float(0)] * (self.WORDS - len(words))
        self.words = dr.empty(mi.Float, self.count * self.WORDS)
        dr.scatter(self.words, mi.ArrayXf(words), dr.arange(mi.UInt32, self.count))

    def at(self, index, active):
        w = dr.gather(mi.ArrayXf, self.words, index, active, shape=(self.WORDS, dr.width(index)))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        si.p, si.n = mi.Point3f(w[0], w[1], w[2]), mi.Normal3f(w[3], w[4], w[5])
        mark = dr.reinterpret_array(mi.UInt32, w[10])
        target = Target(mi.Point3f(w[6], w[7], w[8]), (mark & 256) != 0)
        return si, target, dr.reinterpret_array(mi.UInt32, w[9]), mark & 255


@dataclass
class Found:
    """The chains that were found, one for each lane.

    Attributes:
        d: The first direction.
        pattern: Length and kind of the chain; 0 if none was found.
        count: The number of further trials until one found the same chain: an estimate of 1 / the
            probability of finding it.
    """

    d: mi.Vector3f
    pattern: mi.UInt32
    count: mi.UInt32


class Solver:
    """Finds chains from random seeds by Newton's method, and estimates how likely that was."""

    def __init__(self, chains: Chains, starts, seeds) -> None:
        self._chains, self._starts, self._seeds = chains, starts, seeds

    @dr.syntax
    def find(self, tasks: Tasks) -> Found:
        """The chains that first trials find. Further trials follow until one finds it again.

        A lane takes one task after the other: Dr.Jit works on 8 to 32 lanes at once, and all wait
        for the slowest. Sums of many tasks differ less than single ones."""
        lanes = -(-tasks.count // TASKS_PER_LANE)
        result_d = dr.zeros(mi.Float, 3 * tasks.count)
        result_pattern = dr.zeros(mi.UInt32, tasks.count)
        result_count = dr.zeros(mi.UInt32, tasks.count)
        task, count = dr.arange(mi.UInt32, lanes), dr.opaque(mi.UInt32, tasks.count)
        stride = dr.opaque(mi.UInt32, lanes)
        best_d, best_error = mi.Vector3f(0), mi.Float(dr.inf)
        step, share = mi.Vector2f(0), mi.Float(1)
        transmits, length = mi.UInt32(0), mi.UInt32(0)
        found_d, found_pattern = mi.Vector3f(0), mi.UInt32(0)
        steps, trial = mi.UInt32(0), mi.UInt32(0)
        going = task < count
        while dr.hint(going, label="manifold walk"):
            si, target, seed, most = tasks.at(task, going)
            tried = going & (most > 0)
            # ---- A new trial, or the next step ----
            begins = steps == 0
            chosen, is_open, seed_d = self._seeds(seed, trial, si, target)
            transmits = dr.select(begins, chosen, transmits)
            is_open &= begins
            longest = dr.select(is_open, most, 1)
            length = dr.select(begins, longest, length)
            frame = mi.Frame3f(best_d)
            d = dr.normalize(best_d + share * (step.x * frame.s + step.y * frame.t))
            d = dr.select(begins, seed_d, d)
            best_error = dr.select(begins, dr.inf, best_error)
            share = dr.select(begins, 1, share)
            end = self._chains.trace(self._starts.along(si, d), length, transmits, is_open, tried)
            length = dr.select(begins, end.length, length)
            miss = missed(end, target)
            # ---- Is it better? ----
            better = tried & miss.is_sound & (miss.error < best_error)
            best_error = dr.select(better, miss.error, best_error)
            best_d = dr.select(better, d, best_d)
            step = dr.select(better, mi.Vector2f(miss.step_s, miss.step_t), step)
            turn = dr.norm(step)
            done = better & (miss.error < TOLERANCE) & (turn < LEAST_TURN)
            share = dr.select(better, dr.minimum(1, 2 * share), 0.5 * share)
            # A step of more than a radian leaves what the derivatives describe
            share = dr.minimum(share, dr.rcp(turn))
            steps += 1
            ends = done | ~tried | (steps >= MAX_STEPS) | (share < LEAST_STEP) | ~dr.isfinite(best_error)
            # ---- The first trial, or one of those that follow ----
            pattern = end.length * 4 + (transmits & 1)
            fresh = done & (trial == 0)
            found_d = dr.select(fresh, d, found_d)
            found_pattern = dr.select(fresh, pattern, found_pattern)
            same = done & (trial > 0) & (pattern == found_pattern) & (
                dr.squared_norm(d - found_d) < SAME
            )
            finishes = ends & ((found_pattern == 0) | same | (trial >= MOST_TRIALS))
            record = going & finishes & (found_pattern != 0)
            dr.scatter(result_d, found_d.x, task, record)
            dr.scatter(result_d, found_d.y, task + count, record)
            dr.scatter(result_d, found_d.z, task + 2 * count, record)
            dr.scatter(result_pattern, found_pattern, task, record)
            dr.scatter(result_count, trial, task, record)
            # ---- The next trial, or the next task ----
            trial += dr.select(ends, 1, 0)
            steps = dr.select(ends, 0, steps)
            trial = dr.select(finishes, 0, trial)
            found_pattern = dr.select(finishes, 0, found_pattern)
            task += dr.select(finishes, stride, 0)
            going = task < count
        index = dr.arange(mi.UInt32, tasks.count)
        d = mi.Vector3f(*(dr.gather(mi.Float, result_d, index + i * count) for i in range(3)))
        return Found(d, result_pattern, result_count)
