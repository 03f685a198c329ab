"""Russian roulette on the shadow ray, by learned visibility.

Source: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, sections 3.3.1 and
4.1 (= Guo's thesis, sections 3.3.3.1 and 3.4.1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from ..learning.visibility_map import VisibilityMap
from ..learning.voxel_grid import EMPTY
from .defaults import AlwaysTest, ShadowTest

if TYPE_CHECKING:
    from ..integrator import Stage, WalkIntegrator

#: Initial value of a map entry in the paper; with its law, the least probability of a test.
_PAPER_EPSILON = 1e-4

#: Share of rejected segments below which looking them up costs more than it saves: by this measure
#: staircase has 0.05, kitchen 0.07 (which about breaks even), veach-ajar 0.2, door_ajar 0.5.
_WORTHWHILE = 0.05


class VisibilityRoulette(ShadowTest):
    """Tests a connection with a probability that grows with the visibility of its voxels.

    Connections to points that the map does not know (at infinity, in voxels without geometry, on
    lights that the pilot did not sample) are always tested.

    Parameters:
        visibility: The learned map, which must have seen a light.
        slope, floor: p = min(1, slope · V + floor).
        law: ``affine`` for the above, ``paper`` for p = max(V, 1e-4) (Eq. 2).
    """

    def __init__(self, visibility: VisibilityMap, slope: float, floor: float, law: str) -> None:
        self.voxels = visibility.voxels
        # Connections end on lights: of the whole map, the columns of their voxels are enough, and
        # stay in the cache.
        lights = visibility.light_voxels()
        voxel_count, light_count = self.voxels.occupied_count, len(lights)
        self._column = dr.full(mi.UInt32, EMPTY, voxel_count)
        dr.scatter(self._column, dr.arange(mi.UInt32, light_count), lights)
        # Opaque: the number of columns differs from seed to seed, the kernel must not
        self._light_count = dr.opaque(mi.UInt32, light_count)
        index = dr.arange(mi.UInt32, voxel_count * light_count)
        voxel = index // self._light_count
        light = dr.gather(mi.UInt32, lights, index - voxel * self._light_count)
        entry = visibility.entry_of(voxel, light)
        if law == "paper":
            # The paper's map holds plain ratios, and ε where no success was seen (section 3.2)
            self._p = dr.maximum(visibility.ratio(entry), _PAPER_EPSILON)
        else:
            self._p = dr.minimum(1, slope * visibility.posterior_mean(entry) + floor)
        dr.eval(self._column, self._p)
        # In integers: a share near the threshold must not depend on the order of a sum
        tests = mi.UInt64(visibility.test_count(entry))
        total, kept = dr.sum(tests), dr.sum(tests * mi.UInt64(self._p * 1024))
        #: Share of the segments that the map saw end on a light and that the law would not test.
        self.rejected_share = 1 - int(kept[0]) / (1024 * int(total[0]))

    def probability(
        self, state: Any, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool
    ) -> tuple[mi.Float, Any]:
        voxel, active = self.voxels.index(si.p, active)
        light, active = self.voxels.index(ds.p, active)
        column = dr.gather(mi.UInt32, self._column, light, active)
        known = active & (column != EMPTY)
        p = dr.gather(mi.Float, self._p, voxel * self._light_count + column, known)
        return dr.select(known, p, 1), state


@dataclass(frozen=True)
class Rejection:
    """Learning a visibility map in a pilot stage, and rejecting shadow rays with it in the next.

    The attributes are the parameters of the plugins that use it; see ``neepp`` for their meaning.
    """

    grid: int
    refine: int
    max_memory: float
    pilot_spp: int
    law: str
    slope: float
    floor: float

    @classmethod
    def from_properties(cls, integrator: WalkIntegrator, props: mi.Properties) -> Rejection:
        """Reads the parameters of a scene.

        Raises:
            TypeError, ValueError: A parameter has a wrong type or value.
        """
        get = integrator.parameter
        return cls(
            grid=get(props, "grid", 16, minimum=1, maximum=1024),
            refine=get(props, "refine", 16, minimum=0, maximum=1024),
            max_memory=get(props, "max_memory", 64.0, minimum=1e-3),
            pilot_spp=get(props, "pilot_spp", 4, minimum=0),
            law=get(props, "law", "affine", choices=("affine", "paper")),
            slope=get(props, "slope", 10.0, minimum=0.0),
            floor=get(props, "floor", 0.1, minimum=1e-6, maximum=1.0),
        )

    def stage_samples(self, integrator: WalkIntegrator, scene: mi.Scene, spp: int) -> list[int]:
        """The samples of the pilot and of the rest. The pilot takes at most a quarter of them:
        beyond that there is little left to save. It is left out where there is nothing to learn."""
        pilot = min(self.pilot_spp, spp // 4)
        if pilot == 0 or integrator.max_depth < 2 or not _has_lights_at_points(scene):
            return [spp]
        return [pilot, spp - pilot]

    def stages(
        self, integrator: WalkIntegrator, scene: mi.Scene, samples: list[int]
    ) -> Iterator[Stage]:
        """The pilot's walk, then the walk that rejects. Without a pilot every connection is
        tested."""
        if len(samples) == 1:
            yield integrator.stage()
            return
        visibility = VisibilityMap(scene, self.grid, int(self.max_memory * 2**20))
        yield integrator.stage(observer=visibility)
        visibility.refine(scene, self.refine)
        learned, shadow_test = str(visibility), AlwaysTest()
        if len(visibility.light_voxels()) > 0:
            roulette = VisibilityRoulette(visibility, self.slope, self.floor, self.law)
            if roulette.rejected_share >= _WORTHWHILE:
                shadow_test = roulette
            else:
                learned += f"; not used, it would reject only {roulette.rejected_share:.0%}"
        del visibility  # the counters: the final stage needs the roulette's table only
        yield integrator.stage(learned, shadow_test=shadow_test)


def _has_lights_at_points(scene: mi.Scene) -> bool:
    """Is there a light that the map can cover: not at infinity, nor outside its voxels?"""
    if not scene.shapes() or not scene.bbox().valid():
        return False
    at_point = int(mi.EmitterFlags.DeltaPosition)
    return any(
        mi.has_flag(e.flags(), mi.EmitterFlags.Surface)
        or (int(e.flags()) & at_point and scene.bbox().contains(e.bbox().min))
        for e in scene.emitters()
    )
