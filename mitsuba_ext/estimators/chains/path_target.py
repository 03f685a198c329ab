"""The target function of chains in path space."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.estimator import Sample
from ...transport.frozen import frozen
from ...transport.numbers import Numbers, copied, go_to, reached
from .numbers import ProposedNumbers, StateNumbers, generator, stream
from .path_space.memory import Head, PathMemory
from .path_space.mutations import Mutations, Proposal
from .small_steps import SmallSteps
from .target import Contribution, Found, PlaceWeights, beyond_bound

#: The number of rounds that learn the techniques of new paths, and of paths per round.
_ROUNDS, _PATHS = 3, 1 << 15


@dataclass
class ChainPath:
    """The state of a chain of paths, without its vertices.

    Attributes:
        head: The path.
        found: Its contribution to the image as a new path.
        density: The logarithm of its density as a new path.
    """

    head: Head
    found: Contribution
    density: mi.Float


@dataclass
class PathTarget:
    """The target function of paths. A vector of random numbers makes a new path, whose contribution
    to the image is divided by its density.

    Parameters:
        mutations: The mutations, which make the paths of the scene.
        weights: Weights of film positions; ``None`` if all have the same weight.
        bound: A bound on the luminance; the target function is the part beyond it.
    """

    mutations: Mutations
    weights: PlaceWeights | None = None
    bound: float = 0.0

    #: Paths draw their numbers from a single stream, and each contributes to one film position.
    has_light_paths = False

    @property
    def scene(self) -> mi.Scene:
        return self.mutations.space.scene

    @property
    def sensor(self) -> mi.Sensor:
        return self.mutations.space.sensor

    @property
    def most(self) -> int:
        """The maximum number of vertices of a path."""
        return self.mutations.space.most

    def evaluate(self, numbers: Numbers, active: mi.Bool | bool = True) -> Found:
        """The contributions of new paths. Evaluates them and the state of ``numbers``."""
        brought, target, sample, place = self._evaluated(numbers, mi.Bool(active))
        go_to(numbers, place)
        lane = dr.arange(mi.UInt32, dr.width(target))
        dr.eval(brought, target, lane, sample, numbers)
        return Found(target, [brought], [lane], sample)

    @frozen
    def _evaluated(
        self, numbers: Numbers, active: mi.Bool
    ) -> tuple[Contribution, mi.Float, Sample, Numbers]:
        """A new path's contribution, with its luminance; the target function; ``numbers``."""
        proposal, numbers = self._new_path(copied(numbers), active)
        brought = self._brought(proposal)
        target = beyond_bound(brought.target, self.bound)
        return brought, target, self.sample(proposal), reached(numbers)

    def learn(self, seed: int) -> None:
        """Learns the probabilities of the techniques that make new paths, from separate paths."""
        unused = StateNumbers(SmallSteps())
        for round in range(_ROUNDS):
            lane = dr.arange(mi.UInt32, _PATHS)
            rng, none = generator(stream(seed, round), lane), dr.zeros(mi.UInt32, _PATHS)
            numbers = ProposedNumbers(rng, mi.UInt32(none), none, unused)
            technique, target = self._tried(numbers)
            dr.eval(target, technique)
            self.mutations.techniques.learn(technique.numpy(), target.numpy())

    @frozen
    def _tried(self, numbers: Numbers) -> tuple[mi.UInt32, mi.Float]:
        """The technique and the target function of new paths."""
        proposal, _numbers = self._new_path(copied(numbers), mi.Bool(True))
        return proposal.technique, self.contribution(proposal).target

    def _new_path(self, numbers: Numbers, active: mi.Bool) -> tuple[Proposal, Numbers]:
        memory, at = PathMemory.of(self.most), mi.UInt32(0)
        _memory, numbers, proposal = self.mutations.new_path(memory, at, numbers, active)
        return proposal, numbers

    def contribution(self, proposal: Proposal) -> Contribution:
        """The contribution of a path as a new path, with the target function."""
        brought = self._brought(proposal)
        brought.target = beyond_bound(brought.target, self.bound)
        return brought

    def _brought(self, proposal: Proposal) -> Contribution:
        """Like :meth:`contribution`, but with the luminance, including the part within the
        bound."""
        found = proposal.found
        factor = dr.exp(found.log_geometry - proposal.log_density)
        value = dr.select(found.active, found.value * factor, 0)
        is_sound = dr.all(dr.isfinite(value))
        value = dr.select(is_sound, value, 0)
        # The absolute values, because components can be negative in spectral variants
        target = mi.luminance(dr.abs(value))
        if self.weights is not None:
            target *= self.weights.at(found.position)
        return Contribution(found.position, value, target)

    def sample(self, proposal: Proposal) -> Sample:
        """A sample that counts the rays of a proposal."""
        found = proposal.found
        return Sample(
            mi.Spectrum(0), found.active, found.scatter, found.shadow, mi.UInt32(0)
        )
