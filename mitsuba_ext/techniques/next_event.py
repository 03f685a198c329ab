"""The slot ``next_event``: which light a vertex is connected to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..planning.decision_parameters import DecisionParameters, ParameterReader, Setting, Slots
from ..planning.learner import Learner
from ..rendering.camera import film_extent
from ..scene.bounds import scene_bounds
from ..scene.lights.light_cells import LightCells
from ..scene.lights.shutter_times import ShutterTimes
from ..scene.lights.weights import VoxelRows, power_weights, spatial_weights
from ..scene.portals import portals
from ..scene.regions.voxel_grid import VoxelGrid
from ..transport.light_table import TABLE_BYTES, LightTable, OneRow
from ..util import archives
from ..util.arrays import from_numpy
from ..util.errors import InputError
from .learned_lights import light_map_file
from .learned_lights.learner import LightMapLearner
from .linear_lights.linear_lights import LinearChoice
from .portal_lights.portal_sampling import PortalSampling
from .resampled_lights.resampled_lights import ResampledLights
from .two_stage_lights.environment_partition import MOST_SPLITS
from .two_stage_lights.learner import VisibilityLearner
from .two_stage_lights.two_stage import TwoStage

#: Number of candidates that take about as long as a path.
_CANDIDATES_PER_PATH = 32

#: Voxels along each axis for ``spatial``, where the scene's author does not say.
_SPATIAL_GRID = 32


class PowerLights(DecisionParameters):
    """Chooses lights by their power."""

    name = "power"
    slots = ("next_event",)

    def decision(self, setting: Setting) -> Any | None:
        if len(setting.scene.emitters()) < 2:
            return None
        cells = LightCells(setting.scene, None)
        return LightTable(OneRow(), cells, power_weights(setting.scene, cells))


def sampling_weights(scene: mi.Scene) -> LightTable:
    """The light sampling of ``path``, but with the true densities of points on meshes with
    interpolated normals."""
    cells = LightCells(scene, None)
    number = from_numpy(mi.UInt32, cells.emitter_index)
    probability = np.broadcast_to(scene.pdf_emitter(number).numpy(), cells.count)
    return LightTable(OneRow(), cells, from_numpy(mi.Float, probability * cells.share))


class LinearLights(DecisionParameters):
    """Chooses lights by an estimate of what each contributes to the vertex."""

    name = "linear"
    slots = ("next_event",)
    sees_media = False

    def decision(self, setting: Setting) -> Any | None:
        return LinearChoice(setting.scene) if len(setting.scene.emitters()) > 1 else None


class SpatialLights(DecisionParameters):
    """Chooses lights by their unoccluded contribution to a voxel. The attributes are the parameters
    of the plugin ``spatial_lights``; see there."""

    name = "spatial_lights"
    slots = ("next_event",)

    def __init__(self, read: ParameterReader) -> None:
        self.grid = _grid(read)
        self.max_memory = read("max_memory", 512.0, minimum=1e-3)

    def decision(self, setting: Setting) -> Any | None:
        scene = setting.scene
        if len(scene.emitters()) < 2 or not scene_bounds(scene).valid():
            return None
        cells = LightCells(scene, None)
        times = ShutterTimes(scene, setting.sensor)
        rows = self.voxel_rows(scene, cells.count, times)
        return LightTable(rows, cells, spatial_weights(scene, rows, cells))

    def voxel_rows(self, scene: mi.Scene, cells: int, times: ShutterTimes) -> VoxelRows:
        """The voxels, at most as many as ``max_memory`` allows."""
        rows = VoxelRows(VoxelGrid(scene, self.grid or _SPATIAL_GRID), times)
        limit = self.max_memory * 2**20 / (cells * TABLE_BYTES)
        while rows.count > limit and rows.resolution > 1:
            rows = VoxelRows(VoxelGrid(scene, int(0.8 * rows.resolution)), times)
        if self.grid > rows.resolution:
            mi.Log(
                mi.LogLevel.Warn,
                f"The table of grid={self.grid} would exceed max_memory={self.max_memory:g} MiB: "
                f"grid={rows.resolution} is used.",
            )
        return rows

    def parameters(self, *slots: Slots) -> dict[str, Any]:
        return {**super().parameters(*slots), "grid": self.grid or "automatic"}


class LearnedLights(DecisionParameters):
    """Chooses lights by what the pilots' samples found. The attributes are the parameters of the
    plugin ``learned_lights``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name = "learned_lights"
    slots = ("next_event",)
    pilot_spp, tries = 16, True

    def __init__(self, read: ParameterReader, target: str = "") -> None:
        self.target = target or read("target", TARGETS[0], choices=TARGETS)
        self.grid = _grid(read)
        self.max_memory = read("max_memory", 512.0, minimum=1e-3)
        self.load_map = read("load_map", "")
        self.save_map = read("save_map", "")
        self._plugin = read.plugin

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        learns = spp > 0 and bool(scene.emitters()) and bool(scene.shapes())
        if self.save_map and not self.load_map and not learns:
            mi.Log(mi.LogLevel.Warn, f'Nothing is learned: "{self.save_map}" is not written.')
        return learns

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        """
        Raises:
            ValueError: The file ``save_map`` cannot be written.
        """
        if self.save_map:
            try:
                archives.check_target(Path(self.save_map), light_map_file.FORM)
            except InputError as error:
                raise ValueError(f'"{self._plugin}": "save_map": {error}') from None
        scene = setting.scene
        if not scene.emitters() or not scene.shapes():
            return None
        if setting.pilot_spp == 0 and not self.load_map:
            return None
        return LightMapLearner(
            self.target,
            self.grid,
            int(self.max_memory * 2**20),
            setting.pilot_samples,
            film_extent(setting.sensor.film())[0],
            setting.pixel_count * setting.spp,
            Path(self.load_map) if self.load_map else None,
            Path(self.save_map) if self.save_map else None,
            self._plugin,
        )

    def parameters(self, *slots: Slots) -> dict[str, Any]:
        return {**super().parameters(*slots), "grid": self.grid or "automatic"}


