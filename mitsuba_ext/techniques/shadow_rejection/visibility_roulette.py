"""Russian roulette on the shadow ray, by learned visibility.

Source: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, sections 3.3.1 and
4.1 (= Guo's thesis, sections 3.3.3.1 and 3.4.1).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.bounds import scene_bounds
from ...scene.regions.voxel_grid import EMPTY
from ...transport.path_decisions import ShadowTest
from ...transport.rejection_law import RejectionLaw, rejected_share
from .visibility_map import VisibilityMap


class VisibilityRoulette(ShadowTest):
    """Tests a connection with a probability that grows with the visibility of its voxels.

    Connections to points for which the map has no entry (at infinity, in voxels without geometry,
    on lights that the pilot did not sample) are always tested.

    Parameters:
        visibility: The learned map, which must have seen a light.
        law: The probability of a test.

    Attributes:
        rejected_share (float): Of the recorded segments that end on a light, the share that the
            roulette would not test.
    """

    def __init__(self, visibility: VisibilityMap, law: RejectionLaw) -> None:
        self.voxels = visibility.voxels
        # Connections end on lights: of the whole map, only the columns of the lights' voxels are
        # kept, which fit into the cache
        lights = visibility.light_voxels()
        voxel_count, light_count = self.voxels.occupied_count, len(lights)
        self._column = dr.full(mi.UInt32, EMPTY, voxel_count)
        dr.scatter(self._column, dr.arange(mi.UInt32, light_count), lights)
        # Opaque: the number of columns differs from seed to seed, and the kernel must not
        self._light_count = dr.opaque(mi.UInt32, light_count)
        index = dr.arange(mi.UInt32, voxel_count * light_count)
        voxel = index // self._light_count
        light = dr.gather(mi.UInt32, lights, index - voxel * self._light_count)
        entry = visibility.entry_of(voxel, light)
        # The paper's law: plain ratios, and ε where no success was seen (section 3.2)
        self._p = law.probability(
            lambda: visibility.ratio(entry), lambda: visibility.posterior_mean(entry)
        )
        dr.eval(self._column, self._p)
        self.rejected_share = rejected_share(self._p, visibility.test_count(entry))

    def probability(self, state, choice, si, ds, active):
        voxel, active = self.voxels.index(si.p, active)
        light, active = self.voxels.index(ds.p, active)
        column = dr.gather(mi.UInt32, self._column, light, active)
        known = active & (column != EMPTY)
        p = dr.gather(mi.Float, self._p, voxel * self._light_count + column, known)
        return dr.select(known, p, 1), state


def has_lights_at_points(scene: mi.Scene) -> bool:
    """Whether there is a light in the voxels of the map. (Lights at infinity, and point lights
    outside of the bounds of the shapes, are not.)"""
    bounds = scene_bounds(scene)
    if not bounds.valid():
        return False
    at_point = int(mi.EmitterFlags.DeltaPosition)
    return any(
        mi.has_flag(e.flags(), mi.EmitterFlags.Surface)
        or (int(e.flags()) & at_point and bounds.contains(e.bbox().min))
        for e in scene.emitters()
    )
