"""Connections of camera vertices to vertices of light paths (s, t ≥ 2)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.heroes import Heroes
from ...transport.numbers import Numbers
from ...transport.observer import Observer
from ...transport.path_channels import PathChannels
from ...transport.path_decisions import SceneQuery
from ...transport.path_program import Subpaths
from ...transport.transmittance import for_weights
from ...transport.vertex import Vertex
from .choice.technique_observer import TechniqueObserver
from .light_vertices import VertexCache
from .partial_sums import CompetingDensities, PartialSums, Sums, weight
from .vertex_choice import VertexChoice


@dataclass
class End:
    """One of the two vertices that are connected.

    Attributes:
        si: The interaction there.
        wo: Direction towards the other end, local.
        pdf: Density with which the subpath that comes from ``si.wi`` samples ``wo``.
        reverse_pdf: Density with which a path that comes from ``wo`` samples ``si.wi``.
        sums: Partial sums of the subpath.
    """

    si: mi.SurfaceInteraction3f
    wo: mi.Vector3f
    pdf: mi.Float
    reverse_pdf: mi.Float
    sums: Sums


def joining_weight(
    sums: PartialSums,
    one: End,
    other: End,
    squared_distance: mi.Float,
    expected: mi.Float | float = 1.0,
) -> mi.Float:
    """The MIS weight of connecting two subpaths.

    Parameters:
        squared_distance: In participating media, divided by the known transmittance: all other
            techniques pass the segment with this probability.
        expected: :meth:`SubpathSelection.expected`, if a selection chooses the vertices.
    """
    inverse = dr.rcp(squared_distance)
    to_one = other.pdf * sums.cosine(one.si, one.wo) * inverse
    to_other = one.pdf * sums.terms.cosine(other.si, other.wo) * inverse
    others = sums.others(to_one, one.sums, one.reverse_pdf)
    others += sums.others(to_other, other.sums, other.reverse_pdf)
    return weight(others / (sums.count * sums.ratio(expected)))


def joining_rivals(
    sums: PartialSums,
    one: End,
    other: End,
    squared_distance: mi.Float,
    is_first: tuple[mi.Bool | bool, mi.Bool | bool],
    factor: mi.Float | float,
    expected: mi.Float | float = 1.0,
) -> CompetingDensities:
    """The densities that compete with connecting a camera path that ends in ``one`` to a light path
    that ends in ``other``. For the parameters not listed here, see :func:`joining_weight`.

    Parameters:
        is_first: Whether ``one``, and whether ``other``, is the first vertex of its subpath.
        factor: 1 / (expected number of times they are connected), for
            ``CompetingDensities.by_camera``: the true number, not the number that MIS weights
            assume.
    """
    inverse = dr.rcp(squared_distance)
    to_one = other.pdf * sums.cosine(one.si, one.wo) * inverse
    to_other = one.pdf * sums.terms.cosine(other.si, other.wo) * inverse
    ends = to_other, other.sums, other.reverse_pdf, is_first[1]
    kinds = sums.by_kind(*ends, by_light=True)
    kinds += sums.by_kind(to_one, one.sums, one.reverse_pdf, is_first[0], by_light=False)
    kinds /= sums.count * sums.ratio(expected)
    return CompetingDensities(sums.by_camera(*ends) * factor, kinds)


class LightSubpaths(Subpaths):
    """Connects each vertex of a camera path to vertices of light paths that are chosen at random.

    Parameters:
        scene: The scene.
        vertices: The vertices of the light paths, at least one. There are as many light paths as
            camera paths.
        choice: Chooses among these vertices.
        sums: Computes the partial sums of the MIS weights.
        query: Intersects rays with the scene.
        connections: Number of connections of each camera path vertex.
        max_depth: Longest path in segments.
        observer: Receives the connections to vertices that are chosen by regions.
        techniques: Receives the contributions of connections.
        channels: Adds them to the channels of light path expressions; ``None`` without any.
    """

    def __init__(
        self,
        scene: mi.Scene,
        vertices: VertexCache,
        choice: VertexChoice,
        sums: PartialSums,
        query: SceneQuery,
        connections: int,
        max_depth: int,
        observer: Observer,
        techniques: TechniqueObserver | None = None,
        channels: PathChannels | None = None,
    ) -> None:
        self._channels = channels
        self._vertices, self._choice, self._sums, self._query = vertices, choice, sums, query
        self._connections, self._observer, self._techniques = connections, observer, techniques
        self._heroes = Heroes(scene)
        self._ctx = self._heroes.context()
        self._max_depth = dr.opaque(mi.UInt32, max_depth)
        self._share = dr.opaque(mi.Float, 1 / connections)

    @dr.syntax
    def gather(self, scene, sampler, vertex, active):
        total, shadow_count = mi.Spectrum(0), mi.UInt32(0)
        if dr.hint(self._connections == 1, mode="scalar"):
            total, shadow_count = self._connect(scene, sampler, vertex, active)
        else:
            index = mi.UInt32(0)
            while index < self._connections:
                value, tested = self._connect(scene, sampler, vertex, active)
                total += value
                shadow_count += tested
                index += 1
        return total, shadow_count

    def _connect(
        self, scene: mi.Scene, sampler: Numbers, vertex: Vertex, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """Connects ``vertex`` to a light path vertex that random numbers choose. Returns the
        contribution, and the number of shadow rays."""
        considered = active
        chosen = self._choice.choose(self._choice.numbers(sampler), vertex, active)
        active, factor = chosen.active, chosen.factor * self._share
        other = self._vertices.at(chosen.index, active)
        # Segments of the path: the segments of both subpaths, and one that connects them
        active &= vertex.depth + other.depth + 2 <= self._max_depth
        si, far = vertex.si, other.si
        d = far.p - si.p
        squared_distance = dr.squared_norm(d)
        distance = dr.sqrt(squared_distance)
        active &= distance > 0
        d /= dr.select(active, distance, 1)
        wo, back = si.to_local(d), far.to_local(-d)
        active &= self._sums.is_open(far, back)
        terms = self._sums.terms
        medium = vertex.medium and vertex.medium.mei.medium

        # ----- Throughput of the connection -----
        near_value, pdf = terms.eval(self._ctx, vertex.bsdf, si, medium, wo, active)
        value = si.to_world_mueller(near_value, -wo, si.wi)
        far_bsdf = far.bsdf()
        far_value, far_reverse = terms.adjoint(
            self._ctx, far_bsdf, far, other.medium, back, active
        )
        value = self._heroes.join(
            (vertex.path.hero_is_alone, value, vertex.bsdf, si, wo),
            (other.hero_is_alone, far_value, far_bsdf, far, back),
        )
        value *= vertex.path.β * other.β * (factor / dr.select(active, squared_distance, 1))

        # ----- MIS weight -----
        reverse = terms.reverse_density(self._ctx, vertex.bsdf, si, medium, wo, active)
        far_pdf = terms.density(self._ctx, far_bsdf, far, other.medium, back, active)
        near_end = End(si, wo, pdf, reverse, vertex.path.history)
        far_end = End(far, back, far_pdf, far_reverse, other.history)
        mis: mi.Float | float = 1.0
        if not terms.sees_media:
            mis = joining_weight(
                self._sums, near_end, far_end, squared_distance, chosen.expected
            )
            value *= mis

        # ----- Shadow ray -----
        active &= (dr.max(dr.abs(value)) > 0) & dr.all(dr.isfinite(value))
        ds = dr.zeros(mi.DirectionSample3f, dr.width(active))
        ds.p, ds.n, ds.d, ds.dist = far.p, far.n, d, distance
        if terms.sees_media:
            T, known = terms.transmittance(
                self._query, scene, si, medium, ds, sampler, active
            )
            squared_distance /= for_weights(known)
            mis = joining_weight(
                self._sums, near_end, far_end, squared_distance, chosen.expected
            )
            value *= T * mis
            visible = active & (dr.max(T) > 0) & dr.all(dr.isfinite(value))
        else:
            visible = active & ~self._query.occluded(scene, si, ds, active)
        value = dr.select(visible, value, 0)
        if self._channels is not None:
            others = self._channels.past(other, back, visible)
            self._channels.joined(vertex, wo, near_value, others, value, visible)
        if self._techniques is not None:
            competing = None
            if self._sums.splits:
                competing = joining_rivals(
                    self._sums, near_end, far_end, squared_distance,
                    (vertex.depth == 0, other.depth == 1), factor, chosen.expected,
                )  # fmt: skip
            self._techniques.found_by(other.lane)
            self._techniques.joined(
                other.depth + 1, vertex.depth + 2, value, mis, competing, visible
            )
        if chosen.region is not None:
            self._observer.subpath(
                vertex, chosen.region, chosen.probability, value, considered
            )
        return value, dr.select(active, 1, 0)
