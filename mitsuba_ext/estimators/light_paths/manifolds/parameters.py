"""The slot ``caustics``: how paths find light that smooth glass and mirrors lead to a vertex."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....planning.technique import Setting, Technique
from ....rendering.camera import film_extent
from ....scene.media import may_have_media
from ....scene.movers import movers
from ....transport.estimator import Estimator
from ....transport.heroes import disperses
from ....transport.queries.scene import scene_query
from ....transport.walk import Walk
from .casters import Casters, casters_of
from .caustic_learner import CausticLearner
from .connections import ManifoldConnections
from .manifold_tracer import SAMPLE_BYTES, ManifoldTracer, Recorder
from .seed_learner import SeedLearner
from .seeds import SeedMap

#: The segments of the shortest path through a caster: to a surface, to the caster, to a light.
_SHORTEST = 3

#: Where there are more casters, nothing is tried: a search in sixty pieces of glass takes thirty
#: times as long as a path.
_MOST_CASTERS = 16


#: Makes the decision from seeds, from what records chains, and from the stride of paths.
ManifoldMaker = Callable[..., "ManifoldCaustics"]


@dataclass(frozen=True)
class ManifoldCaustics:
    """Connects the vertices of a walk through casters.

    Parameters (and attributes):
        connections: The connections.
        record: See :class:`ManifoldTracer`.
        stride: One in ``stride`` paths is connected.
    """

    connections: ManifoldConnections
    record: Recorder | None = None
    stride: int = 1

    def around(self, walk: Walk) -> Estimator:
        """``walk``, with these connections."""
        return ManifoldTracer(
            walk, self.connections, self.record, dr.opaque(mi.UInt32, self.stride)
        )


class Manifold(Technique):
    """Connects vertices to lights through one or two surfaces of smooth glass or metal, or slightly
    rough glass, where the scene has such surfaces."""

    name = "manifold"
    slots, words = ("caustics",), {"manifold": {}}
    camera_paths_only, sees_media = True, False
    #: Most scenes of docs/results/caustics.md take 3 to 6 times as long as with ``path``
    sample_cost, sample_bytes = 4, SAMPLE_BYTES
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
        make = self._checked_maker(setting)
        return None if make is None else make(SeedMap(), None)

    def learner(self, setting, others):
        make = self._checked_maker(setting) if setting.pilot_spp > 0 else None
        return None if make is None else SeedLearner(make)

    def _checked_maker(self, setting: Setting) -> ManifoldMaker | None:
        """What makes the decision; ``None`` where nothing is connected, with a warning."""
        if reason := no_effect(setting.scene, setting.max_depth):
            what = f'"{setting.plugin}": the parameter "caustics" is "{self.name}"'
            mi.Log(mi.LogLevel.Warn, f"{what}, and has no effect: {reason}")
            return None
        return self.maker(setting)

    def maker(self, setting: Setting) -> ManifoldMaker:
        """What makes the decision from seeds, record, and stride."""
        scene, depth = setting.scene, setting.max_depth
        query = scene_query(scene)
        # Made when they are first needed
        casters = functools.cache(lambda: Casters(casters_of(scene)))

        def make(
            seeds: SeedMap, record: Recorder | None, stride: int = 1
        ) -> ManifoldCaustics:
            connections = ManifoldConnections(
                scene, query, casters(), depth, seeds, self.most_trials
            )
            return ManifoldCaustics(connections, record, stride)

        return make


def no_effect(scene: mi.Scene, max_depth: int = _SHORTEST) -> str:
    """Why nothing is connected through casters; empty if something is."""
    if not scene.emitters():
        return "the scene has no light"
    if max_depth < _SHORTEST:
        return f'"max_depth" is {max_depth}, and such paths have at least {_SHORTEST} segments'
    if not casters_of(scene):
        return (
            'no mesh, sphere, rectangle, disk or cylinder has a "dielectric", a "conductor" or a '
            '"roughdielectric" with a roughness of at most 0.1, without bump, normal or opacity map'
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


class LearnedManifold(Manifold):
    """The same, where pilots show that it pays."""

    name, words = "learned_manifold", {"automatic": {}}
    #: Where it is not used, samples are those of ``path``
    sample_cost, sample_bytes, bytes_per_sample = 1, 0, SAMPLE_BYTES
    sees_media, tries = True, True

    def can_learn(self, scene, spp):
        return super().can_learn(scene, spp) and _may_cast(scene)

    def decision(self, setting):
        return None

    def learner(self, setting, others):
        scene = setting.scene
        if not self.can_learn(scene, setting.pilot_spp) or no_effect(scene, setting.max_depth):
            return None
        size = film_extent(setting.sensor.film())
        return CausticLearner(
            self.maker(setting), len(casters_of(scene)), size, setting.spp, setting.pilot_samples
        )


def _may_cast(scene: mi.Scene) -> bool:
    """Whether caustics may pay: not under a uniform sky alone, in media, or with many casters."""
    lights = {emitter.class_name() for emitter in scene.emitters()}
    is_uniform = lights <= {"ConstantBackgroundEmitter"}
    return not (is_uniform or may_have_media(scene)) and len(casters_of(scene)) <= _MOST_CASTERS


TECHNIQUES = Manifold, BoundedManifold, LearnedManifold
