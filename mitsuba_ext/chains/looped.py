"""Chains around an estimator that is one kernel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .chains import MOST_NUMBERS, Chains, Counts, acceptance
from .numbers import LocalNumbers, ProposedNumbers, RecordedNumbers
from .target import Contribution


class LoopedChains(Chains):
    """All mutations of a launch are one traced loop around the estimator. What it finds has one
    place on the film: no splats. See :class:`Chains`."""

    _parts_of_state = ("_rngs", "_state", "_known", "_values", "_weight", "_earlier")

    def _begin(self, bootstrap, winners):
        record = RecordedNumbers(
            dr.zeros(mi.Float, MOST_NUMBERS * self.count), self.count, self.rules.steps
        )
        numbers = bootstrap.numbers(winners, [record, record])
        self._state, _sample = self._target(numbers)
        self._known = dr.minimum(numbers.index, MOST_NUMBERS)
        self._values = record.written
        self._earlier = dr.opaque(mi.Float, 0, self.count)
        # Evaluated now, the first launch has the kernel of the others
        dr.eval(self._state, self._known, self._values, self._rngs)

    def advance(self, steps):
        counts = self._advance(dr.opaque(mi.UInt32, steps))
        dr.eval(
            self._state, self._known, self._weight, self._earlier, self._rngs, self._values,
            counts, self._image.tensors(),
        )  # fmt: skip
        self.done += steps
        return counts

    @dr.syntax
    def _advance(self, steps: mi.UInt32) -> Counts:
        count, none = dr.opaque(mi.UInt32, self.count), dr.zeros(mi.UInt32, self.count)
        lane = dr.arange(mi.UInt32, self.count)
        rng, state = mi.PCG32(self._rngs[0]), self._state
        known, weight = mi.UInt32(self._known), mi.Float(self._weight)
        earlier = mi.Float(self._earlier)
        counts = Counts.none(self.count)
        vector = dr.alloc_local(mi.Float, MOST_NUMBERS, value=dr.zeros(mi.Float))
        index = mi.UInt32(none)
        while index < known:
            vector[index] = dr.gather(mi.Float, self._values, index * count + lane)
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
            counts = counts.plus(is_large, is_accepted, proposal.target, sample)

            # ----- Add what is left behind to the image -----
            left = dr.select(is_accepted, state, proposal)
            weight += 1 - a
            visits, earlier = self._added(state, proposal, is_accepted, weight, a, earlier)
            self._image.add(left, visits * self._share(left.target))
            if dr.hint(self._uses_uniform, mode="scalar"):
                share = self._share(proposal.target)
                self._image.add_uniform(proposal, dr.select(is_large, share, 0))
            weight = dr.select(is_accepted, a, weight)
            state = dr.select(is_accepted, proposal, state)

            # ----- Remember the numbers of the new state: the same again -----
            again = ProposedNumbers(before, mi.UInt32(none), moved, numbers_now)
            drawn = dr.minimum(numbers.index, MOST_NUMBERS)
            index = dr.select(is_accepted, mi.UInt32(0), drawn)
            while index < drawn:
                vector[index] = again.next_1d()
                index += 1
            known = dr.select(is_accepted, drawn, known)
            step += 1

        index = mi.UInt32(none)
        while index < known:
            dr.scatter(self._values, vector[index], index * count + lane)
            index += 1
        self._rngs, self._state, self._known, self._weight = [rng], state, known, weight
        self._earlier = earlier
        return counts

    def _added(
        self, state: Contribution, proposal: Contribution, is_accepted: mi.Bool,
        weight: mi.Float, a: mi.Float, earlier: mi.Float,
    ) -> tuple[mi.Float, mi.Float]:  # fmt: skip
        """How many visits are added to the image now: ``weight`` of a state that is left, or
        ``a`` of a proposal. ``earlier`` is
        for chains that remember visits of earlier states."""
        return dr.select(is_accepted, weight, a), earlier

    def _last(self) -> mi.Float:
        """How many visits of the last state are added."""
        return self._weight

    def end(self):
        self._image.add(self._state, self._last() * self._share(self._state.target))
        self._weight = dr.opaque(mi.Float, 0, self.count)
        dr.eval(self._image.tensors(), self._weight)
