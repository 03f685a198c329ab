"""Chains in path space."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.frozen import frozen
from ...transport.numbers import Numbers, copied
from .chains import Chains, MutationCounts
from .numbers import ProposedNumbers, StateNumbers, stream
from .path_space.memory import Head, Logs, PathMemory, Place, stride
from .path_space.mutations import NEW_PATH
from .path_target import ChainPath

#: Streams of random numbers shared by all chains: for the kinds of mutations, and for film
#: positions.
_KIND, _FILM = 6, 7


class PathChains(Chains):
    """Chains of paths. All mutations of a launch are one traced loop. In each step, all chains make
    the same kind of mutation if their paths allow it, so that neighbouring lanes execute the same
    code. See :class:`Chains`."""

    def _begin(self, bootstrap, winners):
        self._state, self._places, self._logs = self._first(bootstrap.numbers(winners))
        dr.eval(self._state, self._places, self._logs)

    @frozen
    def _first(self, numbers: Numbers) -> tuple[ChainPath, Place, Logs]:
        """The paths at which chains start, and their vertices."""
        memory, at = PathMemory.of(self._target.most), dr.zeros(mi.UInt32, self.count)
        memory, _numbers, proposal = self._target.mutations.new_path(
            memory, at, copied(numbers), mi.Bool(True)
        )
        state = self._as_state(proposal)
        return state, *self._stored(memory, state.head)

    def kernel_state(self) -> tuple:
        """The objects and constants on which kernels depend, without the states."""
        return (
            self._target, self._image, self.rules.large_step > 0, self.rules.steps, self.count,
            self._large_step, self._uses_uniform, self._uniform_weight, self._energy,
        )  # fmt: skip

    def _state_kinds(self):
        vertices = self.count * stride(self._target.most)
        own = {"_state": (ChainPath, self.count), "_places": (Place, vertices)}
        return {**super()._state_kinds(), **own, "_logs": (Logs, vertices)}

    def _ranges(self):
        # Kernels accept any real numbers of vertices; the integers select places in memory
        most, anything = self._target.most, (-np.inf, np.inf)
        return {
            **super()._ranges(),
            **dict.fromkeys([*vars(dr.zeros(Logs)), "p", "d", "density"], anything),
            "at": (0, stride(most)), "length": (1, most), "film": (0, 1), "aperture": (0, 1),
            "time": (0, 1), "wavelength": (0, 1), "lobe": (0, 1), "is_discrete": (0, 1),
            "emitter": (0, max(0, len(self._target.scene.emitters()) - 1)),
        }  # fmt: skip

    def _check(self, stored):
        super()._check(stored)
        at = self._state.head.at
        is_place = bool(dr.all((at == 0) | (at == stride(self._target.most))))
        stored.require(is_place, "a path begins elsewhere")

    def _as_state(self, proposal) -> ChainPath:
        return ChainPath(proposal.head, self._target.contribution(proposal), proposal.log_density)

    def advance(self, steps):
        seeds = [dr.opaque(mi.UInt32, stream(self._seed, n)) for n in (_KIND, _FILM)]
        before = self._rngs[0], self._state, self._weight, self._places, self._logs
        rng, *after, counts = self._launched(
            dr.opaque(mi.UInt32, steps), dr.opaque(mi.UInt32, self.done), seeds, *before
        )
        dr.eval(rng, after, counts, self._image.tensors())
        self._rngs, (self._state, self._weight, self._places, self._logs) = [rng], after
        self.done += steps
        return counts

    @dr.syntax
    def _mutated(
        self,
        steps: mi.UInt32,
        done: mi.UInt32,
        seeds: list[mi.UInt32],
        rng: mi.PCG32,
        state: ChainPath,
        weight: mi.Float,
        places: Place,
        logs: Logs,
    ) -> tuple[mi.PCG32, ChainPath, mi.Float, Place, Logs, MutationCounts]:
        """Makes ``steps`` mutations of each chain, which has already made ``done`` mutations."""
        mutations = self._target.mutations
        none, lane = dr.zeros(mi.UInt32, self.count), dr.arange(mi.UInt32, self.count)
        rng, weight = mi.PCG32(rng), mi.Float(weight)
        counts = MutationCounts.none(self.count)
        memory = self._loaded(state.head, places, logs)
        unused = StateNumbers(self.rules.steps)
        step = mi.UInt32(none)
        while step < steps:
            # ----- Propose -----
            which = mi.sample_tea_float32(seeds[0], done + step)
            kind = mutations.kind(which, self._large_step)
            place = mutations.place(lane, seeds[1], done + step)
            threshold = rng.next_float32()
            numbers = ProposedNumbers(rng, mi.UInt32(none), mi.UInt32(none), unused)
            memory, numbers, proposal = mutations.mutate(
                memory, state.head, state.density, kind, place, numbers
            )
            rng = numbers.rng
            new = self._as_state(proposal)

            # ----- Accept or reject -----
            # Target functions are divided by the density as a new path, which is reversed here
            change = new.density - state.density + proposal.log_ratio
            ratio = new.found.target / state.found.target * dr.exp(change)
            ratio = dr.select(dr.isfinite(ratio), ratio, 0)
            a = dr.select(new.found.target > 0, dr.minimum(ratio, 1), 0)
            a = dr.select(state.found.target > 0, a, 1)
            is_accepted = threshold < a
            is_large = kind == NEW_PATH
            counts = counts.plus(
                is_large, is_accepted, new.found.target, self._target.sample(proposal), weight
            )

            # ----- Add the old state or the rejected proposal to the image -----
            left = dr.select(is_accepted, state.found, new.found)
            visits = dr.select(is_accepted, weight + (1 - a), a)
            self._image.add(left, visits * self._share(left.target))
            if dr.hint(self._uses_uniform, mode="scalar"):
                share = self._share(new.found.target)
                self._image.add_uniform(new.found, dr.select(is_large, share, 0))
            weight = dr.select(is_accepted, a, weight + (1 - a))
            # The vertices are not moved: ``head.at`` says which path is the state
            state = dr.select(is_accepted, new, state)
            step += 1

        places, logs = self._stored(memory, state.head)
        return rng, state, weight, places, logs, counts

    # ---- Vertices between launches ----

    @dr.syntax
    def _loaded(self, head: Head, places: Place, logs: Logs) -> PathMemory:
        memory = PathMemory.of(self._target.most)
        lane, count = dr.arange(mi.UInt32, self.count), dr.opaque(mi.UInt32, self.count)
        index = dr.zeros(mi.UInt32, self.count)
        while index <= head.length:
            where = index * count + lane
            memory.places[head.at + index] = dr.gather(Place, places, where)
            memory.logs[head.at + index] = dr.gather(Logs, logs, where)
            index += 1
        return memory

    @dr.syntax
    def _stored(self, memory: PathMemory, head: Head) -> tuple[Place, Logs]:
        size = self.count * stride(self._target.most)
        places, logs = dr.zeros(Place, size), dr.zeros(Logs, size)
        lane, count = dr.arange(mi.UInt32, self.count), dr.opaque(mi.UInt32, self.count)
        index = dr.zeros(mi.UInt32, self.count)
        while index <= head.length:
            where = index * count + lane
            dr.scatter(places, memory.places[head.at + index], where)
            dr.scatter(logs, memory.logs[head.at + index], where)
            index += 1
        return places, logs

    def end(self):
        self._image.add(self._state.found, self._weight * self._share(self._state.found.target))
        self._weight = dr.opaque(mi.Float, 0, self.count)
        dr.eval(self._image.tensors(), self._weight)
