"""Chains in primary sample space, for any estimator."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.numbers import BothEnds, Numbers
from ...util.arrays import joined
from .chains import MAX_LIGHT_NUMBERS, MAX_NUMBERS, Chains, MutationCounts, acceptance
from .numbers import ProposedNumbers, RecordedNumbers
from .target import Contribution


class SteppedChains(Chains):
    """Each mutation is a call of the estimator, which may consist of several kernels and contribute
    to any number of film positions. See :class:`Chains`."""

    launch = 1

    #: The maximum number of random numbers stored for each end of a path.
    _most = (MAX_NUMBERS, MAX_LIGHT_NUMBERS)

    def _begin(self, bootstrap, winners):
        empty = [dr.opaque(mi.Float, 0, most * self.count) for most in self._most]
        records = self._records(empty)
        numbers = bootstrap.numbers(winners, records)
        found = self._target.evaluate(numbers)
        ends = _ends(numbers)
        self._values = [record.written for record, _ in zip(records, ends)]
        self._known = [dr.minimum(end.index, most) for end, most in zip(ends, self._most)]
        self._state = found.target
        self._parts, self._lanes = _wanted(found.parts, found.lanes, self._everywhere())
        dr.eval(self._values, self._known, self._state)

    def _state_kinds(self):
        return {
            **super()._state_kinds(),
            "_state": (mi.Float, self.count),
            "_known": ([mi.UInt32] * len(self._rngs), self.count),
            "_values": ([mi.Float] * len(self._rngs), None),
            "_parts": (Contribution, None),
            "_lanes": (mi.UInt32, None),
        }

    def _ranges(self):
        own = {"_state": (0, None), "_lanes": (0, self.count - 1)}
        known = {f"_known/{end}": (0, most) for end, most in enumerate(self._most)}
        values = {f"_values/{end}": (0, 1) for end in range(len(self._most))}
        return {**super()._ranges(), **own, **known, **values}

    def _check(self, stored):
        super()._check(stored)
        for values, most in zip(self._values, self._most):
            stored.require(len(values) == most * self.count, f"{len(values)} numbers of states")
        lanes, parts = len(self._lanes), dr.width(self._parts)
        stored.require(lanes == parts > 0, f"{parts} contributions, and {lanes} lanes")

    def advance(self, steps):
        counts = MutationCounts.none(self.count)
        for _ in range(steps):
            counts = self._mutate(counts)
        self.done += steps
        return counts

    def _mutate(self, counts: MutationCounts) -> MutationCounts:
        # ----- Propose -----
        camera_rng = self._rngs[0]
        is_large = camera_rng.next_float32() < self._large_step
        threshold = camera_rng.next_float32()
        records = self._records(self._values)
        none = dr.zeros(mi.UInt32, self.count)
        ends = [
            ProposedNumbers(rng, mi.UInt32(none), dr.select(is_large, 0, known), record)
            for rng, known, record in zip(self._rngs, self._known, records)
        ]
        # Evaluated now: they are used after the estimator, whose kernels would compute them again
        dr.eval(is_large, threshold, ends)
        found = self._target.evaluate(BothEnds(*ends) if len(ends) == 2 else ends[0])
        self._rngs = [end.rng for end in ends]

        # ----- Accept or reject -----
        a = acceptance(self._state, found.target)
        is_accepted = threshold < a
        counts = counts.plus(is_large, is_accepted, found.target, found.sample, self._weight)

        # ----- Add the old state or the rejected proposal to the image -----
        visits = self._weight + (1 - a)
        left = dr.select(is_accepted, visits * self._share(self._state), 0)
        rejected = dr.select(is_accepted, 0, a * self._share(found.target))
        uniform = dr.select(is_large, self._share(found.target), 0)
        dr.eval(is_accepted, left, rejected, uniform)
        self._add(self._parts, self._lanes, left)
        for part, lanes in zip(found.parts, found.lanes):
            self._add(part, lanes, rejected, uniform if self._uses_uniform else None)

        # ----- Remember the new state -----
        self._weight = dr.select(is_accepted, a, visits)
        self._state = dr.select(is_accepted, found.target, self._state)
        drawn = [dr.minimum(end.index, most) for end, most in zip(ends, self._most)]
        self._known = [dr.select(is_accepted, n, known) for n, known in zip(drawn, self._known)]
        self._remember([record.written for record in records], is_accepted)
        dr.eval(
            counts, self._weight, self._state, self._known, self._values, self._image.tensors()
        )  # fmt: skip
        self._parts, self._lanes = _wanted(
            [self._parts, *found.parts], [self._lanes, *found.lanes],
            [~is_accepted, *[is_accepted] * len(found.parts)],
        )  # fmt: skip
        return counts

    def _remember(self, written: list[mi.Float], is_accepted: mi.Bool) -> None:
        """Copies the numbers of accepted proposals to the states. Works in place because the
        numbers of all states take hundreds of megabytes."""
        dr.eval(written)
        accepted = dr.compress(is_accepted)
        if len(accepted) == 0:
            return
        width, count = (dr.opaque(mi.UInt32, n) for n in (len(accepted), self.count))
        for source, values, most in zip(written, self._values, self._most):
            entry = dr.arange(mi.UInt32, most * len(accepted))
            place = entry // width * count + dr.gather(mi.UInt32, accepted, entry % width)
            dr.scatter(values, dr.gather(mi.Float, source, place), place)

    def _records(self, values: list[mi.Float]) -> list[RecordedNumbers]:
        return [RecordedNumbers(v, self.count, self.rules.steps) for v in values]

    def _everywhere(self) -> list[mi.Bool]:
        return [dr.full(mi.Bool, True, self.count)] * 2

    def _add(self, part, lanes, weight, uniform=None) -> None:
        """Adds contributions with the weights of their lanes."""
        active = part.target > 0
        self._image.add(part, dr.gather(mi.Float, weight, lanes, active))
        if uniform is not None:
            self._image.add_uniform(part, dr.gather(mi.Float, uniform, lanes, active))

    def end(self):
        self._add(self._parts, self._lanes, self._weight * self._share(self._state))
        self._weight = dr.opaque(mi.Float, 0, self.count)
        dr.eval(self._image.tensors(), self._weight)


def _ends(numbers: Numbers) -> list[Any]:
    return [numbers.camera, numbers.light] if isinstance(numbers, BothEnds) else [numbers]


def _wanted(
    parts: list[Contribution], lanes: list[mi.UInt32], wanted: list[mi.Bool]
) -> tuple[Contribution, mi.UInt32]:
    """The contributions of lanes with ``wanted`` set, in one array, and these lanes."""
    kept = []
    for part, lane, want in zip(parts, lanes, wanted):
        index = dr.compress((part.target > 0) & dr.gather(mi.Bool, want, lane))
        if len(index) > 0:
            kept.append((dr.gather(Contribution, part, index), dr.gather(mi.UInt32, lane, index)))
    if not kept:
        kept.append((dr.zeros(Contribution), dr.zeros(mi.UInt32)))
    return joined([part for part, _ in kept]), joined([lane for _, lane in kept])
