"""The decisions of the random walk: the defaults, and what replaces them, one file each.

Each decision but the query has ``begin(sampler, ray) -> state``, called once per path before the
loop (draw there what a whole path needs), and methods that take the state and return it. ``()`` is
the state of a decision that remembers nothing. Attributes are read-only while the walk runs.
"""

from ..transport.path_decisions import (
    AlwaysTest,
    DirectionSamples,
    EmitterSampling,
    Roulette,
    SceneQuery,
    ShadowTest,
    ThroughputRoulette,
)

__all__ = [
    "AlwaysTest",
    "DirectionSamples",
    "EmitterSampling",
    "Roulette",
    "SceneQuery",
    "ShadowTest",
    "ThroughputRoulette",
]
