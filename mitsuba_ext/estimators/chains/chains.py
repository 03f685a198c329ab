"""The base class of all chains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.frozen import frozen
from ...util.stored_arrays import StoredArrays
from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .numbers import generator, stream
from .small_steps import SmallSteps
from .stored import Arrays, Ranges, arrays_of, value_of
from .target import ImageTarget

#: The number of random numbers that a chain stores per state, for the camera's end of its path and
#: for the light's: about 20 bounces. Further numbers are drawn anew for each proposal, which is a
#: large step in these dimensions.
MAX_NUMBERS, MAX_LIGHT_NUMBERS = 128, 96

#: The approximate number of mutations of a launch, over all chains (a second or two on two CPU
#: cores), and the minimum number per chain. States are stored and the clock is checked in between.
_LAUNCH, _MIN_LAUNCH = 1 << 21, 16

#: The maximum number of chains in a file.
_MAX_CHAINS = 1 << 20

#: Streams of random numbers, different from the streams of the bootstrap.
CAMERA, LIGHT = 3, 4


@dataclass
class MutationCounts:
    """Statistics of chains, in each lane.

    Attributes:
        large, accepted_large, accepted_small: The number of large steps, and of accepted steps of
            each kind.
        large_target: The sum of the target function over all proposals of large steps.
        scatter, shadow, connections: As in :class:`~mitsuba_ext.transport.estimator.Sample`.
        black: The number of proposals whose target function is 0.
        longest: The largest number of visits of one state that were added to the image at once.
    """

    large: mi.UInt32
    accepted_large: mi.UInt32
    accepted_small: mi.UInt32
    large_target: mi.Float
    scatter: mi.UInt32
    shadow: mi.UInt32
    connections: mi.UInt32
    black: mi.UInt32
    longest: mi.Float

    @classmethod
    def none(cls, lanes: int) -> MutationCounts:
        kinds = [mi.UInt32] * 3 + [mi.Float] + [mi.UInt32] * 4 + [mi.Float]
        return cls(*(dr.zeros(kind, lanes) for kind in kinds))

    def plus(self, is_large, is_accepted, target, sample, visits) -> MutationCounts:
        """The counts after another proposal, from a state with ``visits`` visits so far."""
        return MutationCounts(
            self.large + dr.select(is_large, 1, 0),
            self.accepted_large + dr.select(is_large & is_accepted, 1, 0),
            self.accepted_small + dr.select(~is_large & is_accepted, 1, 0),
            self.large_target + dr.select(is_large, target, 0),
            self.scatter + sample.scatter_count,
            self.shadow + sample.shadow_count,
            self.connections + sample.connection_count,
            self.black + dr.select(target > 0, 0, 1),
            dr.maximum(self.longest, visits),
        )


@dataclass(frozen=True)
class ChainRules:
    """The parameters of the chains' moves.

    Attributes:
        large_step: The probability of a large step.
        steps: The small steps.
        uniform_weight: The weight of independent samples in the balance heuristic: their number per
            mutation, times the approximate mean of the target function; 0 if they are not used.
            With a bound on the luminance, it is the bound.
    """

    large_step: float
    steps: SmallSteps
    uniform_weight: float


class Chains:
    r"""Metropolis chains, one per lane, that sample vectors of numbers in proportion to a target
    function.

    Let :math:`a` be the probability of accepting a proposal. The expected visits are added to the
    image: :math:`a` for the proposal, and :math:`1 - a` for the state. Proposals of large steps are
    also independent samples; the balance heuristic combines them with the visits (Kelemen et al.
    2002).

    A state is added to the image when the chain leaves it.

    Source: D. Cline, PhD thesis, 2007, sections 7.11 to 7.13; C. Kelemen et al., *A Simple and
    Robust Mutation Strategy for the Metropolis Light Transport Algorithm*, Eurographics 2002.

    Parameters:
        target: The target function.
        image: The image to which visits are added.
        rules: The parameters of the moves.
        bootstrap, winners: The samples, and the index of the sample at which each chain starts.
        seed: The seed of the random numbers.
        energy: A factor for each visit's contribution.
        stored: The result of :meth:`stored` of chains with the same parameters, from which these
            continue; ``bootstrap`` and ``winners`` are then not needed.

    Attributes:
        rules: The parameters of the moves.
        count: The number of chains.
        done: The number of mutations of each chain.
    """

    def __init__(
        self,
        target: ImageTarget,
        image: ChainImage,
        rules: ChainRules,
        bootstrap: Bootstrap | None,
        winners: mi.UInt32 | None,
        seed: int,
        energy: float = 1.0,
        stored: StoredArrays | None = None,
    ) -> None:
        self._target, self._image, self.rules = target, image, rules
        self._seed = seed
        count = stored.number("count", "iu", 1, _MAX_CHAINS) if stored else len(winners)
        self._large_step = dr.opaque(mi.Float, rules.large_step)
        self._uses_uniform = rules.large_step > 0 and rules.uniform_weight > 0
        self._uniform_weight = dr.opaque(mi.Float, rules.uniform_weight)
        self._energy = dr.opaque(mi.Float, energy)
        self.count, self.done = count, 0
        lane = dr.arange(mi.UInt32, count)
        streams = [CAMERA, LIGHT] if target.has_light_paths else [CAMERA]
        self._rngs = [generator(stream(seed, number), lane) for number in streams]
        # Not a literal, with which the first launch would need a separate kernel
        self._weight = dr.opaque(mi.Float, 0, count)
        if not stored:
            self._begin(bootstrap, winners)
            return
        self.done = stored.number("done", "iu", 1, 0xFFFFFFFF)
        for name, (kind, width) in self._state_kinds().items():
            setattr(self, name, value_of(stored, name, kind, width, self._ranges()))
        self._check(stored)

    @property
    def launch(self) -> int:
        """The mutations of each chain in a launch. Time limit and Ctrl-C are checked in between."""
        return max(_MIN_LAUNCH, _LAUNCH // self.count)

    def stored(self) -> Arrays:
        """The state of the chains between two launches."""
        parts = (arrays_of(getattr(self, name), name) for name in self._state_kinds())
        own = {"count": np.array(self.count), "done": np.array(self.done)}
        return {key: array for part in (own, *parts) for key, array in part.items()}

    def _state_kinds(self) -> dict[str, tuple[Any, int | None]]:
        """The attributes that form the state of all chains, with their types and lanes."""
        rngs = [mi.PCG32] * len(self._rngs)
        return {"_rngs": (rngs, self.count), "_weight": (mi.Float, self.count)}

    def _ranges(self) -> Ranges:
        """The minimum and the maximum value of each attribute, and of the fields of structures."""
        return {"target": (0, None), "_weight": (0, None)}

    def _check(self, stored: StoredArrays) -> None:
        """Checks the restored state beyond the range of each number.

        Raises:
            DamagedError: It is not a state.
        """
        for rng in self._rngs:
            stored.require(bool(dr.all(rng.inc & 1 == 1)), "an increment is even")

    def _begin(self, bootstrap: Bootstrap, winners: mi.UInt32) -> None:
        """Makes these samples the states of the chains."""
        raise NotImplementedError

    def advance(self, steps: int) -> MutationCounts:
        """Makes ``steps`` mutations of each chain."""
        raise NotImplementedError

    def _mutated(self, *arguments: Any) -> tuple:
        """The traced loop over the mutations of a launch."""
        raise NotImplementedError

    @frozen
    def _launched(self, *arguments: Any) -> tuple:
        return self._mutated(*arguments)

    def end(self) -> None:
        """Adds the current states to the image. The chains may continue afterwards."""
        raise NotImplementedError

    def _share(self, target: mi.Float) -> mi.Float:
        """The weight of a visit."""
        return dr.select(target > 0, self._energy / (target + self._uniform_weight), 0)


def acceptance(state: mi.Float, proposal: mi.Float) -> mi.Float:
    """The probability of accepting a proposal, from the target function's values; 1 if the state's
    is 0."""
    return dr.select(state > proposal, proposal / state, mi.Float(1))
