"""A technique of your own: connect a vertex to the light that is nearest to it.

    mitsuba-ext compare scenes/rooms.xml --plugin examples/nearest_light.py --size 160x90 \\
        --spp 16 path "composed_path:next_event=[nearest_light:share=0.7]"

``docs/add_a_technique.md`` explains each step.
"""

from __future__ import annotations

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.bases.decision_plugin import register
from mitsuba_ext.planning.technique import ParameterReader, Setting, Technique
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.transport.light_table import LightTable
from mitsuba_ext.util.arrays import from_numpy

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

#: The coordinates of lights without a position: an environment is never the nearest light.
FAR_AWAY = 1e15


class NearestLight:
    """Maps each surface point to a row of the table: the index of the light nearest to it.

    Parameters:
        scene: The scene; the position of a light is the centre of its bounding box.
    """

    def __init__(self, scene: mi.Scene) -> None:
        boxes = [emitter.bbox() for emitter in scene.emitters()]
        centres = [box.center() if box.valid() else [FAR_AWAY] * 3 for box in boxes]
        self.count = len(centres)
        self._centres = from_numpy(mi.Float, np.array(centres, np.float32).ravel())

    @dr.syntax
    def row(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        index, nearest, least = mi.UInt32(0), mi.UInt32(0), mi.Float(dr.inf)
        while active & (index < self.count):
            centre = dr.gather(mi.Point3f, self._centres, index)
            distance = dr.squared_norm(centre - si.p)
            is_nearer = distance < least
            nearest, least = dr.select(is_nearer, index, nearest), dr.minimum(distance, least)
            index += 1
        return nearest


class NearestLights(Technique):
    """Reads the parameters, and makes the decision for a render.

    Attributes:
        share: Probability of the nearest light. All lights share the rest: without it, the image
            would lack the light of all others.
    """

    name, slots = "nearest_light", ("next_event",)

    def __init__(self, read: ParameterReader) -> None:
        self.share = read("share", 0.7, minimum=0.0, maximum=0.95)

    def decision(self, setting: Setting) -> LightTable | None:
        count = len(setting.scene.emitters())
        if count < 2:
            return None  # nothing to choose: the kernel is path's
        weights = self.share * np.eye(count) + (1 - self.share) / count
        table = from_numpy(mi.Float, weights.astype(np.float32).ravel())
        return LightTable(NearestLight(setting.scene), LightCells(setting.scene, None), table)


register(NearestLights)
