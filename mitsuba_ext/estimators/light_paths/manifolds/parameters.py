"""The slot ``caustics``: how paths find light that smooth glass and mirrors lead to a vertex."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ....planning.technique import Setting, Technique
from ....scene.movers import movers
from ....transport.estimator import Estimator
from ....transport.heroes import disperses
from ....transport.queries.scene import scene_query
from ....transport.walk import Walk
from .casters import Casters, casters_of
from .connections import ManifoldConnections
from .manifold_tracer import ManifoldTracer
from .seed_learner import ChainRecords, SeedLearner
from .seeds import SeedMap

#: The segments of the shortest path through a caster: to a surface, to the caster, to a light.
_SHORTEST = 3


@dataclass(frozen=True)
class ManifoldCaustics:
    """Connects the vertices of a walk through casters.

    Parameters (and attributes):
        connections: The connections.
        record: Called with the chains of each pass; ``None`` if nothing learns from them.
    """

    connections: ManifoldConnections
    record: Callable[[ChainRecords], None] | None = None

    def around(self, walk: Walk) -> Estimator:
        """``walk``, with these connections."""
        return ManifoldTracer(walk, self.connections, self.record)


class Manifold(Technique):
    """Connects vertices to lights through one or two smooth or slightly rough surfaces, where the
    scene has such surfaces."""

    name = "manifold"
    slots, words = ("caustics",), {"manifold": {}}
    camera_paths_only, sees_media = True, False
    #: Most scenes of docs/results/caustics.md take 3 to 6 times as long as with ``path``. A sample
    #: stores a vertex, a task and its result besides its ray.
    sample_cost, sample_bytes = 4, 288
    pilot_spp = 16
    #: Trials of a chain end after this number. In pool, one chain in 10^6 needs more.
    most_trials = 1 << 16

    def check_together(self, plugin, slots):
        if "scattering" in slots:
            raise ValueError(
                f'"{plugin}": the parameter "caustics" is "{self.name}", which knows the densities '
                f'of BSDFs only: leave "scattering" out ("direction_map" in "swarm_path")'
            )

    def can_learn(self, scene, spp):
        return spp > 0 and not no_effect(scene)

    def decision(self, setting):
        if setting.pilot_spp > 0:
            return None  # :meth:`learner` decides
        make = self._maker(setting)
        return None if make is None else make(SeedMap(), None)

    def learner(self, setting, others):
        make = self._maker(setting) if setting.pilot_spp > 0 else None
        return None if make is None else SeedLearner(make)

    def _maker(self, setting: Setting) -> Callable[[SeedMap, Any], ManifoldCaustics] | None:
        """What makes the decision from seeds; ``None`` where nothing is connected."""
        scene = setting.scene
        if reason := no_effect(scene, setting.max_depth):
            what = f'"{setting.plugin}": the parameter "caustics" is "{self.name}"'
            mi.Log(mi.LogLevel.Warn, f"{what}, and has no effect: {reason}")
            return None
        query, depth = scene_query(scene), setting.max_depth
        casters = Casters(casters_of(scene))

        def make(seeds: SeedMap, record: Any) -> ManifoldCaustics:
            connections = ManifoldConnections(
                scene, query, casters, depth, seeds, self.most_trials
            )
            return ManifoldCaustics(connections, record)

        return make


def no_effect(scene: mi.Scene, max_depth: int = _SHORTEST) -> str:
    """Why nothing is connected through casters; empty if something is."""
    if not scene.emitters():
        return "the scene has no light"
    if max_depth < _SHORTEST:
        return f'"max_depth" is {max_depth}, and such paths have at least {_SHORTEST} segments'
    if not casters_of(scene):
        return (
            'no mesh, sphere, rectangle, disk or cylinder has a "dielectric" or "conductor" (or a '
            "rough one with a roughness of at most 0.1) without bump, normal or opacity map"
        )
    if movers(scene):
        return "things move"
    if mi.is_spectral and disperses(scene.shapes()):
        return "glass disperses light"
    return ""


class BoundedManifold(Manifold):
    """The same with few trials, which makes no pixel very bright, and some too dark."""

    name, words = "bounded_manifold", {"bounded_manifold": {}}
    most_trials = 64


TECHNIQUES = Manifold, BoundedManifold
