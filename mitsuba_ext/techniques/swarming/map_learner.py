"""Learning the maps of one decision."""

from __future__ import annotations

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.costs import SWARMING
from ...planning.learner import Learner, Pilot
from ...planning.pixel_estimates import brightness
from ...planning.prediction import Effect, Prediction
from ...rendering.film_tiles import FilmTiles
from ...transport.estimator import CameraRays
from ...util.arrays import from_numpy
from ...util.spectra import to_rgb
from ...util.stored_arrays import StoredArrays
from .cells import CellDensities, Cells
from .estimate import Form, Grid, Shares, estimate
from .tile_counts import Candidate, Choices, TileCounts

#: The forms of densities from which one is chosen; and the form before their gains are measured.
_FORMS = (Form(True, 0.2), Form(False, 0.05))
_FIRST_FORM = Form(False, 0.2)

#: The most cells of all tiles of one map: 32 MiB of counters, and as much for each of two tables.
_MOST_CELLS = 1 << 23

#: Maps are given up if they do not pay after this number of samples per pixel, in this number of
#: stages.
_ENOUGH_SAMPLES, _VAIN_STAGES = 2, 2

#: In all pilots, a tile has at least this number of samples, and at least one for each cell of its
#: maps, since cells take time. Tiles are as small as that allows. Earlier stages have larger tiles,
#: with at least this part of these samples.
_LEAST_SAMPLES, _EARLY_PART = 64, 0.25

#: About the number of samples per pixel of the first stage.
_FIRST_SAMPLES = 0.25

#: The part of the variance that maps leave if the estimate is that nothing is left: such estimates
#: are differences, mostly noise, and no map has gained more.
_LEFT = 0.05


def tile_edge(samples: float, cells: int, share: float = 1.0) -> int:
    """The edge of a tile in pixels.

    Parameters:
        samples: Samples per pixel.
        cells: Number of cells of all maps of a tile.
        share: The part of the least number of samples that a tile must have.
    """
    wanted = share * max(_LEAST_SAMPLES, cells)
    edge = 1
    while edge * edge * samples < wanted:
        edge *= 2
    return edge


