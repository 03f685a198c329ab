"""Learning the maps of one decision."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.colour import to_rgb
from ...transport.estimator import CameraRays
from ..learner import Learner
from ..pixel_estimates import brightness
from .cells import CellDensities, Cells
from .estimate import Form, density, estimate, expected_ratio
from .film_tiles import FilmTiles
from .tile_counts import Choices, TileCounts

#: How densities may follow from what was found; and how they do as long as nothing is known of
#: what that brings.
_FORMS = (Form(True, 0.2), Form(False, 0.05))
_FIRST_FORM = Form(False, 0.2)

#: By how much a map is to lower the variance of the image, relatively, to be used.
_LEAST_GAIN = 0.03


class MapLearner(Learner):
    """Learns the maps of one decision from the samples of the pilots, and draws from them in all
    stages but the first.

    The density of a cell follows from the mean of what numbers in it have brought. The samples of
    each stage tell which of two forms would have been best for them, and what maps are worth: these
    are used where that promises to lower the variance of the image, and given up for good after a
    stage in which they did not.

    Parameters:
        name: What summaries call the maps.
        decision: What draws from the maps: its attribute ``maps`` is theirs, or ``None`` where
            numbers are to be uniform.
        width, height: Of the film, with its border where that is sampled.
        cells: Of a map.
        edge: Of a tile in pixels, where memory suffices.
        maps: Maps of a tile.
        always: Use them also where they do not pay?

    Attributes:
        decision: See above.
        total, importance: Of the pass that ends: what each lane has brought, and the factor from
            that to what its pixel gets.
        tiles: The tiles that share maps.
        cells: The cells of each.
        gain: By how much the maps are expected to lower the variance, or did so in the last pilot.
    """

    def __init__(
        self,
        name: str,
        decision: Any,
        width: int,
        height: int,
        cells: Cells,
        edge: int,
        maps: int = 1,
        always: bool = False,
    ) -> None:
        self.name, self.decision, self.cells, self.maps = name, decision, cells, maps
        self.tiles = FilmTiles(width, height, edge, maps * cells.count)
        self.gain, self._always, self._memory = 0.0, always, 0
        self._counts: TileCounts | None = TileCounts(self.tiles, maps, cells.count)
        self._pixel: mi.UInt32 | None = None
        self._radiance: mi.Float | None = None
        self._choices: Choices | None = None

    # ---- What a subclass says ----

    #: Are maps used only after a stage has shown what they are worth? Where something else takes
    #: a part of the decisions, what maps promise over uniform numbers says nothing.
    needs_measurement = False

    def choices(self, radiance: mi.Float) -> Choices:
        """What the decision chose in each lane of the pass that ends; ``radiance`` is what each
        lane brought to its pixel."""
        raise NotImplementedError

    @property
    def is_learning(self) -> bool:
        """Are the samples of the running stage wanted?"""
        return self._counts is not None

    # ---- Observer ----

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
        self._choices = self.choices(self._radiance)
        dr.schedule(self._radiance, self._pixel, self._choices)

    # ---- Between the stages ----

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any:
        return self.decision

    def learn(self, scene: mi.Scene, is_last: bool) -> Any | None:
        self._collect()
        counts = self._counts
        if counts is None:
            return None
        gains, form = counts.gains(), _FIRST_FORM
        if len(gains) > 0:
            best = int(np.argmax(gains))
            self.gain, form = float(gains[best]), _FORMS[best]
            if self.gain < _LEAST_GAIN and self.decision.maps is not None and not self._always:
                self.decision.maps = None
                self.stop()
                return None
        array, squares = counts.arrays()
        widths = self.cells.widths
        shares = estimate(array, squares, widths)
        mass = density(shares, widths, form)
        if self.needs_measurement:
            expected = np.inf if len(gains) > 0 else 0.0
        else:
            expected = counts.expected_gain(expected_ratio(mass, widths))
        if len(gains) == 0:
            self.gain = expected
        self.decision.maps = None
        if self._always or min(self.gain, expected) >= _LEAST_GAIN:
            self.decision.maps = CellDensities(self.cells, mass.reshape(-1, self.cells.count))
        if not is_last:
            counts.begin_stage([self._relative(density(shares, widths, f)) for f in _FORMS])
        self._memory = counts.bytes
        if self.decision.maps is not None:
            self._memory += self.decision.maps.bytes
        return None

    def _relative(self, mass: np.ndarray) -> mi.Float:
        """Densities relative to uniform numbers."""
        widths = self.cells.widths
        # Nothing is drawn from a cell without width
        inverse = (1 / np.where(widths > 0, widths, 1)).astype(np.float32)
        return mi.Float((mass * inverse).ravel())

    def state(self) -> dict[str, np.ndarray]:
        maps = self.decision.maps
        return {} if maps is None else {"splits": maps.splits.numpy()}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> Any:
        maps = CellDensities(self.cells, self.cells.widths[None])
        maps.splits = mi.Float(state["splits"])
        self.decision.maps = maps
        return self.decision

    def finish(self) -> None:
        self.stop()

    def stop(self) -> None:
        """Learns nothing more."""
        self._counts = self._rays = self._pixel = self._choices = None
        self.total = self.importance = None

    def _collect(self) -> None:
        """Counts the last pass."""
        if self._counts is not None and self._radiance is not None:
            self._counts.add(self._pixel, self._radiance, self._choices)
        self._radiance = self._choices = None

    def __str__(self) -> str:
        if self.decision.maps is None:
            return f"{self.name}: uniform"
        return (
            f"{self.name}: {self.tiles.count} tiles of {self.tiles.edge} pixels, "
            f"{self._memory / 2**20:.1f} MiB, about {self.gain:.0%} less variance"
        )
