"""The slot ``caustics``: how paths find light that smooth glass and mirrors lead to a vertex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ....planning.technique import Setting, Technique
from ....scene.movers import movers
from ....transport.estimator import Estimator
from ....transport.heroes import disperses
from ....transport.queries.scene import scene_query
from ....transport.walk import Walk
from .casters import Casters
from .connections import ManifoldConnections
from .manifold_tracer import ManifoldTracer


@dataclass(frozen=True)
class ManifoldCaustics:
    """Connects the vertices of a walk through casters.

    Parameters (and attributes):
        connections: The connections.
    """

    connections: ManifoldConnections

    def around(self, walk: Walk) -> Estimator:
        """``walk``, with these connections."""
        return ManifoldTracer(walk, self.connections)


class Manifold(Technique):
    """Connects vertices to lights through one or two smooth surfaces, where the scene has such
    surfaces."""

    name = "manifold"
    slots, words = ("caustics",), {"manifold": {}}
    camera_paths_only, sees_media = True, False

    def check_together(self, plugin, slots):
        if "scattering" in slots:
            raise ValueError(
                f'"{plugin}": the parameter "caustics" is "manifold", which knows the densities of '
                f'BSDFs only: leave "scattering" out'
            )

    def decision(self, setting: Setting) -> Any | None:
        scene = setting.scene
        # A chain has at least three segments. Moving or dispersive scenes are left to scattering
        if setting.max_depth < 3 or not scene.emitters() or movers(scene):
            return None
        if mi.is_spectral and disperses(scene.shapes()):
            return None
        casters = Casters(scene)
        if not casters.exist:
            return None
        connections = ManifoldConnections(scene, scene_query(scene), casters, setting.max_depth)
        return ManifoldCaustics(connections)


TECHNIQUES = (Manifold,)
