"""The parameters of path guiding: of the directions of a path, and of its roulette."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Technique
from ...rendering.camera import film_extent
from ...scene.media import has_homogeneous_media, may_have_media, scene_media
from .distance_learner import DistanceLearner, UnguidedGrids
from .guided_roulette import RouletteLearner
from .learner import GuideLearner
from .regions_with_media import RegionsWithMedia
from .surface_regions import BYTES_PER_REGION, SurfaceRegions
from .tile_regions import MOST_BOUNCES, TileRegions

#: The fewest pilot samples that a region of surfaces should have. (With 64, trees are no better,
#: and learning takes up to a fifth longer: docs/results/auto_path.md.)
_REGION_SAMPLES = 256


class Guided(Technique):
    """Guides directions in primary sample space. The attributes are the parameters of the plugin
    ``guided_directions``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name = "guided_directions"
    slots, is_plugin = ("directions",), True
    words = {"guided": {}}
    pilot_spp, tries, finds_all_light = 32, True, True

    def __init__(self, read: ParameterReader) -> None:
        self.regions = read("regions", "surfaces", choices=("surfaces", "tiles"))
        if self.regions == "tiles":
            self.tile = read("tile", 16, minimum=1)
            self.bounces = read("bounces", 2, minimum=1, maximum=MOST_BOUNCES)
        else:
            self.bounces = read("bounces", 6, minimum=1, maximum=64)
        self.always_guide = read("always_guide", False)
        self.max_memory = read("max_memory", 512.0, minimum=1e-3)

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        # Trees are built from the first pilot and tested in the second; the third one is drawn from
        # better trees, built from both
        return spp >= 3 and bool(scene.emitters())

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        samples = setting.pilot_samples
        width, height = film_extent(setting.sensor.film())

        def tiles(p: mi.Point3f, n: mi.Normal3f) -> TileRegions:
            return TileRegions(width, height, self.tile)

        kind = RegionsWithMedia if may_have_media(setting.scene) else SurfaceRegions

        def surfaces(p: mi.Point3f, n: mi.Normal3f) -> SurfaceRegions:
            # The scout has one path in each pixel
            least = max(1.0, _REGION_SAMPLES * width * height / samples)
            # Records take the other half of the memory
            most = int(self.max_memory * 2**20 / 2) // BYTES_PER_REGION
            return kind(p, n, least, max(1, most))

        by_tiles = self.regions == "tiles"
        return GuideLearner(
            tiles if by_tiles else surfaces,
            not by_tiles,
            min(self.bounces, setting.max_depth - 1),
            int(self.max_memory * 2**20),
            samples,
            (width, height),
            self.always_guide,
        )


class GuidedRoulette(Technique):
    """Russian roulette by the radiance that a path is expected to add to its pixel, where
    directions are guided by regions of surfaces; elsewhere the roulette of Mitsuba's ``path``."""

    name, is_default = "automatic", True
    words = {"automatic": {}}
    slots, finds_all_light = ("roulette",), True

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        guide = others.get("directions")
        # A guide by tiles of the film learns nothing about the position of a bounce
        if not isinstance(guide, GuideLearner) or not guide.wants_scout:
            return None
        if setting.rr_depth >= setting.max_depth:
            return None
        return RouletteLearner(guide, setting.rr_depth)


class GuidedFlights(Technique):
    """How far paths fly in homogeneous media, by the light that they find there, where directions
    are guided by regions of surfaces; elsewhere by transmittance, as in Mitsuba's ``volpath``."""

    name, is_default = "automatic", True
    words = {"automatic": {}}
    slots, finds_all_light = ("flights",), True

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        guide = others.get("directions")
        if not isinstance(guide, GuideLearner) or not guide.wants_scout:
            return None
        if not has_homogeneous_media(setting.scene):
            has_grids = next(scene_media(setting.scene), None) is not None
            return UnguidedGrids(guide) if has_grids else None
        return DistanceLearner(guide, setting.sensor.shutter_open(), guide.always)


TECHNIQUES = Guided, GuidedRoulette, GuidedFlights
