"""Metropolis chains of primary samples, one in each lane."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .numbers import NumberVector, ProposedNumbers, StratifiedNumbers, generator
from .small_steps import SmallSteps
from .target import Contribution, ImageTarget

#: Mutations of each chain between two looks at the clock, and for Ctrl-C.
LAUNCH = 16

#: Numbers of a state that a chain remembers: 20 bounces, about. A path that draws more draws those
#: anew for each proposal, which is a large step in them.
_MOST_NUMBERS = 128

#: So many streams of random numbers, which must differ, does a render need.
BOOTSTRAP_STREAM, CHAIN_STREAM = 0, 1


@dataclass
class Counts:
    """What chains did, in each lane.

    Attributes:
        large, accepted_large, accepted_small: Large steps, and accepted steps of each kind.
        large_target: The sum of the target function over all proposals of large steps.
        scatter, shadow, connections, black: See :class:`~mitsuba_ext.transport.estimator.Sample`;
            proposals that are black.
    """

    large: mi.UInt32
    accepted_large: mi.UInt32
    accepted_small: mi.UInt32
    large_target: mi.Float
    scatter: mi.UInt32
    shadow: mi.UInt32
    connections: mi.UInt32
    black: mi.UInt32


class Chains:
    r"""Chains that sample vectors of numbers in proportion to a target function.

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
        large_step: The probability of a large step.
        steps: How numbers are moved by the others.
        uniform_weight: Large step probability · mean of the target function, by which uniform
            samples count in the balance heuristic; 0 if they are not used.
    """

    def __init__(
        self,
        target: ImageTarget,
        image: ChainImage,
        large_step: float,
        steps: SmallSteps,
        uniform_weight: float,
    ) -> None:
        self._target, self._image, self._steps = target, image, steps
        self._large_step = dr.opaque(mi.Float, large_step)
        self._uses_uniform = uniform_weight > 0
        self._uniform_weight = dr.opaque(mi.Float, uniform_weight)
        self.done = 0

    def begin(self, bootstrap: Bootstrap, seed: int, count: int) -> None:
        """Starts ``count`` chains at samples of the bootstrap."""
        self.count = count
        self._values = dr.zeros(mi.Float, _MOST_NUMBERS * count)
        winners = bootstrap.choose(count)
        self._state, self._known = self._replay(bootstrap.numbers(winners))
        # Not a literal: the first launch would need a kernel of its own
        self._weight = dr.opaque(mi.Float, 0, count)
        self._rng = generator(mi.sample_tea_32(mi.UInt32(seed), CHAIN_STREAM)[0][0],
                              dr.arange(mi.UInt32, count))
        dr.eval(self._state, self._known, self._weight, self._rng, self._values)

    @dr.syntax
    def _replay(self, numbers: StratifiedNumbers) -> tuple[Contribution, mi.UInt32]:
        """The state that these numbers stand for, which it stores."""
        again = StratifiedNumbers(
            mi.PCG32(numbers.rng), mi.UInt32(numbers.index), numbers.corner, numbers.cells
        )
        found, _sample = self._target(numbers)
        known = dr.minimum(numbers.index, _MOST_NUMBERS)
        lane = dr.arange(mi.UInt32, self.count)
        index = dr.zeros(mi.UInt32, self.count)
        while index < known:
            dr.scatter(self._values, again.next_1d(), index * self.count + lane)
            index += 1
        return found, known

    def advance(self, steps: int) -> Counts:
        """Makes ``steps`` mutations of each chain, in one kernel."""
        counts = self._advance(dr.opaque(mi.UInt32, steps))
        dr.eval(
            self._state, self._known, self._weight, self._rng, self._values, counts,
            self._image.tensors(),
        )  # fmt: skip
        self.done += steps
        return counts

    @dr.syntax
    def _advance(self, steps: mi.UInt32) -> Counts:
        count = dr.opaque(mi.UInt32, self.count)
        lane = dr.arange(mi.UInt32, self.count)
        rng, state = mi.PCG32(self._rng), self._state
        known, weight = mi.UInt32(self._known), mi.Float(self._weight)
        counts = Counts(*(dr.zeros(t, self.count) for t in (
            mi.UInt32, mi.UInt32, mi.UInt32, mi.Float, mi.UInt32, mi.UInt32, mi.UInt32, mi.UInt32,
        )))  # fmt: skip
        vector = dr.alloc_local(mi.Float, _MOST_NUMBERS, value=dr.zeros(mi.Float))
        index = dr.zeros(mi.UInt32, self.count)
        while index < known:
            vector[index] = dr.gather(mi.Float, self._values, index * count + lane)
            index += 1

        step = dr.zeros(mi.UInt32, self.count)
        while step < steps:
            # ----- Propose -----
            is_large = rng.next_float32() < self._large_step
            threshold = rng.next_float32()
            moved = dr.select(is_large, 0, known)
            before = mi.PCG32(rng)
            vector_now = NumberVector(vector, self._steps)
            numbers = ProposedNumbers(rng, dr.zeros(mi.UInt32, self.count), moved, vector_now)
            proposal, sample = self._target(numbers)
            rng = numbers.rng

            # ----- Accept or reject -----
            # Whatever is proposed is better than a state that has nothing to add
            a = dr.select(
                state.target > proposal.target, proposal.target / state.target, mi.Float(1)
            )
            is_accepted = threshold < a

            # ----- Add what is left behind to the image -----
            left = dr.select(is_accepted, state, proposal)
            visits = dr.select(is_accepted, weight + (1 - a), a)
            self._image.add(left, visits * self._share(left))
            weight = dr.select(is_accepted, a, weight + (1 - a))
            if dr.hint(self._uses_uniform, mode="scalar"):
                self._image.add_uniform(proposal, dr.select(is_large, self._share(proposal), 0))
            state = dr.select(is_accepted, proposal, state)

            # ----- Remember the numbers of the new state: the same again -----
            again = ProposedNumbers(before, dr.zeros(mi.UInt32, self.count), moved, vector_now)
            drawn = dr.minimum(numbers.index, _MOST_NUMBERS)
            index = dr.select(is_accepted, mi.UInt32(0), drawn)
            while index < drawn:
                vector[index] = again.next_1d()
                index += 1
            known = dr.select(is_accepted, drawn, known)

            counts = Counts(
                counts.large + dr.select(is_large, 1, 0),
                counts.accepted_large + dr.select(is_large & is_accepted, 1, 0),
                counts.accepted_small + dr.select(~is_large & is_accepted, 1, 0),
                counts.large_target + dr.select(is_large, proposal.target, 0),
                counts.scatter + sample.scatter_count,
                counts.shadow + sample.shadow_count,
                counts.connections + sample.connection_count,
                counts.black + dr.select(proposal.target > 0, 0, 1),
            )
            step += 1

        index = dr.zeros(mi.UInt32, self.count)
        while index < known:
            dr.scatter(self._values, vector[index], index * count + lane)
            index += 1
        self._rng, self._state, self._known, self._weight = rng, state, known, weight
        return counts

    def _share(self, found: Contribution) -> mi.Float:
        """The weight of a visit."""
        return dr.select(found.target > 0, dr.rcp(found.target + self._uniform_weight), 0)

    def end(self) -> None:
        """Adds the states of all chains to the image. They may go on."""
        self._image.add(self._state, self._weight * self._share(self._state))
        self._weight = dr.opaque(mi.Float, 0, self.count)
        dr.eval(self._image.tensors(), self._weight)
