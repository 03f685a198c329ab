"""Learns in pilots where chains begin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ....planning.learner import Learner
from ....transport.estimator import Sample
from .seeds import SeedMap

#: The most chains that are kept of each pass.
_MOST_RECORDS = 1 << 16


@dataclass
class ChainRecords:
    """The chains of a pass, one for each path.

    Attributes:
        vertex, target: Where it begins and ends.
        first: Its first point on a caster.
        pattern: Length · 4 + the bits of the surfaces that transmit.
        weight: The light that it brings; 0 where there is no chain.
        light, ratio, trials: F, ratio and n of ``shares.py``; F is the mean of the channels.
    """

    vertex: mi.Point3f
    target: mi.Point3f
    first: mi.Point3f
    pattern: mi.UInt32
    weight: mi.Float
    light: mi.Float
    ratio: mi.Float
    trials: mi.UInt32

    def to_host(self) -> np.ndarray:
        """The records of chains; shape [chains, 11]."""
        index = dr.compress(self.weight > 0)
        stride = -(-dr.width(index) // _MOST_RECORDS)
        if stride == 0:
            return np.zeros((0, 11), np.float32)
        records = dr.gather(ChainRecords, self, index)
        columns = [*records.vertex, *records.target, *records.first]
        columns += [mi.Float(records.pattern), records.weight]
        return np.stack([np.array(x, np.float32) for x in columns], -1)[::stride]


class SeedLearner(Learner):
    """Learns seeds.

    Parameters:
        make: Makes the decision from seeds, and from the function that takes the chains, samples
            and pixels of each pass (``None`` after the last pilot).
    """

    def __init__(self, make: Callable[[SeedMap, Callable | None], Any]) -> None:
        self._make, self._records, self._map = make, [], SeedMap()

    def kernel_state(self) -> None:
        """The attributes on which kernels depend (``frozen.py``): none."""

    def start(self, scene, p, n):
        return self._make(self._map, self._record)

    def learn(self, pilot):
        if any(map(len, self._records)):
            self._map = SeedMap.of(np.concatenate(self._records))
        return self._make(self._map, None if pilot.is_last else self._record)

    def state(self):
        return self._map.state()

    def restore(self, scene, state):
        self._map = SeedMap.restored(state)
        return self._make(self._map, None)

    def finish(self):
        self._records = []

    def _record(self, chains: ChainRecords, sample: Sample, pixel: mi.UInt32) -> None:
        self._records.append(chains.to_host())

    def __str__(self):
        if not len(self._map.seeds):
            return "caustics: no chain was found"
        return f"caustics: seeds of chains in {len(self._map.seeds)} regions"
