"""The emission of lights that a path hits."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from .path_decisions import EmitterSampling, SceneQuery, Weights
from .path_program import PathProgram
from .vertex import PathState


def emission(
    scene: mi.Scene,
    query: SceneQuery,
    si: mi.SurfaceInteraction3f,
    path: PathState,
    next_event: EmitterSampling,
    state: Any,
    weights: Weights,
    program: PathProgram,
    count: mi.Float | float = 1.0,
) -> tuple[mi.Spectrum, mi.Float, mi.DirectionSample3f, mi.Float]:
    """The radiance that ``si`` (or the environment, if nothing was hit) emits towards the previous
    vertex, times the MIS weight of scattering; this weight; the direction from the previous vertex,
    and the density with which connections find it (0 where they cannot).

    Parameters:
        query: The decision that found ``si``.
        next_event, state: The decision whose connections could have found the light as well, and
            its state when the path left the previous vertex.
        weights, program: What weighs scattering against connections and other techniques.
        count: Number of connections of the previous vertex.
    """
    arrival = path.arrival
    ds = mi.DirectionSample3f(scene, si, arrival.ref)
    ds.emitter = query.emitter(si, ds.emitter)
    is_connectable = ~arrival.is_delta & (ds.emitter != None)  # noqa: E711
    pdf = next_event.density(state, scene, arrival.ref, si, ds, is_connectable)
    weight = program.emission(weights, scene, si, ds, path, count * pdf)
    return ds.emitter.eval(si, arrival.pdf > 0) * weight, weight, ds, pdf


def can_be_hit(scene: mi.Scene) -> bool:
    """Whether there is a light that a scattered ray can hit."""
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    return any(not (int(e.flags()) & int(delta)) for e in scene.emitters())
