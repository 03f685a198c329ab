"""Solves for specular chains between a point and a light."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .chain import Chains, RayState

MAX_STEPS = 20
TOLERANCE = 1e-4
LEAST_TURN = 1e-3
LEAST_STEP = 1 / 64
SAME = 1e-6
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


@dataclass
class Solution:
    """A chain that ends at its target.

    Attributes:
        d: The first direction.
        end: The end of the chain.
        density: See :class:`Miss`.
        pattern: Length and kind of the chain.
        count: The number of further trials until one found the same chain: an estimate of 1 / the
            probability of finding it.
        is_found: Whether there is one.
    """

    d: mi.Vector3f
    end: RayState
    density: mi.Float
    pattern: mi.UInt32
    count: mi.Float
    is_found: mi.Bool


class Solver:
    """Finds a chain from a random seed by Newton's method, and estimates how likely that was."""

    def __init__(self, chains: Chains, starts, seeds) -> None:
        self._chains, self._starts, self._seeds = chains, starts, seeds

    @dr.syntax
    def find(self, si, target: Target, seed: mi.UInt32, most: mi.UInt32, active) -> Solution:
        """The chain that the first trial finds. Further trials follow until one finds it again."""
        best_d, best_error = mi.Vector3f(0), mi.Float(dr.inf)
        step, share = mi.Vector2f(0), mi.Float(1)
        transmits, length = mi.UInt32(0), mi.UInt32(0)
        zero = mi.Vector3f(0)
        found = Solution(
            mi.Vector3f(0),
            RayState(mi.Point3f(0), zero, mi.Point3f(0), zero, zero, zero, zero, mi.Spectrum(0),
                     mi.Float(0), mi.UInt32(0), mi.Bool(False)),
            mi.Float(0), mi.UInt32(0), mi.Float(0), mi.Bool(False),
        )
        steps, trial = mi.UInt32(0), mi.UInt32(0)
        going = mi.Bool(active)
        while dr.hint(going, label="manifold walk"):
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
            end = self._chains.trace(self._starts.along(si, d), length, transmits, is_open, going)
            length = dr.select(begins, end.length, length)
            miss = missed(end, target)
            # ---- Is it better? ----
            better = going & miss.is_sound & (miss.error < best_error)
            best_error = dr.select(better, miss.error, best_error)
            best_d = dr.select(better, d, best_d)
            step = dr.select(better, mi.Vector2f(miss.step_s, miss.step_t), step)
            turn = dr.norm(step)
            done = better & (miss.error < TOLERANCE) & (turn < LEAST_TURN)
            share = dr.select(better, dr.minimum(1, 2 * share), 0.5 * share)
            # A step of more than a radian leaves what the derivatives describe
            share = dr.minimum(share, dr.rcp(turn))
            steps += 1
            fails = ~done & (
                (steps >= MAX_STEPS) | (share < LEAST_STEP) | ~dr.isfinite(best_error)
            )
            # ---- The first trial, or one of those that follow ----
            pattern = end.length * 4 + (transmits & 1)
            fresh = done & (trial == 0)
            same = done & (trial > 0) & (pattern == found.pattern) & (
                dr.squared_norm(d - found.d) < SAME
            )
            new = Solution(d, end, miss.density, pattern, found.count, mi.Bool(True))
            found = dr.select(fresh, new, found)
            found.count = dr.select(same, mi.Float(trial), found.count)
            ends = done | fails
            trial += dr.select(ends, 1, 0)
            steps = dr.select(ends, 0, steps)
            going &= ~ends | (found.is_found & ~same & (trial < MOST_TRIALS))
        found.count = dr.select(found.count == 0, mi.Float(trial), found.count)
        return found
