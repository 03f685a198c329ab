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
    """A chain that ends at its target."""

    d: mi.Vector3f
    end: RayState
    density: mi.Float
    is_found: mi.Bool


class Solver:
    """Newton's method."""

    def __init__(self, chains: Chains, starts) -> None:
        self._chains, self._starts = chains, starts

    @dr.syntax
    def solve(self, si, d, length, transmits, is_open, target: Target, active) -> Solution:
        """Newton's method over the first direction, from ``d``."""
        best_d, best_error = mi.Vector3f(d), mi.Float(dr.inf)
        step_s, step_t, share = mi.Float(0), mi.Float(0), mi.Float(1)
        density, found = mi.Float(0), mi.Bool(False)
        p, out, o = mi.Point3f(0), mi.Vector3f(0), mi.Point3f(0)
        weight, chance = mi.Spectrum(0), mi.Float(0)
        steps = mi.UInt32(0)
        length = mi.UInt32(length)
        going = mi.Bool(active)
        while dr.hint(going, label="manifold walk"):
            frame = mi.Frame3f(best_d)
            new = dr.normalize(
                best_d + share * (step_s * frame.s + step_t * frame.t)
            )
            end = self._chains.trace(
                self._starts.along(si, new), length, transmits, is_open & (steps == 0), going
            )
            length = dr.select(going & (steps == 0), end.length, length)
            miss = missed(end, target)
            better = going & miss.is_sound & (miss.error < best_error)
            turn = dr.sqrt(dr.square(miss.step_s) + dr.square(miss.step_t))
            done = better & (miss.error < TOLERANCE) & (turn < LEAST_TURN)
            best_error = dr.select(better, miss.error, best_error)
            best_d = dr.select(better, new, best_d)
            step_s = dr.select(better, miss.step_s, step_s)
            step_t = dr.select(better, miss.step_t, step_t)
            share = dr.select(better, dr.minimum(1, 2 * share), 0.5 * share)
            # A step of more than a radian leaves what the derivatives describe
            length_of_step = dr.sqrt(dr.square(step_s) + dr.square(step_t))
            share = dr.minimum(share, dr.rcp(length_of_step))
            found |= done
            density = dr.select(done, miss.density, density)
            p, out = dr.select(done, end.p, p), dr.select(done, end.d, out)
            o = dr.select(done, end.o, o)
            weight = dr.select(done, end.weight, weight)
            chance = dr.select(done, end.chance, chance)
            steps += 1
            going &= ~done & (steps < MAX_STEPS) & (share > LEAST_STEP)
            going &= dr.isfinite(best_error)
        zero = mi.Vector3f(0)
        end = RayState(p, out, o, zero, zero, zero, zero, weight, chance, length, found)
        return Solution(best_d, end, density, found)
