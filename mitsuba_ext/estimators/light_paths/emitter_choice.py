"""The probabilities with which light paths choose the emitter that they start from."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...scene.lights.power import emitter_powers

#: The fraction of light paths that choose their emitter by power; the others choose it by its
#: ``sampling_weight``, as Mitsuba does. Each emitter is thus chosen with at least half of its
#: probability under either rule: a sky that sends most of its power past a room does not take all
#: paths from a lamp in it.
_BY_POWER = 0.5


def emitter_probabilities(scene: mi.Scene, can_emit: np.ndarray) -> np.ndarray:
    """The probability of choosing each emitter; 0 where ``can_emit`` is not set. An emitter that a
    camera path can hit is chosen even if its ``sampling_weight`` is 0, because camera paths that
    hit it count its light too."""
    emitters = scene.emitters()
    delta = int(mi.EmitterFlags.DeltaPosition) | int(mi.EmitterFlags.DeltaDirection)
    can_be_hit = np.array([not int(e.flags()) & delta for e in emitters])
    weight = np.array([float(e.sampling_weight()) for e in emitters])
    weight = np.where((weight <= 0) & can_be_hit, 1.0, weight) * can_emit
    power = emitter_powers(scene) * weight
    total = power.sum()
    if weight.sum() <= 0:
        return np.zeros(len(emitters))
    by_weight = weight / weight.sum()
    if not (np.isfinite(total) and total > 0):
        return by_weight
    return _BY_POWER * power / total + (1 - _BY_POWER) * by_weight
