"""Light maps of a floor under lamps, for the tests of what is learned from them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.lights.choice import Choice
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.regions.surface_voxels import SurfaceRows, region, voxel_edges
from mitsuba_ext.techniques.learned_lights.learner import LightMapLearner
from mitsuba_ext.techniques.learned_lights.light_map import LightMap
from mitsuba_ext.transport.path_decisions import EmitterSampling, LightNumbers


def lamp(*position: float, radiance: float = 1.0, size: float = 0.1, **more) -> dict:
    """A rectangle that shines downwards."""
    T = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": T().translate(list(position)).rotate([1, 0, 0], 180).scale(size),
        "emitter": {"type": "area", "radiance": radiance, **more},
    }


def floor(**more) -> mi.Scene:
    return mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}, **more})


def vertices(count: int = 2000) -> tuple[mi.Point3f, mi.Normal3f]:
    """Points of a floor, and normals that point up."""
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.uniform(-1, 1, (2, count)), np.zeros((1, count))]).astype(np.float32)
    return mi.Point3f(p), mi.Normal3f(np.tile([[0], [0], [1]], count).astype(np.float32))


def map_of(scene: mi.Scene, grid: int = 4) -> LightMap:
    p, n = vertices()
    rows = SurfaceRows(region(p), grid, p, n)
    return LightMap(scene, rows, LightCells(scene, voxel_edges(rows.bbox, grid)))


def surface(p, n=(0, 0, 1), width: int = 1) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, width)
    si.p, si.n = mi.Point3f(*p), mi.Normal3f(*n)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(0, 0, 1)
    return si


def connect(
    selection: EmitterSampling,
    scene: mi.Scene | None,
    sampler: mi.Sampler,
    si: mi.SurfaceInteraction3f,
) -> tuple[mi.DirectionSample3f, mi.Spectrum, Any, Any]:
    """A connection of each lane from ``si``, as the first of its path: the direction sample, its
    weight, the choice, and the state of ``selection`` when it leaves."""
    state, active = selection.begin(sampler, mi.Ray3f()), mi.Bool(True)
    place = selection.visit(state, scene, si, active)
    choices = {0: lambda: None, 1: sampler.next_1d, 2: sampler.next_2d}
    choice = choices[selection.choice_dimension]()
    numbers = LightNumbers(sampler.next_2d(), choice)
    ds, weight, chosen = selection.sample(place, scene, numbers, si, active)
    return ds, weight, chosen, selection.remember(place, scene, ds.d, mi.Float(0), active)


def vertex_at(depth: int, si: mi.SurfaceInteraction3f | None = None) -> SimpleNamespace:
    """What decisions about directions ask of a vertex."""
    return SimpleNamespace(si=si, depth=mi.UInt32(depth))


def observe(light_map: LightMap, cell: int, visible: int, blocked: int, value: float) -> None:
    si = surface((0.1, 0.1, 0), width=visible + blocked)
    row = light_map.rows.row(si, mi.Bool(True))
    choice = Choice(row, dr.full(mi.UInt32, cell, visible + blocked), mi.Float(0.5))
    arrived = dr.arange(mi.UInt32, visible + blocked) < visible
    # The contribution of an estimator that chose with probability 0.5
    light_map.connection(
        choice, vertex_at(0, si), None, mi.Color3f(value / 0.5), None, None, arrived, mi.Bool(True)
    )
    light_map.evaluate()


def row_of(light_map: LightMap, values: mi.Float) -> np.ndarray:
    row = int(light_map.rows.row(surface((0.1, 0.1, 0)), mi.Bool(True))[0])
    return values.numpy().reshape(-1, light_map.cells.count)[row]


def learner_of(scene: mi.Scene, **parameters) -> LightMapLearner:
    defaults = {"target": "contribution", "grid": 0, "max_memory": 2**26,
                "pilot_samples": 100_000, "film_size": (64, 64)}
    learner = LightMapLearner(**{**defaults, **parameters})
    learner.start(scene, *vertices())
    return learner
