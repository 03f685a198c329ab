"""Two-stage importance sampling of an environment.

Source: Cline, PhD dissertation, chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...lights.environment_texels import EnvironmentTexels
from ...lights.texel_sums import TexelSums
from ...transport.heroes import Heroes
from ...transport.path_decisions import EmitterSampling
from .environment_partition import Partitioner


@dataclass
class State:
    """What a path remembers of its last vertex.

    Attributes:
        density: With which a connection would have found the direction in which the path has left.
        is_first: Is there no last vertex?
    """

    density: mi.Float
    is_first: mi.Bool


class TwoStage(EmitterSampling):
    """Directions of the environment by the product of what it emits and what the BSDF reflects of
    it; points of all other lights as Mitsuba chooses them.

    Parameters:
        scene: A scene with an environment emitter.
        splits: See :class:`Partitioner`.
        everywhere: Are there partitions at all vertices of a path, not only at the first? At the
            others, directions are drawn from the environment alone.
    """

    def __init__(self, scene: mi.Scene, splits: int, everywhere: bool) -> None:
        self._everywhere = everywhere
        self._sums = TexelSums(EnvironmentTexels(scene))
        self._texels = self._sums.texels
        self._partitioner = Partitioner(self._sums, Heroes(scene).context(), splits)
        emitters = scene.emitters()
        self.choice_dimension = 1 if len(emitters) > 1 else 0
        self._index = emitters.index(scene.environment())
        self._pointer = self._texels.directions.pointer

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> State:
        return State(mi.Float(0), mi.Bool(True))

    def visit(self, state, scene, si, active) -> Any:
        refines = mi.Bool(True) if self._everywhere else state.is_first
        return self._partitioner.partition(si, refines, active)

    def sample(self, place, scene, numbers, si, active):
        if self.choice_dimension == 0:
            return *self._sample_environment(place, si, numbers.point, mi.Float(1), active), ()
        index, inverse, _rest = scene.sample_emitter(numbers.choice, active)
        is_environment = index == self._index
        a, a_weight = self._sample_environment(
            place, si, numbers.point, dr.rcp(inverse), active & is_environment
        )
        is_other = active & ~is_environment
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, is_other)
        b, b_weight = emitter.sample_direction(si, numbers.point, is_other)
        b.pdf = dr.select(is_other, b.pdf / inverse, 0)
        b_weight = dr.select(is_other, b_weight * inverse, 0)
        return (
            dr.select(is_environment, a, b), dr.select(is_environment, a_weight, b_weight), ()
        )  # fmt: skip

    def _sample_environment(self, place, si, point, probability: mi.Float, active):
        d, uv, density = self._partitioner.sample(place, point, active)
        ds = self._texels.directions.sample(si, d)
        ds.uv, ds.pdf = uv, dr.select(active, density * probability, 0)
        value = self._texels.radiance(si, ds, active)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0)

    def remember(self, place, scene, d, pdf, active) -> State:
        return State(self._partitioner.pdf(place, d, active), mi.Bool(False))

    def density(self, state, scene, ref, si, ds, active):
        if self.choice_dimension == 0:
            return dr.select(active, state.density, 0)
        is_environment = ds.emitter == self._pointer
        others = scene.pdf_emitter_direction(ref, ds, active & ~is_environment)
        chosen = scene.pdf_emitter(mi.UInt32(self._index), active)
        return dr.select(active, dr.select(is_environment, state.density * chosen, others), 0)
