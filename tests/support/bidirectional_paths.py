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
from mitsuba_ext.estimators.light_paths.medium_programs import BidirectionalProgramInMedia
from mitsuba_ext.estimators.light_paths.medium_scattering import MediumTerms
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums, weight
from mitsuba_ext.estimators.light_paths.scattering import SurfaceTerms, cosine_of_delta
from mitsuba_ext.estimators.light_paths.sensor import ConnectableSensor
from mitsuba_ext.transport.connection import emission
from mitsuba_ext.transport.path_decisions import (
    EmitterSampling,
    SceneQuery,
    SubpathSelection,
    Weights,
)
from mitsuba_ext.transport.vertex import Arrival, MediumVertex, PathState, Vertex


@dataclass
class PathVertex:
    """A vertex on a surface, or in a medium.

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
    medium: mi.MediumPtr | None = None


@dataclass
class Paths:
    """Paths with the same number of vertices, one in each lane.

    Attributes:
        emitted: The ray that leaves the light.
        vertices: From light to camera.
        camera_ray: The ray of the camera.
        active: The lanes that have a path.
        transmittance: For each segment, from light to camera, what weights know of it; ``None``
            without media.
    """

    emitted: EmittedRay
    vertices: list[PathVertex]
    camera_ray: mi.Ray3f
    active: mi.Bool
    transmittance: list[mi.Float] | None = None


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


def trace_in_medium(
    scene: mi.Scene, emission: LightEmission, sensor: mi.Sensor, count: int, lanes: int = 4096
) -> Paths:
    """Paths whose ``count`` vertices all lie in the medium of the sensor, with any transmittances.
    """
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(7, lanes)
    active = mi.Bool(True)
    emitted = emission.sample(numbers, mi.Float(0), mi.Ray3f().wavelengths, active)
    active &= dr.max(emitted.weight) > 0
    medium = dr.full(mi.MediumPtr, sensor.get_medium(), lanes)
    d, p, places = emitted.ray.d, emitted.start.p, []
    start = dr.select(emitted.is_infinite, 2 * mi.Point3f(numbers.next_1d(), 0, 0) - d, p)
    for _ in range(count):
        start = start + d * (0.2 + numbers.next_1d())
        places.append(start)
        d = mi.warp.square_to_uniform_sphere(numbers.next_2d())
    dr.eval(emitted, places)
    last = dr.zeros(mi.SurfaceInteraction3f, lanes)
    last.p = places[-1]
    connection, _ = ConnectableSensor(sensor).connect(last, numbers.next_2d(), active)
    active &= connection.active
    ends = [places[0] - emitted.ray.d, *places, places[-1] + connection.d]
    vertices = []
    for before, at, behind in zip(ends, ends[1:], ends[2:]):
        sides = []
        for other in (before, behind):
            si = dr.zeros(mi.SurfaceInteraction3f, lanes)
            si.p, si.t = at, dr.zeros(mi.Float, lanes)
            si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
            si.wi = dr.normalize(other - at)
            sides.append(si)
        vertices.append(PathVertex(
            at, mi.Normal3f(0), *sides, dr.zeros(mi.BSDFPtr, lanes), mi.Bool(False), mi.Float(1),
            medium,
        ))  # fmt: skip
    first = vertices[0].from_light
    first.t = dr.select(emitted.is_infinite, 1, dr.norm(first.p - emitted.start.p))
    passed = [0.1 + 0.9 * numbers.next_1d() for _ in range(count + 1)]
    camera_ray = mi.Ray3f(connection.target, -connection.d)
    paths = Paths(emitted, vertices, camera_ray, active, passed)
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
#: camera path, for weights: not once, as all else. And the density of merging.
CONNECTIONS, LIGHT_PATHS, MERGING = 0.4, 3.0, 100.0


def weights_of_techniques(
    scene: mi.Scene,
    paths: Paths,
    emits: LightEmission,
    sensor: ConnectableSensor | None,
    next_event: EmitterSampling,
    selection: SubpathSelection | None = None,
    merging: str | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As the estimator computes them: the weight of each technique, [s, path], 0 where it cannot
    find the path, followed, with ``merging`` (see ``vcm``), by the weight of merging at each
    vertex; which of the lanes have a path; and for all techniques but the first two the ratios of
    the densities of these to its own, and the squared ratios of other connections and of the light
    image, [s − 2, 4, path]."""
    terms = SurfaceTerms() if paths.transmittance is None else MediumTerms(False)
    sums = PartialSums(
        CONNECTIONS, splits=True, selection=selection, light_paths=LIGHT_PATHS, terms=terms,
        merging=merging and mi.Float(MERGING), merges_all=merging == "all",
        merging_in_media=mi.Float(MERGING) if merging and terms.sees_media else None,
    )  # fmt: skip
    active = paths.active
    passed = paths.transmittance or [1.0] * (len(paths.vertices) + 1)
    kind = BidirectionalProgramInMedia if terms.sees_media else BidirectionalProgram
    program, weights = kind(scene, sums, emits, sensor), Weights()
    ctx = mi.BSDFContext()
    vertices, emitted = paths.vertices, paths.emitted

    # ----- Subpaths from the light -----
    si = vertices[0].from_light
    first = LightSums(sums, next_event).at_first(scene, emitted, si, active, passed[0])
    at_first = mi.Bool(True)
    arrived = sums.arrive(first, si, mi.Float(1), at_first, by_light=True)
    by_light = [
        replace(
            first, region=arrived.region, count=arrived.count, by_kind=mi.Vector2f(0),
            is_caustic=merging and mi.Bool(False),
            merging=sums.merging_at(si, vertices[0].medium),
        )
    ]  # fmt: skip
    # Which techniques scatter only where their densities are not 0
    from_light, from_camera = [mi.Bool(True)], [mi.Bool(True), mi.Bool(True)]
    for a, b, T in zip(vertices, vertices[1:], passed[1:]):
        si, wo = a.from_light, a.from_camera.wi
        pdf = dr.select(a.is_delta, 1, terms.density(ctx, a.bsdf, si, a.medium, wo, active))
        from_light.append(from_light[-1] & (pdf > 0))
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
        bs.eta = a.η
        cosine = dr.select(a.is_delta, cosine_of_delta(si, bs), terms.cosine(si, wo))
        left = sums.leave(
            by_light[-1], cosine, pdf,
            terms.reverse_density(ctx, a.bsdf, si, a.medium, wo, active), a.is_delta,
            a is vertices[0],
            by_light=True,
        )  # fmt: skip
        arrived = sums.arrive(
            left, b.from_light, dr.squared_norm(b.p - a.p) / T, ~at_first, by_light=True
        )
        arrived.is_caustic = merging and a.is_delta
        arrived.merging = sums.merging_at(b.from_light, b.medium)
        by_light.append(arrived)

    # ----- Subpaths from the camera -----
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0),
        Arrival(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)), None,
        program.begin(paths.camera_ray),
    )  # fmt: skip
    by_camera: list[Vertex] = []
    state = next_event.begin(None, paths.camera_ray)
    for v, T in zip(reversed(vertices), reversed(passed)):
        si, in_medium = v.from_camera, None
        if v.medium is not None:
            mei = dr.zeros(mi.MediumInteraction3f, dr.width(si))
            mei.medium = v.medium
            in_medium = MediumVertex(mi.Bool(True), mei, T)
        path.history = program.arrive(path, si, in_medium)
        vertex = Vertex(si, v.bsdf, path, None, in_medium)
        by_camera.insert(0, vertex)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
        bs.wo, bs.eta = v.from_light.wi, dr.rcp(v.η)
        bs.pdf = terms.density(ctx, v.bsdf, si, v.medium, bs.wo, active)
        bs.pdf = dr.select(v.is_delta, 1, bs.pdf)
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

    in_medium = None
    if paths.transmittance is not None:
        mei = dr.zeros(mi.MediumInteraction3f)
        in_medium = MediumVertex(mi.Bool(False), mei, passed[0])
    path.history = program.arrive(path, si, in_medium)
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
    by_scattering = terms.density(
        ctx, first.bsdf, first.from_camera, first.medium, first.from_light.wi, active
    )
    connected = program.connection(
        weights, scene, by_camera[0], ds, ds.pdf / passed[0], by_scattering
    )
    found.append(dr.select(first.is_delta, 0, connected))

    # ----- s, t ≥ 2 -----
    ratios = []
    for i, (a, b) in enumerate(zip(vertices, vertices[1:])):
        ends = [
            End(si, wo, terms.density(ctx, v.bsdf, si, v.medium, wo, active),
                terms.reverse_density(ctx, v.bsdf, si, v.medium, wo, active), partial)
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
        squared_distance = dr.squared_norm(b.p - a.p) / passed[i + 1]
        joined = joining_weight(sums, *ends, squared_distance, expected)
        found.append(dr.select(a.is_delta | b.is_delta, 0, joined))
        factor = 1 / (CONNECTIONS * expected)
        is_first = b is vertices[-1], i == 0
        competing = joining_rivals(
            sums, *ends, squared_distance, is_first, factor, expected
        )
        ratios.append([*competing.by_camera, *competing.by_kind])

    # ----- t = 1 -----
    if sensor is not None:
        last = vertices[-1]
        origin, pdf = sensor.origin(paths.camera_ray)
        wo = last.from_camera.wi
        spread = 1 if sensor.is_parallel else dr.squared_norm(last.p - origin)
        density = pdf / spread * terms.cosine(last.from_light, wo) * passed[-1]
        reverse = terms.reverse_density(ctx, last.bsdf, last.from_light, last.medium, wo, active)
        seen = weight(sums.others(density, by_light[-1], reverse) / sums.image_count)
        found.append(dr.select(last.is_delta, 0, seen))
        ends = density, by_light[-1], reverse, len(vertices) == 1
        kinds = sums.by_kind(*ends, by_light=True) / sums.image_count
        ratios.append([*(sums.by_camera(*ends) / LIGHT_PATHS), *kinds])
    # from_camera: for s = 0, 1, …, t = 1; from_light: for s = 2, …
    can = [from_camera[s] & (from_light[s - 2] if s > 1 else True) for s in range(len(found))]

    # ----- Merging -----
    for i, v in enumerate(vertices if merging else ()):
        to_light, to_camera = v.from_light.wi, v.from_camera.wi
        pdf = terms.density(ctx, v.bsdf, v.from_camera, v.medium, to_light, active)
        reverse = terms.density(ctx, v.bsdf, v.from_light, v.medium, to_camera, active)
        merged = sums.merging_weight(by_light[i], pdf, by_camera[i].path.history, reverse)
        merges = ~v.is_delta if merging == "all" else by_light[i].is_caustic & ~v.is_delta
        found.append(dr.select(merges, merged, 0))
        can.append(from_light[i] & from_camera[i + 1])
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
