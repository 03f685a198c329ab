"""What all kinds of chains have in common."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .numbers import generator, stream
from .small_steps import SmallSteps
from .stored import Arrays, arrays_of, value_of
from .target import ImageTarget

#: Numbers of a state that a chain remembers, for the camera's end of its path and for the light's:
#: 20 bounces, about. A path that draws more draws those anew for each proposal, which is a large
#: step in them.
MOST_NUMBERS, MOST_LIGHT_NUMBERS = 128, 96

#: Mutations of all chains, about, between two looks at the clock (a second or two on two CPU cores:
#: states are read and written in between); and of each, at least.
_LAUNCH, _LEAST_LAUNCH = 1 << 21, 16

#: Streams of random numbers, which differ from those of the bootstrap.
CAMERA, LIGHT = 3, 4


@dataclass
class Counts:
    """What chains did, in each lane.

    Attributes:
        large, accepted_large, accepted_small: Large steps, and accepted steps of each kind.
        large_target: The sum of the target function over all proposals of large steps.
        scatter, shadow, connections: See :class:`~mitsuba_ext.transport.estimator.Sample`.
        black: Proposals that add nothing to the image.
        longest: Visits of one state, at most, that were added to the image at once.
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
    def none(cls, lanes: int) -> Counts:
        kinds = [mi.UInt32] * 3 + [mi.Float] + [mi.UInt32] * 4 + [mi.Float]
        return cls(*(dr.zeros(kind, lanes) for kind in kinds))

    def plus(self, is_large, is_accepted, target, sample, visits) -> Counts:
        """With one more proposal, in a state that had so many ``visits``."""
        return Counts(
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
    """How chains move.

    Attributes:
        large_step: The probability of a large step.
        steps: How numbers are moved by the others.
        uniform_weight: Uniform samples for each mutation · mean of the target function (about), by
            which they count in the balance heuristic; 0 if they are not used. Where the target
            function is what luminance is beyond a bound, the bound.
    """

    large_step: float
    steps: SmallSteps
    uniform_weight: float


class Chains:
    r"""Metropolis chains that sample vectors of numbers in proportion to a target function, one in
    each lane.

    With :math:`I` the target function, :math:`a` the probability of accepting a proposal
    :math:`v` of the state :math:`u`, the expected visits are added to the image: :math:`a` of
    them to the proposal, :math:`1 - a` to the state. Proposals of large steps are uniform samples
    besides, which the balance heuristic combines with the visits (Kelemen et al. 2002).

    A state is added to the image when the chain leaves it.

    Source: D. Cline, PhD thesis, 2007, sections 7.11 to 7.13; C. Kelemen et al., *A Simple and
    Robust Mutation Strategy for the Metropolis Light Transport Algorithm*, Eurographics 2002.

    Parameters:
        target: What is sampled.
        image: Where visits are added.
        rules: How chains move.
        bootstrap, winners: Samples, and at which of these each chain starts.
        seed: Of the random numbers.
        energy: By how much a visit counts.
        stored: From :meth:`stored` of chains with the same parameters, which these go on with;
            ``bootstrap`` and ``winners`` are then not needed.

    Attributes:
        rules: How they move.
        count: How many there are.
        done: Mutations of each.
    """

    #: What makes a state of all chains.
    _parts_of_state: tuple[str, ...]

    def __init__(
        self,
        target: ImageTarget,
        image: ChainImage,
        rules: ChainRules,
        bootstrap: Bootstrap | None,
        winners: mi.UInt32 | None,
        seed: int,
        energy: float = 1.0,
        stored: Arrays | None = None,
    ) -> None:
        self._target, self._image, self.rules = target, image, rules
        self._seed = seed
        count = int(stored["count"]) if stored else len(winners)
        self._large_step = dr.opaque(mi.Float, rules.large_step)
        self._uses_uniform = rules.large_step > 0 and rules.uniform_weight > 0
        self._uniform_weight = dr.opaque(mi.Float, rules.uniform_weight)
        self._energy = dr.opaque(mi.Float, energy)
        self.count, self.done = count, 0
        lane = dr.arange(mi.UInt32, count)
        streams = [CAMERA, LIGHT] if target.has_light_paths else [CAMERA]
        self._rngs = [generator(stream(seed, number), lane) for number in streams]
        # Not a literal: the first launch would need a kernel of its own
        self._weight = dr.opaque(mi.Float, 0, count)
        if not stored:
            self._begin(bootstrap, winners)
            return
        self.done = int(stored["done"])
        for name in self._parts_of_state:
            setattr(self, name, value_of(stored, name))

    @property
    def launch(self) -> int:
        """Mutations of each chain between two looks at the clock, and for Ctrl-C."""
        return max(_LEAST_LAUNCH, _LAUNCH // self.count)

    def stored(self) -> Arrays:
        """The chains as they are, between two launches."""
        parts = (arrays_of(getattr(self, name), name) for name in self._parts_of_state)
        own = {"count": np.array(self.count), "done": np.array(self.done)}
        return {key: array for part in (own, *parts) for key, array in part.items()}

    def _begin(self, bootstrap: Bootstrap, winners: mi.UInt32) -> None:
        """Makes these samples the states of the chains."""
        raise NotImplementedError

    def advance(self, steps: int) -> Counts:
        """Makes ``steps`` mutations of each chain."""
        raise NotImplementedError

    def end(self) -> None:
        """Adds the states to the image. The chains may go on."""
        raise NotImplementedError

    def _share(self, target: mi.Float) -> mi.Float:
        """The weight of a visit."""
        return dr.select(target > 0, self._energy / (target + self._uniform_weight), 0)


def acceptance(state: mi.Float, proposal: mi.Float) -> mi.Float:
    """The probability of accepting a proposal, by the values of the target function. Whatever is
    proposed is better than a state that adds nothing to the image."""
    return dr.select(state > proposal, proposal / state, mi.Float(1))