class ResampledLightsChoice(DecisionParameters):
    """Chooses one of several candidate lights by what each would contribute. The attributes are the
    parameters of the plugin ``resampled_lights``; see there."""

    name = "resampled_lights"
    slots = ("next_event",)
    camera_paths_only = True
    sees_media = False

    def __init__(self, read: ParameterReader) -> None:
        self.candidates = read("candidates", 8, minimum=1, maximum=1024)

    @property
    def sample_cost(self) -> int:
        return 1 + self.candidates // _CANDIDATES_PER_PATH

    def decision(self, setting: Setting) -> Any | None:
        if not setting.scene.emitters():
            return None
        return ResampledLights(setting.scene, self.candidates)


#: What two-stage sampling can learn about visibility, the default first; and the pilots' samples
#: per pixel for it.
VISIBILITIES = ("unknown", "primary", "world")
_PILOT_SPP = 4


class TwoStageLights(DecisionParameters):
    """Samples directions of the environment by the product of BSDF and light. The attributes are
    the parameters of the plugin ``two_stage_lights``; see there."""

    name = "two_stage_lights"
    slots = ("next_event",)
    camera_paths_only = True
    sees_media = False

    def __init__(self, read: ParameterReader, visibility: str = "") -> None:
        self.splits = read("splits", 16, minimum=0, maximum=MOST_SPLITS)
        self.vertices = read("vertices", "first", choices=("first", "all"))
        self.visibility = visibility or read("visibility", "unknown", choices=VISIBILITIES)
        if self.learns:
            self.reallocated = read("reallocated", 0.9, minimum=0.0, maximum=0.99)
        read.refuse_without_effect({"reallocated": 'a "visibility" that is learned'})

    @property
    def learns(self) -> bool:
        """Does it learn the visibility?"""
        return self.visibility != "unknown"

    @property
    def pilot_spp(self) -> int:
        return _PILOT_SPP if self.learns else 0

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return self.learns and spp > 0 and scene.environment() is not None

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return VisibilityLearner(
            self.visibility, self.splits, self.vertices == "all", self.reallocated,
            *film_extent(setting.sensor.film()),
        )  # fmt: skip

    def decision(self, setting: Setting) -> Any | None:
        if setting.scene.environment() is None or setting.max_depth < 2:
            return None
        if self.can_learn(setting.scene, setting.pilot_spp):
            return None  # the learner makes the decisions of all stages
        return TwoStage(setting.scene, self.splits, self.vertices == "all")


class PortalLights(DecisionParameters):
    """Samples directions of the environment through portals. The attributes are the parameters of
    the plugin ``portal_lights``; see there."""

    name = "portal_lights"
    slots = ("next_event",)
    camera_paths_only = True

    def __init__(self, read: ParameterReader) -> None:
        self.share = read("share", 0.9, minimum=0.0, maximum=0.99)

    def decision(self, setting: Setting) -> Any | None:
        scene = setting.scene
        if scene.environment() is None or not portals(scene) or self.share == 0:
            return None
        return PortalSampling(scene, self.share)


#: What the map of :class:`LearnedLights` can learn of each light, the default first.
TARGETS = ("contribution", "visibility")

#: Ways to choose a light, and what reads the parameters of each; ``None`` for that of ``path``.
METHODS: dict[str, Callable[[ParameterReader], DecisionParameters] | None] = {
    "uniform": None,
    "power": lambda read: PowerLights(),
    "spatial": SpatialLights,
    "linear": lambda read: LinearLights(),
    "visibility": lambda read: LearnedLights(read, "visibility"),
    "contribution": lambda read: LearnedLights(read, "contribution"),
}

#: Further ways, for integrators without light paths.
CAMERA_METHODS: dict[str, Callable[[ParameterReader], DecisionParameters]] = {
    "resampled": ResampledLightsChoice,
    "two_stage": TwoStageLights,
    "triple_product": lambda read: TwoStageLights(read, "primary"),
    "portals": PortalLights,
}


def _grid(read: ParameterReader) -> int:
    """Voxels along each axis; 0 if the scene does not give a number."""
    return read("grid", 1, minimum=1, maximum=1024) if read.is_given("grid") else 0