class MapLearner(Learner):
    """Learns the maps of one decision from the samples of the pilots, and draws from them in all
    stages but the first.

    The density of a cell follows from the mean contribution of the numbers in it. From the samples
    of each stage, the learner estimates which of two forms of the density would have been better
    for them, and the reduction of the image's variance by maps. Maps are used where that is large
    enough, and given up for good after a stage in which it was not.

    Parameters:
        name: Name of the maps in summaries.
        decision: Draws uniform numbers; with the attribute ``maps``, it draws from these.
        width, height: Size of the film in pixels, with its border where that is sampled.
        cells: The cells of a map.
        samples: Samples per pixel of all pilots.
        maps: Number of maps of a tile.
        always: Use maps also where they do not pay?

    Attributes:
        decision: The decision of the stage, a copy with its maps.
        last_drawn: What :meth:`drawn` was at the end of the last pass. The camera draws the numbers
            of the next pass before the last one is counted.
        total, importance: At the end of a pass: the radiance of each lane, and the factor from it
            to the contribution to its pixel.
        tiles: The tiles whose pixels share maps.
        cells: The cells of a map.
        gain: The relative reduction of variance by the maps: expected, or that in the last pilot.
    """

    def __init__(
        self,
        name: str,
        decision: Any,
        width: int,
        height: int,
        cells: Cells,
        samples: int,
        maps: int = 1,
        always: bool = False,
    ) -> None:
        self.name, self.decision, self.cells, self.maps = name, decision, cells, maps
        self._extent, self._least_edge = (width, height), tile_edge(samples, maps * cells.count)
        self.tiles = decision.tiles = self._tiles(_FIRST_SAMPLES)
        self._widths = from_numpy(mi.Float, cells.widths)
        self.gain, self._always, self._memory, self._vain_stages = 0.0, always, 0, 0
        self._counts: TileCounts | None = TileCounts(self.tiles, maps, cells.count)
        self._pixel: mi.UInt32 | None = None
        self._radiance: mi.Float | None = None
        self.last_drawn: Any = None

    # ---- For subclasses ----

    #: Whether maps are used only after a stage has measured their gain. Where another
    #: distribution takes a part of the decisions, a gain that is predicted against uniform numbers
    #: means nothing.
    needs_measurement = False

    def choices(self, radiance: mi.Float) -> Choices:
        """The choices of the decision in the last pass; ``radiance`` is the contribution of each
        lane to its pixel."""
        raise NotImplementedError

    def drawn(self) -> Any:
        """Variables of the running pass that :meth:`choices` needs, except those into which it
        scatters."""
        return None

    @property
    def is_learning(self) -> bool:
        """Whether the samples of the running stage are recorded."""
        return self._counts is not None

    # ---- Observer ----

    #: It keeps arrays that a pass makes: rays, and their radiance
    can_be_frozen = False

    def camera(self, rays: CameraRays) -> None:
        self._rays = rays

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        self._collect()
        self._pixel = pixel

    def end(self, L: mi.Spectrum) -> None:
        if self._counts is None:
            return
        rays = self._rays
        rgb = to_rgb(L * (rays.importance * rays.weight), rays.ray.wavelengths)
        self._radiance = dr.sqrt(dr.squared_norm(mi.Color3f(rgb)) / 3)
        self.total = brightness(L)
        self.importance = dr.select(self.total > 0, self._radiance / self.total, 0)
        self.last_drawn = self.drawn()
        # `choices` is called once the pass is over: reading the scattered arrays now would start
        # it, and variables that are not scheduled here would be traced a second time
        dr.schedule(self._radiance, self.total, self.importance, self._pixel, self.last_drawn)

    # ---- Between the stages ----

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any:
        return self.decision

    def learn(self, pilot: Pilot) -> Any:
        self._collect()
        counts = self._counts
        if counts is None:
            return self.decision
        gains, form = counts.gains(), _FIRST_FORM
        if len(gains) > 0:
            best = int(np.argmax(gains))
            self.gain, form = float(gains[best]), _FORMS[best]
            if self.decision.maps is not None and not self._pays(pilot, self.gain):
                return self._given_up()
        samples = counts.samples / np.prod(self._extent)
        grid = Grid(self.tiles.rows, self.tiles.columns, self.maps)
        shares = Shares(estimate(*counts.sums(), grid, self._widths), self._widths)
        if self.needs_measurement:
            expected = np.inf if len(gains) > 0 else 0.0
        else:
            expected = counts.expected_gain(shares.expected_ratio(form).numpy())
        if len(gains) == 0:
            self.gain = expected
        self._set_maps(None)
        if self._pays(pilot, min(self.gain, expected)):
            self._set_maps(CellDensities(self.cells, shares.mass(form)), self.tiles)
        elif samples >= _ENOUGH_SAMPLES:
            self._vain_stages += 1
            if self._vain_stages >= _VAIN_STAGES:
                return self._given_up()
        self._memory = counts.bytes + shares.bytes
        if self.decision.maps is not None:
            self._memory += self.decision.maps.bytes
        if not pilot.is_last:
            # The next stage has as many samples as all stages so far
            tiles = self._tiles(2 * samples)
            counts.begin_stage([self._candidate(shares, form, tiles) for form in _FORMS])
            if tiles.edge < self.tiles.edge:
                counts.divide(tiles)
                self.tiles = tiles
        return self.decision

    def _pays(self, pilot: Pilot, gain: float) -> bool:
        """Whether maps pay that reduce the variance by ``gain``."""
        return self._always or pilot.pays(Prediction(1 - gain, 1.0, overhead=SWARMING))

    def _given_up(self) -> Any:
        """The decision without maps, once there is no hope for them."""
        self._set_maps(None)
        self.stop()
        return self.decision

    def _set_maps(self, maps: CellDensities | None, tiles: FilmTiles | None = None) -> None:
        """Makes a decision with other maps; the earlier one stays as it is."""
        self.decision = copy.copy(self.decision)
        self.decision.maps, self.decision.tiles = maps, tiles or self.decision.tiles

    def _tiles(self, samples: float) -> FilmTiles:
        """The tiles that have maps once each pixel has this number of samples."""
        cells = self.maps * self.cells.count
        edge = max(self._least_edge, tile_edge(samples, cells, _EARLY_PART))
        tiles = FilmTiles(*self._extent, edge)
        while tiles.count * cells > _MOST_CELLS:
            tiles = FilmTiles(*self._extent, 2 * tiles.edge)
        return tiles

    def _candidate(self, shares: Shares, form: Form, tiles: FilmTiles) -> Candidate:
        """A density to be tried in the next stage. It is called with tables of ``tiles``, which may
        be smaller than the tiles of ``shares``."""
        own, grid = self.tiles, Grid(tiles.rows, tiles.columns, self.maps)
        columns, step = (dr.opaque(mi.UInt32, n) for n in (own.columns, own.edge // tiles.edge))

        def density(table: mi.UInt32, cell: mi.UInt32) -> mi.Float:
            row, column, which = grid.places(table)
            table = (row // step * columns + column // step) * self.maps + which
            return shares.relative(form, table * self.cells.count + cell)

        return density

    def state(self) -> dict[str, np.ndarray]:
        maps = self.decision.maps
        if maps is None:
            return {}
        edge = np.array(self.decision.tiles.edge)
        return {"cumulative": maps.cumulative.numpy(), "edge": edge}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> Any:
        maps, cells = CellDensities(self.cells, self._widths), self.cells.count
        tiles = FilmTiles(*self._extent, state.number("edge", "iu", 1, 1 << 16))
        size = tiles.count * self.maps * cells
        cumulative = state.take("cumulative", "u", (size,), 0, 0xFFFFFFFF, longest=size)
        rows = cumulative.reshape(-1, cells)
        is_rising = (rows[:, 1:] >= rows[:, :-1]).all() and (rows[:, -1] > 0).all()
        state.require(bool(is_rising), '"cumulative" is not rising')
        maps.cumulative = from_numpy(mi.UInt32, cumulative)
        self._set_maps(maps, tiles)
        return self.decision

    def finish(self) -> None:
        self.stop()

    def stop(self) -> None:
        """Ends learning."""
        self._counts = self._rays = self._pixel = self._radiance = None
        self.total = self.importance = self.last_drawn = None

    def _collect(self) -> None:
        """Counts the last pass."""
        if self._counts is not None and self._radiance is not None:
            self._counts.add(self._pixel, self._radiance, self.choices(self._radiance))
        self._radiance = None

    @property
    def efficiency(self) -> float:
        if self.decision.maps is None:
            return 1.0
        return 1 / (_LEFT if self.gain >= 1 else max(1 - self.gain, 1e-3))

    @property
    def effect(self) -> Effect:
        # Drawing from a map takes next to no time
        is_kept = self.decision.maps is not None
        return Effect(is_kept, 1 - self.gain, 1.0 if is_kept else None)

    def __str__(self) -> str:
        if self.decision.maps is None:
            return f"{self.name}: uniform"
        tiles = self.decision.tiles
        return (
            f"{self.name}: {tiles.count} tiles of {tiles.edge} pixels, "
            f"{self._memory / 2**20:.1f} MiB, about {min(self.gain, 1):.0%} less variance"
        )
