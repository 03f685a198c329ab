"""Light paths as what chains sample."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..path_space.memory import PathMemory
from ..path_space.mutations import Mutations, Proposal
from ..transport.estimator import Sample
from ..transport.numbers import Numbers
from .target import Contribution, Found, PlaceWeights


@dataclass
class PathTarget:
    """Makes one path of a vector of numbers, and estimates the image by it.

    Parameters:
        mutations: Of the paths of the scene.
        weights: Of places on the film; ``None`` where all count the same.
    """

    mutations: Mutations
    weights: PlaceWeights | None = None

    #: Paths draw their numbers from one stream, and each has one place on the film.
    has_light_paths = False

    @property
    def sensor(self) -> mi.Sensor:
        return self.mutations.space.sensor

    @property
    def most(self) -> int:
        """Vertices of a path, at most."""
        return self.mutations.space.most

    def evaluate(self, numbers: Numbers, active: mi.Bool | bool = True) -> Found:
        """What a new path brings; also the place that ``numbers`` have reached, evaluated."""
        proposal, numbers_after = self._evaluate(numbers, mi.Bool(active))
        found = self.contribution(proposal)
        sample = self.sample(proposal)
        lane = dr.arange(mi.UInt32, dr.width(found.target))
        dr.eval(found, lane, sample, numbers_after)
        return Found(found.target, [found], [lane], sample)

    def _evaluate(self, numbers: Numbers, active: mi.Bool) -> tuple[Proposal, Numbers]:
        memory, at = PathMemory.of(self.most), mi.UInt32(0)
        _memory, numbers, proposal = self.mutations.new_path(memory, at, numbers, active)
        return proposal, numbers

    def contribution(self, proposal: Proposal) -> Contribution:
        """What a path adds to the image, as a new path."""
        found = proposal.found
        factor = dr.exp(found.log_geometry - proposal.log_density)
        value = dr.select(found.active, found.value * factor, 0)
        is_sound = dr.all(dr.isfinite(value))
        value = dr.select(is_sound, value, 0)
        # Negative components, which spectral variants have, count by their absolute value
        target = mi.luminance(dr.abs(value))
        if self.weights is not None:
            target *= self.weights.at(found.position)
        return Contribution(found.position, value, target)

    def sample(self, proposal: Proposal) -> Sample:
        """The rays that it took."""
        found = proposal.found
        return Sample(
            mi.Spectrum(0), found.active, found.scatter, found.shadow, mi.UInt32(0)
        )
