"""Choosing directions by trees of primary samples.

Source: Guo, PhD thesis, chapter 2; Eq. 2.12 (the factors of a path's samples).
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import DirectionSamples
from .sample_trees import SampleTrees


class Regions(Protocol):
    """Decides from which tree a sample is drawn."""

    def begin(self, pixel: mi.UInt32 | None) -> Any:
        """The state of paths that begin in ``pixel``."""

    def label(
        self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32, active: mi.Bool
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

    def draw(self, state, sampler, vertex, active):
        sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
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

    def density(
        self, si: mi.SurfaceInteraction3f, pixel: mi.UInt32 | None, u: mi.Point2f
    ) -> mi.Float:
        """The density of ``u`` among the samples that choose the first direction, for paths that
        begin in ``pixel`` of the film (row by row) and meet ``si`` first."""
        active = mi.Bool(True)
        tree = self.regions.tree(self.regions.begin(pixel), si, active)
        return self.trees.density(tree, u, active)[0]
