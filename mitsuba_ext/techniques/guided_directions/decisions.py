"""The decisions of path guiding: directions by trees of primary samples, and Russian roulette by
the expected contribution of a path.

Sources: Guo, PhD thesis, chapter 2; Eq. 2.12 (the factors of a path's samples). J. Vorba, J.
Křivánek, *Adjoint-Driven Russian Roulette and Splitting in Light Transport Simulation*, 2016,
sections 3 and 4. Without splitting: a lane of the walk is one path. The lower end of the weight
window is not from the paper.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.media import direction_at, eval_phase, point_of, sample_phase
from ...transport.path_decisions import DirectionSamples, Roulette
from ...util.arrays import channel_mean
from .sample_trees import SampleTrees

#: A path whose expected contribution is at least this share of its pixel's radiance continues with
#: certainty. With 0.3, the efficiency by rays is 0.86 of that with 0.15 (lamp in a glass ball),
#: 0.93 (veach-ajar) or the same (door_ajar, cornell_box).
_CERTAIN = 0.15

#: The least probability: where an estimate is too low, it bounds the weights of surviving paths.
_LEAST = 0.1

#: From this depth on, no path survives with certainty: some would never end.
_DEEP, _DEEP_PROBABILITY = 16, 0.95


class Regions(Protocol):
    """Decides from which tree a sample is drawn.

    Attributes:
        gives_directions: See :class:`DirectionSamples`.
    """

    gives_directions: bool

    def begin(self, pixel: mi.UInt32 | None) -> Any:
        """The state of paths that begin in ``pixel``."""

    def label(
        self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32 | None, active: mi.Bool
    ) -> mi.UInt32:
        """The region under which a sample is recorded."""

    def tree(self, state: Any, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The tree for a vertex."""

    def after(
        self, state: Any, trees: SampleTrees, leaf: mi.UInt32, active: mi.Bool
    ) -> Any:
        """The state after a sample was drawn from a leaf."""


class GuidedDirections(DirectionSamples):
    """Draws the samples of a path's first directions from trees. The throughput after a bounce is
    divided by the density of its sample. MIS weights remain the weights of uniform samples. That is
    unbiased, also beside light paths, because they add up to one for each path.

    Parameters (and attributes):
        trees: Densities of samples.
        regions: Decides from which tree a sample is drawn.
        bounces: How many directions of a path are guided.
    """

    def __init__(self, trees: SampleTrees, regions: Regions, bounces: int) -> None:
        self.trees, self.regions, self.bounces = trees, regions, bounces
        # Opaque: however many there are, the kernel is the same
        self._bounces = dr.opaque(mi.UInt32, bounces)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.trees, self.regions, self._bounces

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        return self.regions.begin(pixel)

    @property
    def gives_directions(self) -> bool:
        return self.regions.gives_directions

    def draw(self, state, sampler, vertex, active):
        sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
        if self.gives_directions and vertex.medium is not None:
            return sample_1, *self._draw_in_media(state, vertex, sample_1, sample_2, active)
        # A branch, so that later bounces cost nothing
        sample_2, weight, state = dr.if_stmt(
            (state, vertex.si, sample_2),
            active & (vertex.depth < self._bounces),
            self._guide,
            lambda state, si, sample: (sample, mi.Float(1), state),
        )
        return sample_1, sample_2, weight, state

    def _guide(self, state, si, sample):
        active = mi.Bool(True)
        tree = self.regions.tree(state, si, active)
        sample, density, leaf = self.trees.sample(tree, sample, active)
        return sample, dr.rcp(density), self.regions.after(state, self.trees, leaf, active)

    def _draw_in_media(self, state, vertex, sample_1, sample_2, active):
        """Draws the direction where a path scatters in a medium: from the tree, or from the phase
        function. Elsewhere, draws primary samples, as without media."""
        in_medium, mei = vertex.medium.scatters, vertex.medium.mei
        guided = active & (vertex.depth < self._bounces)
        tree = self.regions.tree(state, vertex.si, guided)
        share, by_tree, u = self.trees.choose(tree, sample_2, guided)
        d, _, _ = sample_phase(mei, sample_1, u, in_medium & ~by_tree)
        u = dr.select(in_medium & ~by_tree, point_of(d), u)
        # A branch, so that bounces that are not guided cost nothing
        u, density, leaf = dr.if_stmt(
            (tree, u, by_tree),
            guided & (share > 0),
            lambda tree, u, by_tree: self.trees.descend(tree, u, by_tree, mi.Bool(True)),
            lambda tree, u, by_tree: (u, mi.Float(1), tree),
        )
        _, pdf = eval_phase(mei, direction_at(u), guided & in_medium)
        # The density of primary samples (regions_with_media.py)
        density *= dr.select(in_medium, dr.inv_four_pi / pdf, 1)
        weight = dr.rcp(dr.fma(share, density, 1 - share))
        # Where the phase function is zero, the path ends
        weight = dr.select(guided & (share > 0) & ~(in_medium & (pdf == 0)), weight, 1)
        return u, weight, self.regions.after(state, self.trees, leaf, guided)

    def density(
        self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32 | None, u: mi.Point2f
    ) -> mi.Float:
        """The density of ``u`` among the samples that choose the first direction, for paths that
        begin in ``pixel`` of the film (row by row) and meet ``si`` first."""
        active = mi.Bool(True)
        tree = self.regions.tree(self.regions.begin(pixel), si, active)
        return self.trees.density(tree, u, active)[0]


class AdjointRoulette(Roulette):
    """Compares the expected contribution of a path with the radiance of its pixel.

    The expected contribution is the throughput times the mean radiance that bounces find in the
    region of the vertex. (Using the density of the guided direction as well gained nothing.)
    Mirrors and glass have no such mean, and no path ends there: the expectation of the last vertex
    has not changed.

    Parameters:
        regions: Finds the region of a vertex.
        radiance: Mean incident radiance of each region, negative where it is unknown. [regions]
        scale: 1 / radiance of each pixel of the film, row by row. [pixels]
    """

    def __init__(self, regions: Regions, radiance: mi.Float, scale: mi.Float) -> None:
        self._regions, self._radiance, self._scale = regions, radiance, scale
        dr.make_opaque(self._radiance, self._scale)

    @classmethod
    def by_throughput(cls, regions: Regions, count: int, pixels: int) -> AdjointRoulette:
        """A roulette that knows nothing yet, of numbers of regions and pixels: it ends paths of low
        throughput. With it, the pilot that learns the first radiances has the kernel of the pilots
        after it."""
        return cls(regions, dr.full(mi.Float, _CERTAIN, count), dr.full(mi.Float, 1, pixels))

    def state(self) -> dict[str, np.ndarray]:
        """The tables as arrays."""
        return {"radiance": self._radiance.numpy(), "scale": self._scale.numpy()}

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> mi.Float:
        return dr.gather(mi.Float, self._scale, pixel)

    def survival(self, state, vertex, path, active):
        region = self._regions.label(vertex.si, None, active)
        radiance = dr.gather(mi.Float, self._radiance, region, active)
        expected = channel_mean(path.β) * radiance * state
        p = dr.clip(expected * (1 / _CERTAIN), _LEAST, 1)
        is_unknown = radiance < 0
        p = dr.select(is_unknown, 1, p)
        if vertex.medium is not None:
            # Paths scatter there often: they must not go on with certainty
            by_throughput, _ = super().survival(None, vertex, path, active)
            p = dr.select(vertex.medium.scatters & is_unknown, by_throughput, p)
        return dr.select(path.depth >= _DEEP, dr.minimum(p, _DEEP_PROBABILITY), p), state
