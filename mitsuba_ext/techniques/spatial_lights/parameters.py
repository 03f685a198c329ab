"""Lights that are chosen by their power, or by their unoccluded contribution to a voxel."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ...planning.technique import ParameterReader, Setting, Slots, Technique
from ...scene.bounds import scene_bounds
from ...scene.lights.light_cells import LightCells
from ...scene.lights.shutter_times import ShutterTimes
from ...scene.lights.weights import VoxelRows, power_weights, spatial_weights
from ...scene.regions.voxel_grid import VoxelGrid
from ...transport.light_table import TABLE_BYTES, LightTable, OneRow

#: Voxels along each axis, where the scene's author does not say.
_SPATIAL_GRID = 32


class PowerLights(Technique):
    """Chooses lights by their power."""

    name = "power"
    slots, words = ("next_event",), {"power": {}}

    def decision(self, setting: Setting) -> Any | None:
        if len(setting.scene.emitters()) < 2:
            return None
        cells = LightCells(setting.scene, None)
        return LightTable(OneRow(), cells, power_weights(setting.scene, cells))


class SpatialLights(Technique):
    """Chooses lights by their unoccluded contribution to a voxel. The attributes are the parameters
    of the plugin ``spatial_lights``; see there."""

    name, is_plugin = "spatial_lights", True
    slots, words = ("next_event",), {"spatial": {}}

    def __init__(self, read: ParameterReader) -> None:
        self.grid = read.optional_count("grid", 1024)
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


TECHNIQUES = PowerLights, SpatialLights
