"""The density with which bidirectional path tracing makes part of a path."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .memory import Head, PathMemory
from .space import PathSpace
from .techniques import Techniques

#: Stands for the logarithm of 0.
_LOG_ZERO = -1e30


@dr.syntax
def log_density(
    space: PathSpace,
    memory: PathMemory,
    path: Head,
    keeps: mi.UInt32,
    rest: mi.UInt32,
    active: mi.Bool,
    techniques: Techniques | None = None,
) -> mi.Float:
    """The logarithm of the density, over all techniques, of the vertices between ``keeps`` and
    ``rest``.

    Parameters:
        keeps, rest: As in :class:`~mitsuba_ext.estimators.chains.path_space.plan.Plan`.
        techniques: The probabilities of the techniques; ``None`` if each number of vertices made
            from the camera has the same probability.
    """
    uniform = -dr.log(mi.Float(rest - keeps))
    can_be_hit = ~space.kinds.is_unhittable(path.emitter, active)
    # ----- All vertices made from the light -----
    index = keeps + 1
    others, impossible = mi.Float(0), mi.Int32(0)
    while active & (index < rest):
        x = _from_light(memory, path, index)
        is_none = x < _LOG_ZERO
        others += dr.select(is_none, 0, x)
        impossible += dr.select(is_none, 1, 0)
        index += 1

    # ----- One more vertex at a time made from the camera instead -----
    index = keeps + 1
    largest, total = mi.Float(_LOG_ZERO), mi.Float(0)
    while active & (index <= rest):
        joins = _joins(space, memory, path, index, can_be_hit)
        chance = mi.Float(uniform)
        if dr.hint(techniques is not None, mode="scalar"):
            chance = techniques.log_chance(path.length, index - 1, active)
        x = dr.select(joins & (impossible == 0), others + chance, _LOG_ZERO)
        larger = dr.maximum(largest, x)
        total = total * dr.exp(largest - larger) + dr.select(x > _LOG_ZERO, dr.exp(x - larger), 0)
        largest = larger
        lost = _from_light(memory, path, index)
        gained = memory.logs[path.at + index].from_camera
        gained += dr.select(index > 1, memory.logs[path.at + index - 1].to_light, 0)
        others += dr.select(gained < _LOG_ZERO, 0, gained) - dr.select(lost < _LOG_ZERO, 0, lost)
        impossible += dr.select(gained < _LOG_ZERO, 1, 0) - dr.select(lost < _LOG_ZERO, 1, 0)
        index += 1
    return largest + dr.log(total)


def _from_light(memory: PathMemory, path: Head, index: mi.UInt32) -> mi.Float:
    is_last = index == path.length
    to_camera = memory.logs[path.at + index + 1].to_camera
    return memory.logs[path.at + index].from_light + dr.select(is_last, 0, to_camera)


def _joins(space, memory, path, index, can_be_hit) -> mi.Bool:
    """Whether vertex ``index``, made from the light, can be connected to the one made from the
    camera before it."""
    sees = mi.Bool(space.connectable is not None) & (path.length > 1)
    before = dr.select(index == 1, sees, memory.places[path.at + index - 1].is_discrete == 0)
    here = (index == path.length) | (memory.places[path.at + index].is_discrete == 0)
    return dr.select(index > path.length, can_be_hit, before & here)


@dr.syntax
def log_factors(
    memory: PathMemory,
    path: Head,
    last: mi.UInt32,
    from_light: mi.Bool,
    active: mi.Bool,
) -> mi.Float:
    """The sum of the logarithms of the geometric factors from the first vertex to ``last``, for
    directions from the camera or from the light. Apart from these factors, a perturbation and its
    reverse have the same density."""
    index, total = mi.UInt32(1), mi.Float(0)
    while active & (index <= last):
        logs = memory.logs[path.at + index]
        total += dr.select(from_light, logs.from_light, logs.from_camera)
        index += 1
    return total
