"""The parameters of next event estimation: which light, and which shadow rays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi

from ..bounds import scene_bounds
from ..decisions.learner import Learner
from ..decisions.next_event.light_map_learner import LightLearner
from ..decisions.next_event.light_table import TABLE_BYTES, LightSelection, OneRow
from ..decisions.next_event.linear_lights import LinearSelection
from ..decisions.shadow_test.visibility_roulette import VisibilityLearner, has_lights_at_points
from ..errors import InputError
from ..files import check_target
from ..lights.light_cells import LightCells
from ..lights.weights import VoxelRows, power_weights, spatial_weights
from ..regions.voxel_grid import VoxelGrid

if TYPE_CHECKING:
    from .walk_integrator import WalkIntegrator

#: Ways to choose a light; the last two learn.
METHODS = ("uniform", "power", "spatial", "linear", "visibility", "contribution")
LEARNING = METHODS[-2:]

#: Voxels along each axis where the scene's author leaves the choice to us.
_SPATIAL_GRID, _VISIBILITY_GRID = 32, 16


@dataclass(frozen=True)
class LightSampling:
    """How lights are chosen and shadow rays are rejected.

    The attributes are the parameters of the plugins that use it; see ``neepp`` for their meaning.
    The last one is the plugin's name, for errors.
    """

    light_sampling: str
    rejection: bool
    grid: int
    max_memory: float
    pilot_spp: int
    refine: int
    law: str
    slope: float
    floor: float
    load_map: str
    save_map: str
    plugin: str

    @classmethod
    def from_properties(
        cls, integrator: WalkIntegrator, props: mi.Properties, light_sampling: str, rejection: bool
    ) -> LightSampling:
        """Reads the parameters of a scene, but for the first two, which plugins name differently.

        Raises:
            TypeError, ValueError: A parameter has a wrong type or value, or would have no effect.
        """
        get = integrator.parameter
        sampling = cls(
            light_sampling=light_sampling,
            rejection=rejection,
            # Chosen later where the scene does not say
            grid=get(props, "grid", 1, minimum=1, maximum=1024) if "grid" in props else 0,
            max_memory=get(props, "max_memory", 512.0, minimum=1e-3),
            pilot_spp=get(props, "pilot_spp", 16, minimum=0),
            refine=get(props, "refine", 16, minimum=0, maximum=1024),
            law=get(props, "law", "affine", choices=("affine", "paper")),
            slope=get(props, "slope", 10.0, minimum=0.0),
            floor=get(props, "floor", 0.1, minimum=1e-6, maximum=1.0),
            load_map=get(props, "load_map", ""),
            save_map=get(props, "save_map", ""),
            plugin=integrator.name,
        )
        for key, (is_met, condition) in sampling._conditions().items():
            if key in props and not is_met:
                raise ValueError(
                    f'"{integrator.name}": the parameter "{key}" needs {condition}; leave it out'
                )
        return sampling

    def parameters(self) -> dict[str, Any]:
        """Names and values of all parameters that have an effect."""
        conditions = self._conditions()
        return {
            key: value
            for key, value in vars(self).items()
            if key != "plugin" and conditions.get(key, (True, ""))[0]
        }

    def _conditions(self) -> dict[str, tuple[bool, str]]:
        """What parameters need to have an effect: is it so, and how to say it."""
        learns = self.light_sampling in LEARNING
        is_affine = self.rejection and self.law == "affine"
        has_table = learns or self.rejection or self.light_sampling == "spatial"
        learning = f"lights that are chosen by what was learned ({' or '.join(LEARNING)})"
        rejecting = "shadow rays that are rejected"
        table = (has_table, f"{learning} or spatially, or {rejecting}")
        affine = (is_affine, f"{rejecting} by the affine law")
        return {
            "grid": table,
            "max_memory": table,
            "pilot_spp": (learns or self.rejection, f"{learning}, or {rejecting}"),
            "refine": (self.rejection and not learns, f"{rejecting}, and lights not learned"),
            "law": (self.rejection, rejecting),
            "slope": affine,
            "floor": affine,
            "load_map": (learns, learning),
            "save_map": (learns, learning),
        }

    def decisions(self, scene: mi.Scene) -> dict[str, Any]:
        """What needs no learning. A single light needs no choice."""
        if len(scene.emitters()) < 2:
            return {}
        if self.light_sampling == "linear":
            return {"next_event": LinearSelection(scene)}
        if self.light_sampling == "power":
            cells = LightCells(scene, None)
            return {"next_event": LightSelection(OneRow(), cells, power_weights(scene, cells))}
        if self.light_sampling == "spatial" and scene_bounds(scene).valid():
            cells = LightCells(scene, None)
            rows = self.voxel_rows(scene, cells.count)
            return {"next_event": LightSelection(rows, cells, spatial_weights(scene, rows, cells))}
        return {}

    def voxel_rows(self, scene: mi.Scene, cells: int) -> VoxelRows:
        """Voxels for ``spatial``, not more than there is memory for."""
        grid = self.grid or _SPATIAL_GRID
        rows = VoxelRows(VoxelGrid(scene, grid))
        limit = self.max_memory * 2**20 / (cells * TABLE_BYTES)
        while rows.count > limit and rows.voxels.resolution > 1:
            rows = VoxelRows(VoxelGrid(scene, int(0.8 * rows.voxels.resolution)))
        if self.grid > rows.voxels.resolution:
            mi.Log(
                mi.LogLevel.Warn,
                f"The table of grid={grid} would exceed max_memory={self.max_memory:g} MiB: "
                f"grid={rows.voxels.resolution} is used.",
            )
        return rows

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        """The samples of the pilots, at most a quarter of all: beyond that there is little left to
        gain. What the first ones learn makes the later ones better."""
        samples = min(self.pilot_spp, spp // 4)
        if samples == 0 or not self._can_learn(scene):
            if self.save_map and not self.load_map:
                mi.Log(mi.LogLevel.Warn, f'Nothing is learned: "{self.save_map}" is not written.')
            return []
        if self.light_sampling not in LEARNING or samples < 4:
            return [samples]
        return [samples // 4, samples - samples // 4]

    def learners(self, scene: mi.Scene, samples: int) -> list[Learner]:
        """Who learns from ``samples`` pilot samples (of all pixels together).

        Raises:
            ValueError: The map that is going to be learned cannot be written.
        """
        if self.save_map:
            try:
                check_target(Path(self.save_map))
            except InputError as error:
                raise ValueError(f'"{self.plugin}": "save_map": {error}') from None
        if not self._can_learn(scene) or (samples == 0 and not self.load_map):
            return []
        law = {"law": self.law, "slope": self.slope, "floor": self.floor}
        if self.light_sampling in LEARNING:
            return [
                LightLearner(
                    self.light_sampling,
                    law if self.rejection else None,
                    self.grid,
                    int(self.max_memory * 2**20),
                    samples,
                    Path(self.load_map) if self.load_map else None,
                    Path(self.save_map) if self.save_map else None,
                    self.plugin,
                )
            ]
        if samples == 0:
            return []
        grid = self.grid or _VISIBILITY_GRID
        return [VisibilityLearner(grid, self.max_memory, self.refine, **law)]

    def _can_learn(self, scene: mi.Scene) -> bool:
        if self.light_sampling in LEARNING:
            return bool(scene.emitters()) and bool(scene.shapes())
        return self.rejection and has_lights_at_points(scene)
