"""The light image: stored vertices of light paths, connected to the sensor (t = 1)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.estimator import CameraRays, Splats
from ...transport.frozen import frozen
from ...transport.heroes import Heroes
from ...transport.numbers import HashedNumbers, Numbers, hashed_2d
from ...transport.path_channels import PathChannels
from ...transport.path_decisions import SceneQuery
from ...transport.transmittance import for_weights
from .choice.technique_observer import TechniqueObserver
from .light_vertices import LightVertex, VertexCache
from .partial_sums import CompetingDensities, PartialSums, weight
from .scattering import SurfaceTerms
from .sensor import ConnectableSensor, SensorConnection, is_occluded


class LightImage:
    """Connects vertices of light paths to the sensor. It uses a kernel of its own, which has a lane
    for each vertex.

    The sum of a pixel's splats, divided by the number of its camera samples, is their contribution
    to the pixel's radiance.

    It draws one random number if the sensor has an aperture, or if a medium varies in density, and
    none otherwise.

    Parameters:
        scene: The scene.
        sensor: The sensor to which the vertices are connected.
        numbers: The source of random numbers.
        rays: The camera rays of the pass. A light path's splats are multiplied by the importance of
            the camera ray in its lane (if their number differs, rays must have equal importance).
        sums: Computes MIS weights. If it is ``None``, the weights are 1.
        query: Intersects rays with the scene.
        hides_emitters: Whether area lights are invisible to the sensor.
        least_depth: Least number of segments between the light and a vertex that is connected.
        observer: Receives the splats.
        light_paths: Number of light paths for each camera path.
        channels: Divides the splats among light path expressions; ``None`` without any.
        terms: The terms of vertices.

    Attributes:
        shadow_count: Number of shadow rays traced.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: ConnectableSensor,
        numbers: Numbers,
        rays: CameraRays,
        sums: PartialSums | None = None,
        query: SceneQuery | None = None,
        hides_emitters: bool = False,
        least_depth: int = 1,
        observer: TechniqueObserver | None = None,
        light_paths: float = 1.0,
        channels: PathChannels | None = None,
        terms: SurfaceTerms = SurfaceTerms(),  # noqa: B008  (never modified)
    ) -> None:
        self._channels, self._terms = channels, terms
        self._share = dr.opaque(mi.Float, 1 / light_paths)
        self._least_depth = least_depth
        self._observer = observer
        self._scene, self._sensor, self._importance = scene, sensor, rays.importance
        self._sums, self._query = sums, query or SceneQuery()
        self._hides_emitters = hides_emitters
        # Hashed with the depth of a vertex, it gives the numbers that choose a point of the
        # aperture, and collisions in media of varying density
        self._seed = None
        if sensor.needs_aperture_sample or (terms.sees_media and terms.has_grids):
            self._seed = mi.UInt32(numbers.next_1d() * 4294967040.0)
            dr.schedule(self._seed)
        dr.schedule(self._importance)
        self.shadow_count = mi.UInt32(0)

    def kernel_state(self) -> tuple:
        """The objects and constants that kernels depend on."""
        return (
            self._least_depth, self._scene, self._sensor, self._importance, self._sums,
            self._query, self._hides_emitters, self._seed, self._share, self._observer,
            self._channels, self._terms,
        )  # fmt: skip

    def splats(self, vertices: VertexCache) -> Splats:
        """Connects these vertices, at least one. The splats are evaluated: otherwise the first
        reader would evaluate them together with everything else that is scheduled."""
        can_be_frozen = self._observer is None or self._observer.can_be_frozen
        connect = self._connect_frozen if can_be_frozen else self._connect
        splats, tested = connect(vertices)
        dr.eval(splats, tested)
        self.shadow_count += dr.sum(tested)
        return splats

    def _connect(self, vertices: VertexCache) -> tuple[Splats, mi.UInt32]:
        """The splats, and the number of shadow rays of each vertex."""
        index, active = vertices.every()
        vertex = vertices.at(index, active)
        si, terms = vertex.si, self._terms
        sample = mi.Point2f(0.5)
        if self._sensor.needs_aperture_sample:
            word = dr.gather(mi.UInt32, self._seed, vertex.lane, active)
            sample = hashed_2d(word, vertex.depth)
        connection, lens_weight = self._sensor.connect(si, sample, active, not terms.sees_media)
        active = active & connection.active
        if self._least_depth > 1:
            active &= vertex.depth >= self._least_depth
        if self._hides_emitters:
            active &= si.shape.emitter() == None  # noqa: E711
        to_camera = si.to_local(connection.d)
        heroes = Heroes(self._scene)
        bsdf = si.bsdf()
        value, reverse_pdf = terms.adjoint(
            heroes.context(), bsdf, si, vertex.medium, to_camera, active
        )
        value = heroes.connect(vertex.hero_is_alone, value, bsdf, si, to_camera)
        importance = connection.importance * lens_weight
        value *= vertex.β * (importance * self._share)
        mis, competing, T = mi.Float(1), None, None
        # Transmittance comes first, since weights depend on it
        if terms.sees_media:
            active &= dr.max(dr.abs(value)) > 0
            T, known = self._transmittance(vertex, connection, active)
        if self._sums is not None:
            active &= self._sums.is_open(si, to_camera)
            # The density per area with which a camera ray finds the vertex, divided by the density
            # of this point of the aperture
            found = importance * terms.cosine(si, to_camera)
            if terms.sees_media:
                found *= for_weights(known)
            others = self._sums.others(found, vertex.history, reverse_pdf)
            mis = weight(others / self._sums.image_count)
            if self._sums.splits:
                ends = found, vertex.history, reverse_pdf, vertex.depth == 1
                kinds = self._sums.by_kind(*ends, by_light=True) / self._sums.image_count
                competing = CompetingDensities(self._sums.by_camera(*ends), kinds)
            value *= mis
        # A connection that cannot contribute needs no shadow ray
        active &= dr.max(dr.abs(value)) > 0
        tested = mi.UInt32(dr.select(active, 1, 0))
        if terms.sees_media:
            value *= T
            active &= dr.max(T) > 0
        else:
            active &= ~is_occluded(
                self._query, self._scene, si, connection, active, self._hides_emitters
            )
        if not isinstance(self._importance, float):
            importance = self._importance
            if dr.width(importance) > 1:
                importance = dr.gather(type(importance), importance, vertex.lane, active)
            value *= importance
        finite = active & dr.all(dr.isfinite(value))
        if self._observer is not None:
            self._observer.found_by(vertex.lane)
            self._observer.splatted(
                vertex.depth + 1, connection.position, value, mis, competing, finite
            )
        channels: list[mi.Spectrum] = []
        if self._channels is not None:
            states = self._channels.past(vertex, to_camera, active)
            channels = self._channels.splatted(states, value)
        return Splats(
            value, connection.position, vertices.wavelengths(vertex, active), finite, vertex.lane,
            channels,
        ), tested  # fmt: skip

    _connect_frozen = frozen(_connect)

    def _transmittance(
        self, vertex: LightVertex, connection: SensorConnection, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """The transmittance between a vertex and the sensor, and the part of it that is known."""
        numbers = None
        if self._seed is not None:
            word = dr.gather(mi.UInt32, self._seed, vertex.lane, active)
            numbers = HashedNumbers(word ^ (vertex.depth << 16), mi.UInt32(0))
        return self._terms.transmittance(
            self._query, self._scene, vertex.si, vertex.medium, connection.direction_sample(),
            numbers, active, self._hides_emitters, connection.reach,
        )  # fmt: skip
