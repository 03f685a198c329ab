"""Choosing among many lights by a light tree."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.bsdfs import is_in_table, opaque_bsdfs
from ..scene.lights.cell_bounds import cell_bounds
from ..scene.lights.choice import Choice
from ..scene.lights.light_cells import LightCells
from ..scene.lights.light_tree import LightTree, Receiver
from ..scene.lights.tree_construction import build_trees
from ..scene.lights.weights import power_weights
from ..scene.media import may_have_media
from ..util.arrays import from_numpy
from .light_table import Rows, if_active
from .path_decisions import EmitterSampling

#: Meshes of more faces than this are divided into about as many cells.
_FACE_CELLS = 1 << 16


class TreeChoice(EmitterSampling):
    """Chooses a cell by a light tree (:mod:`~mitsuba_ext.scene.lights.light_tree`), then a point on
    it. The faces of large meshes are cells; other emitters are whole.

    Nothing is learned. The probabilities fit each vertex and its normal, at a cost that grows with
    the logarithm of the number of lights. They know nothing of occlusion. An emitter whose
    ``sampling_weight`` is zero is not chosen; other weights are factors of the estimates.

    Parameters:
        scene: A scene with at least two cells.
        cells: Its cells.
        rows: The rows of places in which observers count choices, if there are any.
    """

    choice_dimension = 2

    def __init__(self, scene: mi.Scene, cells: LightCells, rows: Rows | None = None) -> None:
        self.cells, self._rows = cells, rows
        weights = power_weights(scene, cells).numpy().astype(np.float64)
        chosen = np.flatnonzero(weights > 0)
        if len(chosen) == 0:
            chosen, weights = np.arange(cells.count), cells.share
        lights, is_infinite = cell_bounds(scene, cells, weights)
        trees = build_trees(lights.at(chosen), apart=is_infinite[chosen])
        self._in_media = may_have_media(scene)
        self._tree = LightTree(trees, self._in_media)
        self._opaque = opaque_bsdfs(scene)
        # Cells of which light, and lights of which cell; there is one more for cells without light
        number = np.full(cells.count, len(chosen))
        number[chosen] = np.arange(len(chosen))
        self._light_of, self._cell_of, self._first_cell = (
            from_numpy(mi.UInt32, x) for x in (number, chosen, cells.first_cells())
        )
        self._count = dr.opaque(mi.UInt32, len(chosen))

    def begin(self, sampler, ray, pixel=None):
        return Receiver(mi.Normal3f(0), mi.Bool(False))

    def visit(self, state, scene, si, active):
        normal = dr.mulsign(si.sh_frame.n, si.wi.z)
        if self._in_media:
            # The frame of a vertex in a medium depends on where the path comes from
            normal = dr.select(si.shape == None, mi.Normal3f(0), normal)  # noqa: E711
        return Receiver(normal, active & is_in_table(self._opaque, si.bsdf()))

    def sample(self, place, scene, numbers, si, active):
        light, probability = self._tree.choose(
            mi.UInt32(0), numbers.choice, si.p, place, active
        )
        cell = dr.gather(mi.UInt32, self._cell_of, light, active)
        ds, weight = self.cells.sample(cell, si, numbers.point, active)
        ds.pdf *= probability
        choice = None
        if self._rows is not None:
            choice = Choice(self._rows.row(si, active), cell, probability)
        return ds, dr.select(probability > 0, weight / probability, 0), choice

    def density(self, state, scene, ref, si, ds, active):
        # Few rays hit a light: the others skip the way up the tree
        return if_active(active, self._density, (state, ref, si, ds, active))

    def _density(self, state, ref, si, ds, active) -> mi.Float:
        cell, pdf = self.cells.pdf(ref, si, ds, active)
        # Also where the lookups above were masked, the density must be a number
        return dr.select(active, pdf * self.of_cell(cell, state, ref, active), 0)

    def probability(self, state, scene, ref, emitter, active):
        # Points and directions are cells of their own
        cell = dr.gather(mi.UInt32, self._first_cell, emitter, active)
        return self.of_cell(cell, state, ref, active)

    def of_cell(self, cell, state, ref, active) -> mi.Float:
        light = dr.gather(mi.UInt32, self._light_of, cell, active)
        exists = active & (light < self._count)
        probability = self._tree.probability(light, ref.p, state, exists)
        return dr.select(exists, probability, 0)


def tree_choice(scene: mi.Scene) -> TreeChoice | None:
    """The choice of lights by a tree; ``None`` if the scene has only one light, or none."""
    if len(scene.emitters()) == 0:
        return None
    cells = LightCells(scene, None, face_cells=_FACE_CELLS)
    return TreeChoice(scene, cells) if cells.count > 1 else None
