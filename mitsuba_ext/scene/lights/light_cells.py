"""The lights that next event estimation can choose: cells of emitters, bins of an environment."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from .emitter_cells import EmitterCells
from .environment_bins import EnvironmentBins
from .tabulated_bins import TabulatedBins


class LightCells:
    """The lights of a scene in parts, numbered from 0 to ``count`` − 1: first the cells of its
    emitters (:class:`EmitterCells`), then the bins of its environment (:class:`EnvironmentBins`).
    Both are called cells here.

    Parameters:
        scene: A scene with at least one emitter.
        voxel: The three edges of a box. Longer emitters are divided into cells, and an environment
            into bins. With ``None``, each emitter is one cell.
        bins: The bins of the environment, if already made for other cells of this scene: making
            them takes a tenth of a second.
        face_cells: Without ``voxel``: divides meshes into their faces, or about as many parts as
            this if they have more (:func:`~.division.divide`).

    Attributes:
        count (int): Number of cells.
        bins (EnvironmentBins | None): The bins of the environment; ``None`` if it is not divided.
        emitter_index (numpy.ndarray): The scene index of each cell's emitter; shape [count].
        first_bin (int): The number of the first bin; ``count`` if there is none.
        has_face_cells (bool): Whether the faces of meshes are cells.
        share (numpy.ndarray): The fraction of its emitter's area, or of the environment's emitted
            brightness, in each cell; shape [count].
        has_smooth_meshes (bool): Whether a light is a mesh with interpolated normals. Mitsuba's own
            sampling of such a mesh has a wrong density.
    """

    def __init__(
        self,
        scene: mi.Scene,
        voxel: mi.Vector3f | None,
        bins: EnvironmentBins | None = None,
        face_cells: int = 0,
    ) -> None:
        environment = scene.environment() if voxel is not None else None
        emitters = scene.emitters()
        others = [
            i for i, e in enumerate(emitters) if environment is None or e.ptr != environment.ptr
        ]
        self._emitters = (
            EmitterCells(scene, others, voxel, face_cells) if others else None
        )
        self.bins = None if environment is None else bins or EnvironmentBins(scene)
        self.has_face_cells = face_cells > 0
        parts = [part for part in (self._emitters, self.bins) if part is not None]
        self.count = sum(part.count for part in parts)
        self.share = np.concatenate([part.share for part in parts])
        self.emitter_index = np.full(self.count, -1)
        self.first_bin = self.count
        self.has_smooth_meshes = self._emitters is not None and self._emitters.has_smooth_meshes
        if self._emitters is not None:
            self.emitter_index[: self._emitters.count] = self._emitters.emitter_index
        if self.bins is not None:
            self.first_bin -= self.bins.count
            index = next(i for i, e in enumerate(emitters) if e.ptr == environment.ptr)
            self.emitter_index[self.first_bin :] = index

    def first_cells(self) -> np.ndarray:
        """The first cell of each emitter, by its scene index."""
        first = np.zeros(self.emitter_index.max(initial=0) + 1, dtype=np.uint32)
        first[self.emitter_index[::-1]] = np.arange(self.count)[::-1]
        return first

    def faces(self, emitter: int, count: int) -> np.ndarray:
        """The cell of each of the ``count`` faces of a mesh, by the scene index of its emitter; for
        cells that are made with ``face_cells``."""
        return self._emitters.faces(emitter, count)

    def tabulated(self) -> LightCells:
        """The same cells, for :meth:`sample` only, with a few fixed directions in each bin of an
        environment (:class:`TabulatedBins`)."""
        if self.bins is None:
            return self
        other = copy.copy(self)
        other.bins = TabulatedBins(self.bins)
        return other

    def sample(
        self, cell: mi.UInt32, ref: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Samples a point on ``cell``, or a direction of an environment.

        Returns:
            The direction sample, whose ``pdf`` is conditional on the cell, and its radiance / pdf,
            before any visibility test.
        """
        if self.bins is None:
            return self._emitters.sample(cell, ref, sample, active)
        if self._emitters is None:
            return self.bins.sample(cell, ref, sample, active)
        in_bin = cell >= self.first_bin
        a, a_weight = self._emitters.sample(cell, ref, sample, active & ~in_bin)
        b, b_weight = self.bins.sample(cell - self.first_bin, ref, sample, active & in_bin)
        return dr.select(in_bin, b, a), dr.select(in_bin, b_weight, a_weight)

    def pdf(
        self,
        ref: mi.Interaction3f,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.UInt32, mi.Float]:
        """The cell that a ray from ``ref`` hit at ``si``, and the density of the ray's direction
        under :meth:`sample`, conditional on the cell."""
        if self.bins is None:
            return self._emitters.pdf(ref, si, ds, active)
        escaped = active & (ds.emitter == self.bins.pointer)
        bin, bin_pdf = self.bins.pdf(ds.d, escaped)
        if self._emitters is None:
            return bin, bin_pdf
        cell, pdf = self._emitters.pdf(ref, si, ds, active & ~escaped)
        return (
            dr.select(escaped, bin + self.first_bin, cell),
            dr.select(escaped, bin_pdf, pdf),
        )
