"""Learning which lights to choose."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.costs import MAP_ENTRY, TREE
from ...planning.learner import Learner, Pilot
from ...planning.pixel_estimates import PixelEstimates
from ...planning.prediction import Effect, Prediction
from ...planning.verdicts import (
    FINER_MAP_SHARE,
    FIRST_MAP_SHARE,
    REFINING,
    is_trial,
    prefers_tree,
)
from ...scene.lights.light_cells import LightCells
from ...scene.lights.weights import uniform_weights
from ...scene.regions.surface_voxels import (
    BYTES_PER_VOXEL,
    RowCounts,
    SurfaceRows,
    region,
    voxel_edges,
)
from ...transport.light_table import LightTable
from ...transport.observer import Observer
from ...transport.path_decisions import EmitterSampling
from ...transport.rejection_law import RejectionLaw
from ...transport.tree_choice import TreeChoice, tree_choice
from ...util.stored_arrays import StoredArrays
from . import light_map_arrays
from .connection_records import ConnectionRecords
from .light_map import BYTES_PER_ENTRY, LightMap
from .shadow_roulette_learner import LightMapRouletteLearner

#: Share of the choices that do not follow the learned map: half of them use the unoccluded
#: contributions, half the probabilities of ``path``, so that no probability is below 1/20 of that
#: of ``path``. The map may miss a beam that lights a small part of a voxel.
_DEFENSIVE = 0.1

#: The most voxels along each axis with ``grid=0``; and the most entries of the map per sample of
#: the pilots (with about three connections each).
_GRID, _ENTRIES_PER_SAMPLE = 16, 16.0

#: The most entries of the first pilot's map, and of a finer one, per sample of the render.
_FIRST_ENTRIES, _FINER_ENTRIES = FIRST_MAP_SHARE / MAP_ENTRY, FINER_MAP_SHARE / MAP_ENTRY

#: The entries that the first pilot's map may have in any render: they take about 20 ms.
_FEW_ENTRIES = 1 << 17


class LightMapLearner(Learner):
    """Learns a light map in the pilots, and chooses lights with it.

    With several lights, the first pilot chooses by a light tree. Where it shows that a map would
    not be much more efficient, the tree stays, and learning ends there. It also ends where choosing
    lights as ``path`` does is nearly as efficient, unless something else needs the map.

    Parameters:
        target: ``visibility`` or ``contribution``.
        grid: Voxels along each axis of the region in which paths scatter; 0: chosen by the number
            of pilot samples.
        max_memory: Bytes that the map may take.
        pilot_samples: Samples of all pilots together.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
        render_samples: Samples of the render, pilots included.

    Attributes:
        map (LightMap): What has been learned so far; ``None`` if there is no map.
        removed (float): The variance of a sample that the map has removed in the last pilot, in
            units of the squared radiance of its pixel; ``None`` if it was not measured.
    """

    def __init__(
        self,
        target: str,
        grid: int,
        max_memory: int,
        pilot_samples: int,
        film_size: tuple[int, int],
        render_samples: float = math.inf,
    ) -> None:
        self.target, self.grid = target, grid
        self.max_memory, self.pilot_samples = max_memory, pilot_samples
        self.render_samples = render_samples
        self._pixels = PixelEstimates(*film_size)
        self._is_needed = grid > 0
        self.map: LightMap | None = None
        self._records: ConnectionRecords | None = None
        self._summary, self._effect = "", "not measured"
        self._efficiency, self._measured = 1.0, (None, None)
        self.removed: float | None = None
        self._about: dict[str, float] = {}
        self._is_kept: bool | None = None
        self._is_tested = False
        self._tree: EmitterSampling | None = None
        self._tree_prediction: Prediction | None = None
        # Makes a finer map than the first pilot had, with the same cells
        self._finer_map: Callable[[], LightMap] | None = None

    wants_scout = tells_visibility = True

    def shadow_test(self, law: RejectionLaw) -> LightMapRouletteLearner:
        return LightMapRouletteLearner(self, law)

    def keep_map(self) -> None:
        """Keeps the map even where it does not pay for the choice of lights."""
        self._is_needed, self._records = True, None

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> EmitterSampling | None:
        self.map = self._records = None
        self._summary = "lights: no path scatters"
        if dr.width(p) == 0:
            return None
        bbox = region(p)
        cells = LightCells(scene, voxel_edges(bbox, self.grid or _GRID))
        # Mitsuba samples these with a wrong density
        self._is_needed |= cells.has_smooth_meshes
        if cells.count == 1 and not self._is_needed:
            self._summary = "lights: there is only one"
            return None
        self.map = self._first_map(partial(self._new_map, scene, cells, bbox, p, n))
        self._scene = scene
        return self._begin_map()

    def _begin_map(self) -> EmitterSampling:
        """The decision of the first pilot that fills a map: a light tree, if there are several
        lights."""
        self._set_as_path(self._scene)
        self._is_tested = False
        if not self._is_needed:
            self._records = ConnectionRecords(
                self._scene, self._pixels, self.map.rows.count, self._as_path
            )
        if len(self._scene.emitters()) > 1:
            return TreeChoice(self._scene, self.map.cells, self.map.rows)
        return self._selection(self._probabilities(self.map.unoccluded))

    def _first_map(self, new_map: Callable[[float], LightMap]) -> LightMap:
        """The map of the first pilot. ``new_map`` makes the finest one of at most this number of
        entries."""
        limit = math.inf if self.grid else self.pilot_samples * _ENTRIES_PER_SAMPLE
        trial = max(_FEW_ENTRIES, self.render_samples * _FIRST_ENTRIES)
        trial = math.inf if self._is_needed else trial
        light_map = new_map(min(limit, trial))
        limit = min(limit, max(_FEW_ENTRIES, self.render_samples * _FINER_ENTRIES))
        if trial < limit and light_map.rows.resolution < _GRID:
            self._finer_map = partial(new_map, limit)
        return light_map

    def _new_map(
        self, scene: mi.Scene, cells: LightCells, bbox: mi.ScalarBoundingBox3f, p: mi.Point3f,
        n: mi.Normal3f, limit: float,
    ) -> LightMap:  # fmt: skip
        """The finest map of at most ``limit`` entries."""
        counts, grid = RowCounts(bbox, p, n), self.grid or _GRID

        def fits(grid: int) -> bool:
            # A coarser grid has no more cells
            memory = grid**3 * BYTES_PER_VOXEL
            if memory > self.max_memory:
                return False
            entries = counts(grid) * cells.count
            return entries <= limit and memory + entries * BYTES_PER_ENTRY <= self.max_memory

        while grid > 1 and not fits(grid):
            grid = max(1, int(0.8 * grid))
        rows = SurfaceRows(bbox, grid, p, n)
        if grid != (self.grid or _GRID):
            cells = LightCells(scene, voxel_edges(bbox, grid), cells.bins)
        if self.grid > grid:
            mi.Log(
                mi.LogLevel.Warn,
                f"The light map of grid={self.grid} would exceed max_memory="
                f"{self.max_memory / 2**20:g} MiB: grid={grid} is used.",
            )
        return LightMap(scene, rows, cells, self.pilot_samples)

    # ---- Observer ----

    def kernel_state(self) -> list[Observer]:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self._observers()

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        for observer in self._observers():
            observer.begin(lanes, pixel)

    def vertex(self, *arguments) -> None:
        if self._records is not None:
            self._records.vertex(*arguments)

    def emission(self, *arguments) -> None:
        if self._records is not None:
            self._records.emission(*arguments)

    def connection(self, *arguments) -> None:
        for observer in self._observers():
            observer.connection(*arguments)

    def end(self, L: mi.Spectrum) -> None:
        if self._records is not None:
            self._records.end(L)

    def _observers(self) -> list[Observer]:
        return [observer for observer in (self.map, self._records) if observer is not None]

    # ---- Between the stages ----

    def learn(self, pilot: Pilot) -> EmitterSampling | None:
        if self.map is None:
            return self._tree
        self.map.evaluate()
        probabilities = self._probabilities(self.map.weights(self.target))
        if self._records is not None and not self._pays(probabilities, pilot):
            self.map = self._records = self._finer_map = None
            self._is_kept = self._tree is not None
            return self._tree
        # The records are kept in trials: most pilot samples come later
        if self._finer_map is not None and self._records is not None and not pilot.is_last:
            if self._efficiency >= REFINING:
                self.map, self._finer_map = self._finer_map(), None
                return self._begin_map()
        if pilot.is_last:
            self._is_kept, self._summary = True, f"{self.map}, {self._effect}"
        return self._selection(probabilities)

    def state(self) -> dict[str, np.ndarray]:
        if self._tree is not None:
            return {"tree": np.array(True)}
        return {} if self.map is None else light_map_arrays.arrays_of(self._scene, self.map)

    def restore(self, scene: mi.Scene, state: StoredArrays) -> EmitterSampling | None:
        if "tree" in state:
            self._is_kept, self._summary = True, "lights: a light tree"
            return tree_choice(scene)
        self.map = light_map_arrays.of_arrays(state, scene, self.max_memory)
        self._set_as_path(scene)
        self.map.evaluate()
        self._is_kept, self._summary = True, str(self.map)
        return self._selection(self._probabilities(self.map.weights(self.target)))

    def finish(self) -> None:
        self.map = self._scene = self._finer_map = None

    def _set_as_path(self, scene: mi.Scene) -> None:
        cells = self.map.cells
        self._as_path = _normalized(uniform_weights(scene, cells), cells.count)

    def _pays(self, probabilities: mi.Float, pilot: Pilot) -> bool:
        """Whether the map pays by the samples of the last pilot, or may pay with more samples."""
        records = self._records
        records.finish()
        if self._is_tested:
            # The samples were drawn from the table, and it was not learned from them
            (gain, error), time = records.measured, records.cost
            share = records.samples / self.pilot_samples
            self.removed = records.removed
        else:
            # The prediction is too optimistic, as the table was learned from the same samples, but
            # too pessimistic where each entry has few of them. The pilot itself chose by unoccluded
            # contributions, and a learned table is rarely worse than that
            as_path = dr.tile(self._as_path, self.map.rows.count)
            predicted = records.predicted_gain(self.map.square_ratios(as_path, probabilities))
            gain, error = max(predicted, records.measured[0]), 0.0
            share, time = 0.0, records.least_cost
        prediction = Prediction(1 - gain, time, error, share)
        self._efficiency = prediction.efficiency
        if not self._about:
            self._measured = prediction.variance, time
        left, time = self._measured
        self._effect = _described(left, time)
        if not self._is_tested:
            self._tree_prediction = self._predict_tree()
        tree = self._tree_prediction
        if tree is not None and prefers_tree(tree, prediction):
            self._take_tree(tree)
            return False
        if not pilot.pays(prediction):
            would = f"a map would give {self._effect}"
            self._summary = f"lights as path chooses them: {would} ({self.map})"
            return False
        self._is_tested = True
        # Later pilots go on recording: without that, they would have other kernels
        records.restart()
        if not is_trial(share, pilot.is_last):
            self._finer_map = None
        return True

    def _predict_tree(self) -> Prediction | None:
        """What the last pilot tells about the light tree that it used, or a similar one; ``None``
        if there is only one light."""
        if len(self._scene.emitters()) < 2:
            return None
        gain, error = self._records.measured
        time = self._records.cost + TREE
        return Prediction(1 - gain, time, error)

    def _take_tree(self, prediction: Prediction) -> None:
        """Decides for the light tree."""
        self._tree = tree_choice(self._scene)
        self._measured = prediction.variance, prediction.time
        self.removed, self._about = self._records.removed, {"tree": True}
        self._summary = f"lights: a light tree, {_described(*self._measured)}"

    def _probabilities(self, weights: mi.Float) -> mi.Float:
        """The probabilities of cells, with a defensive share: errors of the map exclude no cell."""
        count, unoccluded = self.map.cells.count, self.map.unoccluded
        as_path = dr.tile(self._as_path, self.map.rows.count)
        safe = 0.5 * (_normalized(unoccluded, count) + as_path)
        mixed = (1 - _DEFENSIVE) * _normalized(weights, count) + _DEFENSIVE * safe
        # Cells with a sampling_weight of 0 have no weight in any row
        return _normalized(dr.select(unoccluded > 0, mixed, 0), count)

    def _selection(self, probabilities: mi.Float) -> LightTable:
        return LightTable(self.map.rows, self.map.cells, probabilities)

    def set_variance(self, variance: float, trimmed: float) -> None:
        # Pilots of ``path`` hold few of the rare paths that make most of its variance
        if self.removed is None:
            return
        left, trimmed = (x / max(x + self.removed, 1e-30) for x in (variance, trimmed))
        self._measured = left, self._measured[1]
        self._about |= {"trimmed_variance": trimmed}

    @property
    def effect(self) -> Effect | None:
        if self._is_kept is None:
            return None
        return Effect(self._is_kept, *self._measured, self._about)

    def __str__(self) -> str:
        return self._summary


def _described(variance: float, time: float) -> str:
    return f"about {max(0.0, 1 - variance):.0%} less variance in {time:.2f} x the time"


def _normalized(weights: mi.Float, count: int) -> mi.Float:
    """Weights that add up to one in each row; a row of zeros has equal ones."""
    total = dr.repeat(dr.block_sum(weights, count), count)
    return dr.select(total > 0, weights / total, dr.rcp(mi.Float(count)))
