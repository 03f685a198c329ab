"""Learning which lights to choose, and which shadow rays to trace."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ...lights.light_cells import LightCells
from ...lights.weights import uniform_weights
from ...regions.surface_rows import BYTES_PER_VOXEL, RowCounts, SurfaceRows, voxel_edges
from ...regions.surface_sides import region
from ...transport.path_decisions import EmitterSampling
from ..learner import Learner
from ..shadow_test.light_map_roulette import LightRoulette
from ..shadow_test.rejection_law import WORTHWHILE
from . import light_map_file
from .light_map import BYTES_PER_ENTRY, LightMap
from .light_table import LightSelection

#: Share of the choices that what was learned does not decide: half of them go by the unoccluded
#: contributions, half are those of ``path``, so that no choice is less likely than 1/20 of what it
#: is there. Where a beam lights a small part of a voxel, the expectation may have missed it.
_DEFENSIVE = 0.1

#: Voxels along each axis where the scene's author leaves the choice to us, at most; and entries of
#: the map for each sample of the pilots (with about three connections each), at most.
_GRID, _ENTRIES_PER_SAMPLE = 16, 16.0

#: By how much the variance must fall, relatively: what learning costs in time. And the relative
#: variance of everything that does not depend on the choice, at least.
_LEAST_GAIN, _OTHER_VARIANCE = 0.07, 0.1


class LightLearner(Learner):
    """Learns a light map in the pilots; chooses lights with it, and rejects shadow rays.

    Where the map says that choosing lights as ``path`` does is nearly as good, and nothing else
    needs it, learning ends there.

    Parameters:
        target: ``visibility`` or ``contribution``.
        rejection: Law, slope and floor of the roulette; ``None``: every shadow ray is traced.
        grid: Voxels along each axis of the region in which paths scatter; 0: chosen by the number
            of pilot samples.
        max_memory: Bytes that the map may take.
        pilot_samples: Samples of all pilots together.
        load, save: Files of a map to begin with, and of the map that was learned.
        plugin: What errors call the plugin.
    """

    def __init__(
        self,
        target: str,
        rejection: dict[str, Any] | None,
        grid: int,
        max_memory: int,
        pilot_samples: int,
        load: Path | None = None,
        save: Path | None = None,
        plugin: str = "neepp",
    ) -> None:
        self.target, self.rejection, self.grid = target, rejection, grid
        self.max_memory, self.pilot_samples = max_memory, pilot_samples
        self.load, self.save, self.plugin = load, save, plugin
        # A loaded map brings its region and its rows
        self.wants_scout = load is None
        self._is_needed = grid > 0 or rejection is not None or load is not None or save is not None
        self._map: LightMap | None = None
        self._summary = ""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> dict[str, Any]:
        self._map, self._summary = None, "nothing: no path scatters"
        if self.load is not None:
            self._map = light_map_file.load(
                self.load, scene, self.pilot_samples, self.max_memory,
                parameter=f'"{self.plugin}": the parameter "load_map"',
            )  # fmt: skip
        elif dr.width(p) > 0:
            self._map = self._new_map(scene, p, n)
            # Mitsuba samples these with a wrong density
            self._is_needed |= self._map.cells.has_smooth_meshes
            if self._map.cells.count == 1 and not self._is_needed:
                self._map, self._summary = None, "nothing: there is one light to choose"
        if self._map is None:
            return {}
        self._as_path = _normalized(
            uniform_weights(scene, self._map.cells), self._map.cells.count
        )
        return self._selection(self._probabilities(self._map.unoccluded))

    def _new_map(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> LightMap:
        bbox = region(p)
        grid = self.grid or _GRID
        cells = LightCells(scene, voxel_edges(bbox, grid))
        limit = math.inf if self.grid else self.pilot_samples * _ENTRIES_PER_SAMPLE
        counts = RowCounts(bbox, p, n)

        def fits(grid: int) -> bool:
            # A coarser grid has no more cells
            entries = counts(grid) * cells.count
            memory = entries * BYTES_PER_ENTRY + grid**3 * BYTES_PER_VOXEL
            return entries <= limit and memory <= self.max_memory

        while grid > 1 and not fits(grid):
            grid = max(1, int(0.8 * grid))
        rows = SurfaceRows(bbox, grid, p, n)
        if grid != (self.grid or _GRID):
            cells = LightCells(scene, voxel_edges(bbox, grid))
        if self.grid > grid:
            mi.Log(
                mi.LogLevel.Warn,
                f"The light map of grid={self.grid} would exceed max_memory="
                f"{self.max_memory / 2**20:g} MiB: grid={grid} is used.",
            )
        return LightMap(scene, rows, cells, self.pilot_samples)

    # ---- Observer ----

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        if self._map is not None:
            self._map.begin(lanes)

    def connection(self, choice, si, ds, contribution, visible, tested) -> None:
        if self._map is not None:
            self._map.connection(choice, si, ds, contribution, visible, tested)

    # ---- Between the stages ----

    def learn(self, scene: mi.Scene, is_last: bool) -> dict[str, Any]:
        if self._map is None:
            return {}
        self._map.evaluate()
        probabilities = self._probabilities(self._map.weights(self.target))
        if not self._is_needed:
            gain = self._gain(probabilities)
            if gain < _LEAST_GAIN:
                self._summary = (
                    f"{self._map}; not used, it would lower the variance by only "
                    f"{max(0.0, gain):.0%}"
                )
                self._map = None
                return {"next_event": EmitterSampling()}
        decisions = self._selection(probabilities)
        if not is_last:
            return decisions
        self._summary = str(self._map)
        if self.rejection is not None:
            roulette = LightRoulette(self._map, **self.rejection)
            if roulette.rejected_share >= WORTHWHILE:
                decisions["shadow_test"] = roulette
        if self.save is not None:
            light_map_file.save(self.save, scene, self._map)
        self._map = None  # the last stage needs the tables only
        return decisions

    def _gain(self, probabilities: mi.Float) -> float:
        """By how much, relatively, these probabilities lower the variance below that of Mitsuba's
        choice."""
        default, learned = self._map.relative_variances(
            dr.tile(self._as_path, self._map.rows.count), probabilities
        )
        return (default - learned) / (default + _OTHER_VARIANCE)

    def _probabilities(self, weights: mi.Float) -> mi.Float:
        """Probabilities that no wrong expectation can keep from any cell."""
        count, unoccluded = self._map.cells.count, self._map.unoccluded
        as_path = dr.tile(self._as_path, self._map.rows.count)
        safe = 0.5 * (_normalized(unoccluded, count) + as_path)
        mixed = (1 - _DEFENSIVE) * _normalized(weights, count) + _DEFENSIVE * safe
        # Cells with a sampling_weight of 0 have no weight in any row
        return _normalized(dr.select(unoccluded > 0, mixed, 0), count)

    def _selection(self, probabilities: mi.Float) -> dict[str, Any]:
        return {"next_event": LightSelection(self._map.rows, self._map.cells, probabilities)}

    def __str__(self) -> str:
        return self._summary


def _normalized(weights: mi.Float, count: int) -> mi.Float:
    """Weights that add up to one in each row; a row of zeros has equal ones."""
    total = dr.repeat(dr.block_sum(weights, count), count)
    return dr.select(total > 0, weights / total, dr.rcp(mi.Float(count)))
