"""Combinations of decisions: a few of them, in which any two choices occur together."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

Choice = tuple[str, str]

_GUIDED = {"type": "guided_directions", "always_guide": True}
_NUMBERS = {"type": "weighted_numbers", "pattern": "stratified", "weights": "torus"}


def _connections(count: int, vertices: str) -> dict[str, Any]:
    return {"type": "weighted_connections", "count": count, "vertices": vertices}


#: By slot, and for what the scene is: names of choices, and the parameters that they stand for.
FACTORS: dict[str, dict[str, dict[str, Any]]] = {
    "directions": {
        "uniform": {},
        "surfaces": {"directions": _GUIDED},
        "tiles": {"directions": {**_GUIDED, "regions": "tiles", "tile": 5}},
    },
    "next_event": {
        "uniform": {}, "power": {"next_event": "power"}, "spatial": {"next_event": "spatial"},
        "linear": {"next_event": "linear"}, "tree": {"next_event": "tree"},
        "visibility": {"next_event": {"type": "learned_lights", "target": "visibility", "grid": 4}},
        "contribution": {"next_event": {"type": "learned_lights", "grid": 4}},
        "two_stage": {"next_event": {"type": "two_stage_lights", "splits": 4}},
        "resampled": {"next_event": {"type": "resampled_lights", "candidates": 4}},
    },
    "connections": {
        "one": {},
        "none_at_first": {"connections": _connections(0, "first")},
        "none": {"connections": _connections(0, "all")},
        "four_at_first": {"connections": _connections(4, "first")},
        "four": {"connections": _connections(4, "all")},
    },
    "mis": {"power": {}, "balance": {"mis": "balance"}, "maximum": {"mis": "maximum"}},
    "shadow_test": {
        "always": {},
        # Half of the shadow rays, wherever they go
        "roulette": {"shadow_test": {"type": "visibility_roulette", "slope": 0.0, "floor": 0.5}},
    },
    "camera": {
        "plain": {}, "aperture": {"aperture": _NUMBERS}, "time": {"time": _NUMBERS},
        "wavelength": {"wavelength": _NUMBERS},
        "all": dict.fromkeys(("aperture", "time", "wavelength"), _NUMBERS),
    },
    "scene": {"static": {}, "moving": {}},
}  # fmt: skip


def covering_array(factors: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """Rows of one choice for each factor, such that any two choices of different factors are in one
    row at least. Greedy: each row takes the choices that cover most of the pairs that are left."""
    names = sorted(factors, key=lambda name: -len(factors[name]))
    left = {
        frozenset(((a, x), (b, y)))
        for a, b in itertools.combinations(names, 2)
        for x in factors[a]
        for y in factors[b]
    }
    rng, rows = np.random.default_rng(0), []
    while left:
        candidates = [_row(names, factors, left, rng) for _ in range(30)]
        best = max(candidates, key=lambda row: len(left & set(_pairs(row))))
        left -= set(_pairs(best))
        rows.append({name: best[name] for name in factors})
    return rows


def _row(names, factors, left, rng) -> dict[str, str]:
    """One that covers a pair that is left, and greedily more."""
    row = dict(sorted(left, key=sorted)[rng.integers(len(left))])
    for name in rng.permutation([name for name in names if name not in row]).tolist():
        gains = {
            choice: sum(frozenset(((name, choice), item)) in left for item in row.items())
            for choice in factors[name]
        }
        most = max(gains.values())
        row[name] = str(rng.choice([choice for choice, gain in gains.items() if gain == most]))
    return row


def _pairs(row: Mapping[str, str]) -> Iterator[frozenset[Choice]]:
    return map(frozenset, itertools.combinations(row.items(), 2))
