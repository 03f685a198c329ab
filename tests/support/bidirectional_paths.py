"""Explicit paths from a light to the sensor, and the weights of the techniques that find them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.estimators.light_paths.bidirectional_programs import (
    BidirectionalProgram,
    LightSums,
)
from mitsuba_ext.estimators.light_paths.connections import End, joining_rivals, joining_weight
from mitsuba_ext.estimators.light_paths.emission import EmittedRay, LightEmission
from mitsuba_ext.estimators.light_paths.lens import connectable
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums, weight
from mitsuba_ext.estimators.light_paths.scattering import (
    cosine_of_delta,
    geometric_cosine,
    reverse_density,
)
from mitsuba_ext.estimators.light_paths.sensor import ConnectableSensor
from mitsuba_ext.transport.connection import emission
from mitsuba_ext.transport.path_decisions import (
    EmitterSampling,
    SceneQuery,
    SubpathSelection,
    Weights,
)
from mitsuba_ext.transport.vertex import Arrival, PathState, Vertex


@dataclass
class PathVertex:
    """A vertex on a surface.

    Attributes:
        p, n: Position and geometric normal.
        from_light, from_camera: The interaction, with ``wi`` towards the light, or the camera.
        bsdf: The BSDF.
        is_delta: Was the direction chosen by a discrete distribution?
        η: Index of refraction on the camera's side, relative to that on the light's.
    """

    p: mi.Point3f
    n: mi.Normal3f
    from_light: mi.SurfaceInteraction3f
    from_camera: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    is_delta: mi.Bool
    η: mi.Float


@dataclass
class Paths:
    """Paths with the same number of vertices, one in each lane.

    Attributes:
        emitted: The ray that leaves the light.
        vertices: From light to camera.
        camera_ray: The ray of the camera.
        active: The lanes that have a path.
    """

    emitted: EmittedRay
    vertices: list[PathVertex]
    camera_ray: mi.Ray3f
    active: mi.Bool


def trace(
    scene: mi.Scene, emission: LightEmission, sensor: mi.Sensor, light: int, camera: int,
    lanes: int = 4096,
) -> Paths:  # fmt: skip
    """Walks of ``light`` vertices from the light, and ``camera`` vertices from the camera, that see
    each other; without ``camera`` vertices, the sensor sees the last vertex."""
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(7, lanes)
    query, active = SceneQuery(), mi.Bool(True)
    emitted = emission.sample(numbers, mi.Float(0), mi.Ray3f().wavelengths, active)
    active &= dr.max(emitted.weight) > 0
    # Exact distances are wanted
    ray = mi.Ray3f(emitted.ray)
    from_light, active = _walk(scene, numbers, ray, light, active, mi.TransportMode.Importance)
    first = from_light[0][0]
    first.t = dr.select(emitted.is_infinite, first.t, dr.norm(first.p - emitted.start.p))
    last = from_light[-1][0]
    if camera == 0:
        connection, _ = connectable(sensor).connect(last, numbers.next_2d(), active)
        seen = mi.SurfaceInteraction3f(last)
        ds = dr.zeros(mi.DirectionSample3f, lanes)
        ds.p, ds.d, ds.dist = connection.target, connection.d, connection.dist
        active &= connection.active & ~query.occluded(scene, last, ds, active)
        camera_ray = mi.Ray3f(connection.target, -connection.d)
        to_camera = connection.d
        from_camera = []
    else:
        camera_ray, _ = sensor.sample_ray(0, 0.5, numbers.next_2d(), numbers.next_2d(), active)
        from_camera, active = _walk(
            scene, numbers, camera_ray, camera, active, mi.TransportMode.Radiance
        )
        seen = from_camera[-1][0]
        d = seen.p - last.p
        ds = dr.zeros(mi.DirectionSample3f, lanes)
        ds.p, ds.dist = seen.p, dr.norm(d)
        ds.d = d / ds.dist
        active &= ~query.occluded(scene, last, ds, active) & (ds.dist > 0.05)
        to_camera = ds.d
    vertices = []
    for i, (si, wo, is_delta, η) in enumerate(from_light):
        is_end = i + 1 == light
        other = mi.SurfaceInteraction3f(si)
        other.wi = si.to_local(to_camera) if is_end else wo
        delta = mi.Bool(False) if is_end else is_delta
        vertices.append(PathVertex(si.p, si.n, si, other, si.bsdf(), delta, η))
    for i, (si, wo, is_delta, η) in reversed(list(enumerate(from_camera))):
        is_end = i + 1 == camera
        other = mi.SurfaceInteraction3f(si)
        other.wi = si.to_local(-to_camera) if is_end else wo
        delta = mi.Bool(False) if is_end else is_delta
        vertices.append(PathVertex(si.p, si.n, other, si, si.bsdf(), delta, dr.rcp(η)))
    ctx = mi.BSDFContext()
    for v in vertices:
        value = v.bsdf.eval(ctx, v.from_camera, v.from_light.wi, active)
        active &= v.is_delta | (dr.max(value) > 0)
    paths = Paths(emitted, vertices, camera_ray, active)
    # One kernel for all of it
    dr.eval(paths)
    return paths


def _walk(scene, numbers, ray, count, active, mode):
    """The interactions, the directions that were chosen there, whether these are discrete, and the
    relative index of refraction."""
    found = []
    ctx = mi.BSDFContext(mode)
    for i in range(count):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        if i + 1 == count:
            found.append((si, mi.Vector3f(0, 0, 1), mi.Bool(False), mi.Float(1)))
            active &= mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
            break
        bs, value = si.bsdf().sample(ctx, si, numbers.next_1d(), numbers.next_2d(), active)
        active &= dr.max(value) > 0
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        found.append((si, mi.Vector3f(bs.wo), is_delta, mi.Float(bs.eta)))
        ray = si.spawn_ray(si.to_world(bs.wo))
    return found, active


#: How often two vertices of subpaths are connected, and how many light paths there are for each
#: camera path, for weights: not once, as all else.
CONNECTIONS, LIGHT_PATHS = 0.4, 3.0


def weights_of_techniques(
    scene: mi.Scene,
    paths: Paths,
    emits: LightEmission,
    sensor: ConnectableSensor | None,
    next_event: EmitterSampling,
    selection: SubpathSelection | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As the estimator computes them: the weight of each technique, [s, path], 0 where it cannot
    find the path; which of the lanes have a path; and for all techniques but the first two the
    ratios of the densities of these to its own, and the squared ratios of other connections and of
    the light image, [s − 2, 4, path]."""
    sums = PartialSums(
        CONNECTIONS, splits=True, selection=selection, light_paths=LIGHT_PATHS
    )
    active = paths.active
    program, weights = BidirectionalProgram(scene, sums, emits, sensor), Weights()
    ctx = mi.BSDFContext()
    vertices, emitted = paths.vertices, paths.emitted

    # ----- Subpaths from the light -----
    si = vertices[0].from_light
    first = LightSums(sums, next_event).at_first(scene, emitted, si, active)
    at_first = mi.Bool(True)
    arrived = sums.arrive(first, si, mi.Float(1), at_first, by_light=True)
    by_light = [
        replace(first, region=arrived.region, count=arrived.count, by_kind=mi.Vector2f(0))
    ]
    # Which techniques scatter only where their densities are not 0
    from_light, from_camera = [mi.Bool(True)], [mi.Bool(True), mi.Bool(True)]
    for a, b in zip(vertices, vertices[1:]):
        si, wo = a.from_light, a.from_camera.wi
        pdf = dr.select(a.is_delta, 1, a.bsdf.pdf(ctx, si, wo, active))
        from_light.append(from_light[-1] & (pdf > 0))
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
        bs.eta = a.η
        cosine = dr.select(a.is_delta, cosine_of_delta(si, bs), geometric_cosine(si, wo))
        left = sums.leave(
            by_light[-1], cosine, pdf,
            reverse_density(ctx, a.bsdf, si, wo, active), a.is_delta, a is vertices[0],
            by_light=True,
        )  # fmt: skip
        by_light.append(
            sums.arrive(
                left, b.from_light, dr.squared_norm(b.p - a.p), ~at_first, by_light=True
            )
        )

    # ----- Subpaths from the camera -----
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0),
        Arrival(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)), None,
        program.begin(paths.camera_ray),
    )  # fmt: skip
    by_camera: list[Vertex] = []
    state = next_event.begin(None, paths.camera_ray)
    for v in reversed(vertices):
        si = v.from_camera
        path.history = program.arrive(path, si)
        vertex = Vertex(si, v.bsdf, path)
        by_camera.insert(0, vertex)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
        bs.wo, bs.eta = v.from_light.wi, dr.rcp(v.η)
        bs.pdf = dr.select(v.is_delta, 1, v.bsdf.pdf(ctx, si, bs.wo, active))
        from_camera.insert(0, from_camera[0] & (bs.pdf > 0))
        delta, smooth = int(mi.BSDFFlags.DeltaReflection), int(mi.BSDFFlags.DiffuseReflection)
        bs.sampled_type = dr.select(v.is_delta, mi.UInt32(delta), mi.UInt32(smooth))
        place = next_event.visit(state, scene, si, active)
        state = next_event.remember(place, scene, si.to_world(bs.wo), mi.Float(0), active)
        path = PathState(
            mi.Spectrum(1), mi.Float(1), mi.Float(1), path.depth + 1,
            Arrival(mi.Interaction3f(si), bs.pdf, v.is_delta), None, program.leave(vertex, bs),
        )  # fmt: skip

    # ----- s = 0, 1 -----
    found = []
    first = vertices[0]
    is_delta_light = emitted.is_delta_position | emitted.is_delta_direction
    # Along the same line: a ray that starts above the surface meets a curved light elsewhere, where
    # the cosine is another one, by up to 20 % if it is small
    back = mi.Ray3f(first.p - 1e-3 * emitted.ray.d, -emitted.ray.d)
    si = scene.ray_intersect(back, active)
    ds = mi.DirectionSample3f(scene, si, mi.Interaction3f(first.from_camera))
    is_hit = active & ~is_delta_light & (ds.emitter == emitted.emitter)
    is_hit &= emitted.is_infinite | (dr.norm(si.p - emitted.start.p) < 1e-2)
    active &= is_hit | is_delta_light
    hits: dict[str, mi.Float] = {}

    class Record:
        def emission(self, *arguments):
            hits["pdf"] = arguments[-1]
            hits["weight"] = program.emission(*arguments)
            return hits["weight"]

    path.history = program.arrive(path, si)
    emission(scene, SceneQuery(), si, path, next_event, state, weights, Record())
    found.append(dr.select(is_hit, hits["weight"], 0))

    probability = next_event.probability(
        state, scene, mi.Interaction3f(first.from_camera), emitted.index, active & is_delta_light
    )
    ds.p = dr.select(is_hit, ds.p, emitted.start.p)
    ds.d = dr.select(is_hit, ds.d, -emitted.ray.d)
    ds.dist = dr.select(is_hit, ds.dist, dr.norm(emitted.start.p - first.p))
    ds.emitter = emitted.emitter
    ds.delta = is_delta_light
    ds.pdf = dr.select(is_hit, hits["pdf"], probability)
    by_scattering = first.bsdf.pdf(ctx, first.from_camera, first.from_light.wi, active)
    connected = program.connection(weights, scene, by_camera[0], ds, ds.pdf, by_scattering)
    found.append(dr.select(first.is_delta, 0, connected))

    # ----- s, t ≥ 2 -----
    ratios = []
    for i, (a, b) in enumerate(zip(vertices, vertices[1:])):
        ends = [
            End(si, wo, v.bsdf.pdf(ctx, si, wo, active),
                reverse_density(ctx, v.bsdf, si, wo, active), partial)
            for v, si, wo, partial in (
                (b, b.from_camera, b.from_light.wi, by_camera[i + 1].path.history),
                (a, a.from_light, a.from_camera.wi, by_light[i]),
            )
        ]  # fmt: skip
        expected = 1.0
        if selection is not None:
            expected = selection.expected(
                by_camera[i + 1].path.history.region, by_light[i].region, active
            )
        joined = joining_weight(sums, *ends, dr.squared_norm(b.p - a.p), expected)
        found.append(dr.select(a.is_delta | b.is_delta, 0, joined))
        factor = 1 / (CONNECTIONS * expected)
        is_first = b is vertices[-1], i == 0
        competing = joining_rivals(
            sums, *ends, dr.squared_norm(b.p - a.p), is_first, factor, expected
        )
        ratios.append([*competing.by_camera, *competing.by_kind])

    # ----- t = 1 -----
    if sensor is not None:
        last = vertices[-1]
        origin, pdf = sensor.origin(paths.camera_ray)
        wo = last.from_camera.wi
        spread = 1 if sensor.is_parallel else dr.squared_norm(last.p - origin)
        density = pdf / spread * geometric_cosine(last.from_light, wo)
        reverse = reverse_density(ctx, last.bsdf, last.from_light, wo, active)
        seen = weight(sums.others(density, by_light[-1], reverse) / sums.image_count)
        found.append(dr.select(last.is_delta, 0, seen))
        ends = density, by_light[-1], reverse, len(vertices) == 1
        kinds = sums.by_kind(*ends, by_light=True) / sums.image_count
        ratios.append([*(sums.by_camera(*ends) / LIGHT_PATHS), *kinds])
    # from_camera: for s = 0, 1, …, t = 1; from_light: for s = 2, …
    can = [from_camera[s] & (from_light[s - 2] if s > 1 else True) for s in range(len(found))]
    found = [dr.select(active & c, w, 0) for c, w in zip(can, found)]
    dr.eval(found, ratios, active)
    shape = np.array(active).shape
    return (
        np.stack([np.broadcast_to(np.array(w, dtype=np.float64), shape) for w in found]),
        np.array(active),
        np.array([
            [np.broadcast_to(np.array(x, dtype=np.float64), shape) for x in r] for r in ratios
        ]),  # fmt: skip
    )
