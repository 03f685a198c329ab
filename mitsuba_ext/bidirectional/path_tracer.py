"""The estimator of bidirectional path tracing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..movers import movers
from ..transport.estimator import CameraRays, Sample
from ..transport.numbers import Numbers
from ..transport.observer import Observers
from ..transport.walk import Walk
from .connections import LightSubpaths
from .emission import LightEmission
from .light_image import LightImage
from .light_numbers import light_numbers
from .light_vertices import LightVertices, PackedVertices, VertexCache
from .light_walk import LightWalk
from .partial_sums import PartialSums
from .sensor import ConnectableSensor
from .technique_observer import TechniqueObserver
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
        observer: Is told what each technique finds, by the walk as well.
    """

    walk: Walk
    emission: LightEmission
    sensor: ConnectableSensor | None
    connections: int
    observer: TechniqueObserver | None = None

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        walk = self.walk
        count = dr.opaque(mi.Float, self.connections / _VERTICES)
        observer, follows_camera = self.observer, False
        if observer is not None:
            observer.start(rays)
            walk = replace(walk, observer=Observers([walk.observer, observer]))
            follows_camera = observer.compares_with_camera
        sums = PartialSums(walk.next_event, count, follows_camera=follows_camera)
        image = None
        if self.sensor is not None:
            image = LightImage(
                scene, self.sensor, sampler, rays, sums, walk.query, walk.hide_emitters,
                observer,
            )  # fmt: skip
        light_walk = LightWalk(
            self.emission, walk.max_depth, walk.rr_depth, sums, query=walk.query
        )
        # What the rest of the pass reads again
        dr.schedule(rays)
        lanes = dr.width(rays.ray)
        rounds: list[LightVertices] = []

        def take(vertices: LightVertices) -> None:
            if image is not None:
                image.add(vertices)
            rounds.append(PackedVertices(vertices))

        numbers = light_numbers(sampler, lanes)
        scatter_count = light_walk.run(
            scene, numbers, rays.ray.time, rays.ray.wavelengths, active, take
        )
        splats = image.splats() if image is not None else []
        weights = BidirectionalWeights(scene, sums, self.emission, self.sensor)
        subpaths = None
        if rounds:
            subpaths = LightSubpaths(
                scene, VertexCache(rounds, lanes), sums,
                walk.query, self.connections, walk.max_depth,
                mi.is_spectral or bool(movers(scene)), observer,
            )  # fmt: skip
        sample = replace(walk, weights=weights, subpaths=subpaths)(scene, sampler, rays, active)
        shadow_count = sample.shadow_count
        if image is not None:
            # Counted as if the first lane had traced them
            is_first = dr.arange(mi.UInt32, lanes) == 0
            shadow_count = shadow_count + dr.select(is_first, image.shadow_count, 0)
        scatter_count += sample.scatter_count
        whole = replace(
            sample, splats=splats, scatter_count=scatter_count, shadow_count=shadow_count
        )
        if observer is not None:
            observer.traced(sample, whole)
        return whole
