"""The slot ``subpath_selection``: to which light vertices a camera vertex is connected."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from ....planning.learner import Learner
from ....planning.pixel_estimates import brightness
from ....planning.technique import Setting, Technique
from ....rendering.camera import film_extent
from ....scene.movers import movers
from ....scene.regions.surface_voxels import lit_normal
from ....transport.queries.scene import scene_query
from ..both_ends import from_both_ends
from ..emission import LightEmission
from ..light_walk import LightWalk
from .region_learner import LightVertexSample, RegionLearner

#: Number of light paths that show where light vertices are.
_PATHS = 1 << 15


class LearnedSubpaths(Technique):
    """Chooses light vertices by how much the vertices in their region contributed in the pilots."""

    name = "visibility"
    slots, words = ("subpath_selection",), {"visibility": {}}
    pilot_spp, tries, sees_media = 16, True, False

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        is_shared = not mi.is_spectral and not movers(scene)
        return spp > 0 and is_shared and bool(scene.emitters()) and bool(scene.shapes())

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        # Paths of fewer segments have no connection to a light vertex
        if setting.max_depth < 3 or not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return RegionLearner(
            lambda: _light_vertices(setting),
            setting.pilot_samples,
            film_extent(setting.sensor.film()),
        )


TECHNIQUES = (LearnedSubpaths,)


def _light_vertices(setting: Setting) -> LightVertexSample:
    """Traces light paths, and returns their vertices."""
    scene = setting.scene
    walk = LightWalk(
        LightEmission(scene), setting.max_depth, setting.rr_depth, query=scene_query(scene)
    )
    numbers = mi.load_dict({"type": "independent"})
    # The same for all seeds: the vertices decide the size of tables, and so change kernels
    numbers.seed(0, _PATHS)
    active = dr.full(mi.Bool, True, _PATHS)
    vertices, _ = walk.run(scene, numbers, mi.Float(0), mi.Ray3f().wavelengths, active)
    if vertices is None:
        return LightVertexSample(mi.Point3f(), mi.Normal3f(), mi.Float(), _PATHS)
    active = dr.full(mi.Bool, True, vertices.count)
    vertex = vertices.at(dr.arange(mi.UInt32, vertices.count), active)
    si = vertex.si
    n, β = lit_normal(from_both_ends(si)), brightness(vertex.β)
    finite = dr.compress(dr.all(dr.isfinite(si.p) & dr.isfinite(n)) & dr.isfinite(β))
    return LightVertexSample(
        dr.gather(mi.Point3f, si.p, finite), dr.gather(mi.Normal3f, n, finite),
        dr.gather(mi.Float, β, finite), _PATHS,
    )  # fmt: skip
