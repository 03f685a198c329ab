"""Connecting camera paths to virtual point lights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_bsdf
from ....transport.heroes import Heroes
from ....transport.observer import Observer
from ....transport.path_decisions import SceneQuery
from ....transport.path_program import Subpaths
from ....transport.vertex import Vertex
from ..light_vertices import VertexCache
from ..scattering import adjoint_value, geometric_cosine
from .virtual_light_bound import Bound, is_connected
from .virtual_light_choice import VirtualLightChoice
from .virtual_light_parts import LightParts


class VirtualLightConnections(Subpaths):
    """Connects the vertices of a camera path that still have a share of the light to virtual
    lights.

    Parameters:
        scene: The scene.
        vertices: The virtual lights.
        choice: Chooses among them.
        bound: The weights.
        query: Intersects rays with the scene.
        connections: Number of connections of a vertex.
        max_depth: Longest path in segments.
        observer: Receives the connections to virtual lights that are chosen by regions.
        parts: Receives the light of virtual lights; ``None`` if it is not needed.
    """

    def __init__(
        self,
        scene: mi.Scene,
        vertices: VertexCache,
        choice: VirtualLightChoice,
        bound: Bound,
        query: SceneQuery,
        connections: int,
        max_depth: int,
        observer: Observer,
        parts: LightParts | None = None,
    ) -> None:
        self._vertices, self._choice, self._bound, self._query = vertices, choice, bound, query
        self._connections, self._observer, self._parts = connections, observer, parts
        self._ctx = Heroes(scene).context()
        self._max_depth = dr.opaque(mi.UInt32, max_depth)
        self._count = dr.opaque(mi.UInt32, connections)
        self._share = dr.opaque(mi.Float, 1 / connections)

    @dr.syntax
    def gather(self, scene, sampler, vertex, active):
        total, shadow_count = mi.Spectrum(0), mi.UInt32(0)
        # A path without a share ends here
        active = active & is_connected(vertex.bsdf) & (vertex.path.history.share > 0)
        active &= vertex.depth + 3 <= self._max_depth
        if dr.hint(self._connections == 1, mode="scalar"):
            total, shadow_count = self._connect(
                scene, self._choice.numbers(sampler), vertex, active
            )
        else:
            index = mi.UInt32(0)
            while index < self._count:
                numbers = self._spread(self._choice.numbers(sampler), index)
                value, tested = self._connect(scene, numbers, vertex, active)
                total += value
                shadow_count += tested
                index += 1
        if dr.hint(self._parts is not None, mode="scalar"):
            self._parts.virtual(total, active)
        return total, shadow_count

    def _spread(self, numbers: tuple[mi.Point2f, ...], index: mi.UInt32) -> tuple:
        """The numbers of connection ``index``, evenly spread over the connections of a vertex."""
        if not self._choice.is_stratified:
            return numbers
        first = numbers[0]
        x = dr.minimum((mi.Float(index) + first.x) * self._share, dr.one_minus_epsilon(mi.Float))
        return mi.Point2f(x, first.y), *numbers[1:]

    def _connect(
        self, scene: mi.Scene, numbers: tuple[mi.Point2f, ...], vertex: Vertex, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """Connects ``vertex`` to the virtual light that ``numbers`` choose. Returns the
        contribution, and the number of shadow rays."""
        considered = active
        chosen = self._choice.choose(numbers, vertex, active)
        active = chosen.active
        other = self._vertices.at(chosen.index, active)
        # Segments of the path: the segments of both subpaths, and one that connects them
        active &= vertex.depth + other.depth + 2 <= self._max_depth
        si, far = vertex.si, other.si
        d = far.p - si.p
        squared_distance = dr.squared_norm(d)
        distance = dr.sqrt(squared_distance)
        active &= distance > 0
        d /= dr.select(active, distance, 1)
        inverse = dr.rcp(dr.select(active, squared_distance, 1))
        wo, back = si.to_local(d), far.to_local(-d)

        # ----- Throughput of the connection -----
        value, pdf = eval_bsdf(vertex.bsdf, self._ctx, si, wo, active)
        value = si.to_world_mueller(value, -wo, si.wi)
        far_value, far_pdf = adjoint_value(self._ctx, far.bsdf(), far, back, active)
        value *= far_value * vertex.path.β * other.β
        value *= chosen.factor * self._share * inverse

        # ----- The weight of this segment, and of those before -----
        link = vertex.path.history
        kernel = dr.pi * pdf * geometric_cosine(far, back) * inverse
        value *= self._bound.connected(kernel, far_pdf)
        value *= self._bound.share(link, vertex.bsdf, pdf)

        # ----- Shadow ray -----
        active &= (dr.max(dr.abs(value)) > 0) & dr.all(dr.isfinite(value))
        ds = dr.zeros(mi.DirectionSample3f, dr.width(active))
        ds.p, ds.n, ds.d, ds.dist = far.p, far.n, d, distance
        visible = active & ~self._query.occluded(scene, si, ds, active)
        value = dr.select(visible, value, 0)
        if chosen.region is not None:
            self._observer.subpath(
                vertex, chosen.region, chosen.probability, value, considered
            )
        return value, dr.select(active, 1, 0)
