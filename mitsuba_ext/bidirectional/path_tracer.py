"""The estimator of bidirectional path tracing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..movers import movers
from ..transport.estimator import CameraRays, Sample
from ..transport.numbers import Numbers
from ..transport.walk import Walk
from .connections import LightSubpaths
from .emission import LightEmission
from .light_image import LightImage
from .light_numbers import light_numbers
from .light_vertices import LightVertices, VertexCache
from .light_walk import LightWalk
from .partial_sums import PartialSums
from .sensor import ConnectableSensor
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
    """

    walk: Walk
    emission: LightEmission
    sensor: ConnectableSensor | None
    connections: int

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        walk = self.walk
        count = dr.opaque(mi.Float, self.connections / _VERTICES)
        sums = PartialSums(walk.next_event, count)
        image = None
        if self.sensor is not None:
            image = LightImage(
                scene, self.sensor, sampler, rays, sums, walk.query, walk.hide_emitters
            )
        light_walk = LightWalk(
            self.emission, walk.max_depth, walk.rr_depth, sums, query=walk.query
        )
        numbers = light_numbers(sampler, dr.width(rays.ray))
        paths = light_walk.begin(scene, numbers, rays.ray.time, rays.ray.wavelengths, active)
        # What the rest of the pass reads again
        dr.eval(paths, rays)
        lanes = dr.width(paths.active)
        rounds: list[VertexCache] = []

        def take(vertices: LightVertices) -> None:
            if image is not None:
                image.add(vertices)
            # Without the gaps, which take most of the memory
            rounds.append(VertexCache([vertices], lanes))

        paths = light_walk.finish(scene, numbers, paths, take)
        weights = BidirectionalWeights(scene, sums, self.emission, self.sensor)
        subpaths = None
        if rounds:
            subpaths = LightSubpaths(
                scene, rounds[0] if len(rounds) == 1 else VertexCache(rounds, lanes), sums,
                walk.query, self.connections, walk.max_depth,
                mi.is_spectral or bool(movers(scene)),
            )  # fmt: skip
        sample = replace(walk, weights=weights, subpaths=subpaths)(scene, sampler, rays, active)
        return replace(
            sample,
            splats=image.splats if image else [],
            scatter_count=sample.scatter_count + paths.scatter_count,
            shadow_count=sample.shadow_count + (image.shadow_count if image else 0),
        )
