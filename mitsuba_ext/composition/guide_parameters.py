"""The parameters of path guiding: which directions, and who learns them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi

from ..decisions.directions.guide_learner import GuideLearner
from ..decisions.directions.surface_regions import SurfaceRegions
from ..decisions.directions.tile_regions import MOST_BOUNCES, TileRegions
from ..decisions.learner import Learner
from ..rendering import camera

if TYPE_CHECKING:
    from ..decisions.directions.guided_directions import GuidedDirections
    from .walk_integrator import WalkIntegrator

#: Samples that a region of surfaces has in the pilots, at least.
_REGION_SAMPLES = 64


class Guiding:
    """How directions are guided. The attributes are the parameters of ``pss_guided``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    def __init__(self, integrator: WalkIntegrator, props: mi.Properties) -> None:
        get = integrator.parameter
        self.regions = get(props, "regions", "surfaces", choices=("surfaces", "tiles"))
        if self.regions == "tiles":
            self.tile = get(props, "tile", 16, minimum=1)
            self.bounces = get(props, "bounces", 2, minimum=1, maximum=MOST_BOUNCES)
        else:
            self.bounces = get(props, "bounces", 6, minimum=1, maximum=64)
        self.pilot_spp = get(props, "pilot_spp", 32, minimum=0)
        self.always_guide = get(props, "always_guide", False)
        self.max_memory = get(props, "max_memory", 512.0, minimum=1e-3)
        self._learner: GuideLearner | None = None

    @property
    def learner(self) -> GuideLearner | None:
        """Who learned in the last render; ``None`` where there was no pilot."""
        return self._learner

    @property
    def guide(self) -> GuidedDirections | None:
        """What the last render has learned."""
        return self._learner.guide if self._learner is not None else None

    def pilots(self, scene: mi.Scene, spp: int, max_depth: int) -> list[int]:
        """The samples of the pilots: a quarter of all, at most. The first ones teach what the
        second ones test; the third ones are drawn from the better trees of both."""
        self._learner = None
        samples = min(self.pilot_spp, spp // 4)
        if samples < 3 or max_depth < 2 or not scene.emitters():
            return []
        first = samples // 4 or 1
        return [first, first, samples - 2 * first]

    def learners(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        samples: int,
        max_depth: int,
        rr_depth: int,
    ) -> list[Learner]:
        """Who learns from ``samples`` pilot samples (of all pixels together)."""
        if samples == 0:
            return []
        width, height = camera.film_extent(sensor.film())

        def tiles(p: mi.Point3f, n: mi.Normal3f) -> TileRegions:
            return TileRegions(width, height, self.tile)

        def surfaces(p: mi.Point3f, n: mi.Normal3f) -> SurfaceRegions:
            # The scout has one path in each pixel
            return SurfaceRegions(p, n, max(1.0, _REGION_SAMPLES * width * height / samples))

        by_tiles = self.regions == "tiles"
        self._learner = GuideLearner(
            tiles if by_tiles else surfaces,
            not by_tiles,
            min(self.bounces, max_depth - 1),
            int(self.max_memory * 2**20),
            samples,
            self.always_guide,
            # What bounces bring depends on where they are, of which tiles know nothing
            rr_depth=None if by_tiles or rr_depth >= max_depth else rr_depth,
            film_width=width,
        )
        return [self._learner]

    def parameters(self) -> dict[str, Any]:
        """What ``str()`` of the integrator shows."""
        return {key: value for key, value in vars(self).items() if not key.startswith("_")}
