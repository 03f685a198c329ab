"""Learning the visibility of an environment."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ...planning.learner import Learner, Pilot
from ...scene.lights.environment_texels import EnvironmentTexels
from ...scene.lights.texel_sums import TexelSums
from ...util.stored_arrays import StoredArrays
from .environment_visibility import PrimaryVisibility, VisibilityCounts, WorldVisibility
from .two_stage import TwoStage

#: Cells of a tile in each space: columns and rows, powers of two.
CELLS = {"primary": (16, 16), "world": (32, 16)}


class VisibilityLearner(Learner):
    """Counts unoccluded connections in a pilot that samples by the product of emission and BSDF.

    Parameters:
        space: ``primary`` for maps of random numbers, ``world`` for maps of directions.
        splits, everywhere: See :class:`TwoStage`.
        reallocated: The share of the connections that follow the maps.
        width, height: Size of the film in pixels, with its border where that is sampled.
    """

    def __init__(
        self, space: str, splits: int, everywhere: bool, reallocated: float, width: int,
        height: int,
    ) -> None:  # fmt: skip
        self._space, self._splits, self._everywhere = space, splits, everywhere
        self._reallocated = reallocated
        self._counts = VisibilityCounts(width, height, *CELLS[space])
        self._sums: TexelSums | None = None
        self._has_learned = False
        self._summary = ""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> TwoStage:
        self._sums = TexelSums(EnvironmentTexels(scene))
        return self._decision(scene)

    def connection(self, *arguments: Any) -> None:
        self._counts.connection(*arguments)

    def learn(self, pilot: Pilot) -> TwoStage:
        self._has_learned = True
        self._summary = str(self._counts)
        return self._learned(pilot.scene)

    def state(self) -> dict[str, np.ndarray]:
        return {"counts": self._counts.counts} if self._has_learned else {}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> TwoStage:
        self._sums = TexelSums(EnvironmentTexels(scene))
        self._counts.restore(state)
        self._summary = str(self._counts)
        return self._learned(scene)

    def finish(self) -> None:
        self._counts.release()
        self._sums, self._has_learned = None, False

    def _learned(self, scene: mi.Scene) -> TwoStage:
        counts = self._counts
        if self._space == "primary":
            return self._decision(scene, PrimaryVisibility(counts, self._reallocated))
        texels = self._sums.texels
        emission = self._emission((counts.rows, counts.columns))
        visibility = WorldVisibility(
            counts, self._reallocated, emission, texels.columns, texels.rows
        )
        return self._decision(scene, visibility)

    def _emission(self, shape: tuple[int, int]) -> np.ndarray:
        """The share of each cell in the emission of the environment."""
        node = self._sums.texels.nodes()
        weight = node[:-1, :-1] + node[:-1, 1:] + node[1:, :-1] + node[1:, 1:]
        rows, columns = (
            (np.arange(texels) * count // texels)
            for texels, count in zip(weight.shape, shape)
        )
        result = np.zeros(shape)
        np.add.at(result, (rows[:, None], columns), weight)
        return result / result.sum()

    def _decision(self, scene: mi.Scene, visibility: Any = None) -> TwoStage:
        return TwoStage(
            scene, self._splits, self._everywhere, self._counts, self._space == "primary",
            visibility, self._sums,
        )  # fmt: skip

    def __str__(self) -> str:
        return self._summary
