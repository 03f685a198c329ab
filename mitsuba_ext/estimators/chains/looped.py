"""Chains in primary sample space, for an estimator that is a single kernel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .chains import MAX_NUMBERS, Chains, MutationCounts, acceptance
from .numbers import LocalNumbers, ProposedNumbers, RecordedNumbers
from .target import Contribution


class LoopedChains(Chains):
    """All mutations of a launch are one traced loop around the estimator, whose samples must each
    contribute to only one film position (no splats). See :class:`Chains`."""

    def _begin(self, bootstrap, winners):
        record = RecordedNumbers(
            dr.zeros(mi.Float, MAX_NUMBERS * self.count), self.count, self.rules.steps
        )
        numbers = bootstrap.numbers(winners, [record, record])
        self._state, _sample = self._target(numbers)
        self._known = dr.minimum(numbers.index, MAX_NUMBERS)
        self._values = record.written
        self._earlier = dr.opaque(mi.Float, 0, self.count)
        # Evaluated now so that the first launch has the same kernel as the others
        dr.eval(self._state, self._known, self._values, self._rngs)

    def _state_kinds(self):
        numbers, count = MAX_NUMBERS * self.count, self.count
        own = {"_state": (Contribution, count), "_known": (mi.UInt32, count)}
        others = {"_values": (mi.Float, numbers), "_earlier": (mi.Float, count)}
        return {**super()._state_kinds(), **own, **others}

    def _ranges(self):
        own = {"_known": (0, MAX_NUMBERS), "_values": (0, 1), "_earlier": (0, None)}
        return {**super()._ranges(), **own}

    def kernel_state(self) -> tuple:
        """The objects and constants on which kernels depend, without the states."""
        return (
            self._target, self._image, self.rules.steps, self.count, self._large_step,
            self._uses_uniform, self._uniform_weight, self._energy,
        )  # fmt: skip

    def advance(self, steps):
        before = self._rngs[0], self._state, self._known, self._weight, self._earlier, self._values
        rng, *after, counts = self._launched(dr.opaque(mi.UInt32, steps), *before)
        dr.eval(rng, after, self._values, counts, self._image.tensors())
        self._rngs, (self._state, self._known, self._weight, self._earlier) = [rng], after
        self.done += steps
        return counts

    @dr.syntax
    def _mutated(
        self,
        steps: mi.UInt32,
        rng: mi.PCG32,
        state: Contribution,
        known: mi.UInt32,
        weight: mi.Float,
        earlier: mi.Float,
        values: mi.Float,
    ) -> tuple[mi.PCG32, Contribution, mi.UInt32, mi.Float, mi.Float, MutationCounts]:
        """Makes ``steps`` mutations of each chain. Overwrites ``values``, the states' numbers."""
        count, none = dr.opaque(mi.UInt32, self.count), dr.zeros(mi.UInt32, self.count)
        lane = dr.arange(mi.UInt32, self.count)
        rng, known = mi.PCG32(rng), mi.UInt32(known)
        weight, earlier = mi.Float(weight), mi.Float(earlier)
        counts = MutationCounts.none(self.count)
        vector = dr.alloc_local(mi.Float, MAX_NUMBERS, value=dr.zeros(mi.Float))
        index = mi.UInt32(none)
        while index < known:
            vector[index] = dr.gather(mi.Float, values, index * count + lane)
            index += 1

        step = mi.UInt32(none)
        while step < steps:
            # ----- Propose -----
            is_large = rng.next_float32() < self._large_step
            threshold = rng.next_float32()
            moved = dr.select(is_large, 0, known)
            before = mi.PCG32(rng)
            numbers_now = LocalNumbers(vector, self.rules.steps)
            numbers = ProposedNumbers(rng, mi.UInt32(none), moved, numbers_now)
            proposal, sample = self._target(numbers)
            rng = numbers.rng

            # ----- Accept or reject -----
            a = acceptance(state.target, proposal.target)
            is_accepted = threshold < a
            counts = counts.plus(is_large, is_accepted, proposal.target, sample, weight)

            # ----- Add the old state or the rejected proposal to the image -----
            left = dr.select(is_accepted, state, proposal)
            weight += 1 - a
            visits, earlier = self._added(state, proposal, is_accepted, weight, a, earlier)
            self._image.add(left, visits * self._share(left.target))
            if dr.hint(self._uses_uniform, mode="scalar"):
                share = self._share(proposal.target)
                self._image.add_uniform(proposal, dr.select(is_large, share, 0))
            weight = dr.select(is_accepted, a, weight)
            state = dr.select(is_accepted, proposal, state)

            # ----- Store the numbers of the new state, by drawing them a second time -----
            again = ProposedNumbers(before, mi.UInt32(none), moved, numbers_now)
            drawn = dr.minimum(numbers.index, MAX_NUMBERS)
            index = dr.select(is_accepted, mi.UInt32(0), drawn)
            while index < drawn:
                vector[index] = again.next_1d()
                index += 1
            known = dr.select(is_accepted, drawn, known)
            step += 1

        index = mi.UInt32(none)
        while index < known:
            dr.scatter(values, vector[index], index * count + lane)
            index += 1
        return rng, state, known, weight, earlier, counts

    def _added(
        self, state: Contribution, proposal: Contribution, is_accepted: mi.Bool,
        weight: mi.Float, a: mi.Float, earlier: mi.Float,
    ) -> tuple[mi.Float, mi.Float]:  # fmt: skip
        """The number of visits to add to the image now (``weight`` for a state that the chain
        leaves, ``a`` for a rejected proposal), and the new ``earlier``, in which subclasses count
        visits of earlier states."""
        return dr.select(is_accepted, weight, a), earlier

    def _last(self) -> mi.Float:
        """The number of visits of the last state to add."""
        return self._weight

    def end(self):
        self._image.add(self._state, self._last() * self._share(self._state.target))
        self._weight = dr.opaque(mi.Float, 0, self.count)
        dr.eval(self._image.tensors(), self._weight)
