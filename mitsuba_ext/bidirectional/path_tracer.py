"""The estimator of bidirectional path tracing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..movers import movers
from ..transport.estimator import CameraRays, Sample, Splats
from ..transport.numbers import Numbers
from ..transport.walk import Walk
from .connections import LightSubpaths
from .emission import LightEmission
from .light_image import light_image
from .light_vertices import VertexCache
from .light_walk import LightWalk
from .partial_sums import PartialSums
from .sensor import ConnectableSensor
from .weights import BidirectionalWeights

#: Vertices of a light path, about, for MIS weights. The true number would make the weights depend
#: on the samples (door_ajar: 11 % less variance than with 1).
_VERTICES = 2.5

#: Vertices of a light path that are stored at a time, and the most rounds of a path: it has been
#: stuck where nothing absorbs light.
STRIDE, MOST_ROUNDS = 4, 1 << 12


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
        seed = None
        if self.sensor is not None and self.sensor.needs_aperture_sample:
            seed = mi.UInt32(sampler.next_1d() * 4294967040.0)
        light_walk = LightWalk(
            self.emission, walk.max_depth, walk.rr_depth, sums, query=walk.query
        )
        paths = light_walk.begin(scene, sampler, rays.ray.time, rays.ray.wavelengths, active)
        # What the rest of the pass reads again
        dr.eval(paths, seed, rays)
        lanes = dr.width(paths.active)
        rounds: list[VertexCache] = []
        splats: list[Splats] = []
        shadow_count = mi.UInt32(0)
        for _ in range(MOST_ROUNDS):
            vertices, paths = light_walk.advance(scene, sampler, paths, STRIDE)
            if vertices.count > 0:
                if self.sensor is not None:
                    found, tested = light_image(
                        scene, self.sensor, vertices, seed, rays.importance, sums, walk.query,
                        walk.hide_emitters,
                    )  # fmt: skip
                    dr.eval(found, tested)
                    splats.append(found)
                    shadow_count += dr.sum(tested)
                # Without the gaps, which take most of the memory
                rounds.append(VertexCache([vertices], lanes))
            if not dr.any(paths.active)[0]:
                break
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
            splats=splats,
            scatter_count=sample.scatter_count + paths.scatter_count,
            shadow_count=sample.shadow_count + shadow_count,
        )
