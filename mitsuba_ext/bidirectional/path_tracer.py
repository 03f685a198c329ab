"""The estimator of bidirectional path tracing."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from ..movers import movers
from ..transport.estimator import CameraRays, Sample
from ..transport.numbers import Numbers
from ..transport.path_decisions import SubpathSelection
from ..transport.walk import Walk
from .connections import LightSubpaths
from .emission import LightEmission
from .light_image import LightImage
from .light_vertices import LightVertices, VertexCache
from .light_walk import LightWalk
from .partial_sums import PartialSums
from .sensor import ConnectableSensor
from .vertex_choice import OwnVertexChoice, RegionChoice, VertexChoice
from .weights import BidirectionalWeights

#: Vertices of a light path, about, for MIS weights. The true number would make the weights depend
#: on the samples (door_ajar: 11 % less variance than with 1).
_VERTICES = 2.5


@dataclass
class BidirectionalPathTracer:
    """Traces a camera path and a light path in each lane; it is an :class:`Estimator`. The camera
    path is that of a :class:`Walk` with whatever decisions.

    Parameters:
        walk: That of the camera paths.
        emission: Where light paths begin.
        sensor: What light paths are connected to; ``None`` if they are not.
        connections: To how many vertices of light paths each vertex of a camera path is connected.
        selection: Chooses these vertices, or the regions in which they lie. A path of other
            wavelengths, or of another time, cannot be connected to: where such differ, the choice
            is always uniform, among the vertices of the light path in the same lane.
    """

    walk: Walk
    emission: LightEmission
    sensor: ConnectableSensor | None
    connections: int
    selection: SubpathSelection = field(default_factory=SubpathSelection)

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        walk = self.walk
        own_lane = mi.is_spectral or bool(movers(scene))
        selection = self.selection if self.selection.count > 0 and not own_lane else None
        # Per vertex where a selection says how often that is chosen
        count = self.connections if selection else self.connections / _VERTICES
        sums = PartialSums(walk.next_event, dr.opaque(mi.Float, count), selection=selection)
        image = None
        if self.sensor is not None:
            image = LightImage(
                scene, self.sensor, sampler, rays, sums, walk.query, walk.hide_emitters
            )
        light_walk = LightWalk(
            self.emission, walk.max_depth, walk.rr_depth, sums, query=walk.query
        )
        paths = light_walk.begin(scene, sampler, rays.ray.time, rays.ray.wavelengths, active)
        # What the rest of the pass reads again
        dr.eval(paths, rays)
        lanes = dr.width(paths.active)
        rounds: list[VertexCache] = []

        def take(vertices: LightVertices) -> None:
            if image is not None:
                image.add(vertices)
            # Without the gaps, which take most of the memory
            rounds.append(VertexCache([vertices], lanes))

        paths = light_walk.finish(scene, sampler, paths, take)
        weights = BidirectionalWeights(scene, sums, self.emission, self.sensor)
        subpaths = None
        if rounds:
            vertices = rounds[0] if len(rounds) == 1 else VertexCache(rounds, lanes)
            if selection is not None:
                choice = RegionChoice(vertices, selection)
            else:
                choice = OwnVertexChoice(vertices) if own_lane else VertexChoice(vertices)
            subpaths = LightSubpaths(
                scene, vertices, choice, sums, walk.query, self.connections, walk.max_depth,
                walk.observer,
            )  # fmt: skip
        sample = replace(walk, weights=weights, subpaths=subpaths)(scene, sampler, rays, active)
        return replace(
            sample,
            splats=image.splats if image else [],
            scatter_count=sample.scatter_count + paths.scatter_count,
            shadow_count=sample.shadow_count + (image.shadow_count if image else 0),
        )
