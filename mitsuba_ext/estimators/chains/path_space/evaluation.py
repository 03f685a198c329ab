"""Traces a path from the camera, for its contribution and the densities of the techniques that make
it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_bsdf, sample_bsdf
from ....transport.hidden_emitters import behind_emitters
from ....transport.numbers import Numbers
from ....util.spectra import to_rgb
from ...light_paths.scattering import geometric_cosine, reverse_density
from .light_subpaths import HIGH, LOW
from .lights import light_start_densities
from .memory import Head, Logs, PathMemory, Place, log
from .plan import Plan
from .space import PathSpace, towards, turned

#: The light index of a surface that does not emit.
NO_LIGHT = 0xFFFFFFFF

#: The maximum squared difference between the direction of a delta lobe and the direction to the
#: next vertex. A larger one means that the path took another lobe. It is not 0 because rays start
#: at an offset from the surface.
_MAX_MISS = 0.1


@dataclass
class Evaluation:
    """The contribution of a path.

    Attributes:
        position: The position on the film, in pixels.
        value: The integrand without geometric factors, as a colour.
        log_geometry: The logarithm of the geometric factors.
        scatter, shadow: The number of rays traced between vertices, and of shadow rays.
        active: The lanes with a valid contribution.
    """

    position: mi.Point2f
    value: mi.Color3f
    log_geometry: mi.Float
    scatter: mi.UInt32
    shadow: mi.UInt32
    active: mi.Bool


@dr.syntax
def trace_from_camera(
    space: PathSpace,
    memory: PathMemory,
    old: Head,
    new: Head,
    plan: Plan,
    numbers: Numbers,
    active: mi.Bool,
) -> tuple[PathMemory, Head, Numbers, Evaluation]:
    """Makes the vertices up to ``plan.grown``, and evaluates the path. Its other vertices are
    already in memory.

    Returns:
        The memory, with the vertices and their densities; the new path with its light, which
        tracing may have found; the random numbers; and the contribution of the path.
    """
    scene, query, kinds, emission = space.scene, space.query, space.kinds, space.emission
    ctx = space.heroes.context()
    active = mi.Bool(active)
    rays = space.camera_ray(new)
    ray = mi.Ray3f(rays.ray)
    length, at = new.length, new.at
    pi = query.closest(scene, ray, coherent=False, active=active)
    if dr.hint(space.hides_emitters, mode="scalar"):
        ray, pi = behind_emitters(query, scene, ray, pi, active)
    origin, film_density = mi.Point3f(ray.o), mi.Float(1)
    if dr.hint(space.connectable is not None, mode="scalar"):
        origin, film_density = space.connectable.origin(rays.ray)
    value = mi.Spectrum(rays.importance)
    hero_is_alone = space.heroes.begin()
    emitter = mi.UInt32(new.emitter)
    # One lane for each path, because local memory is written at this index
    index = dr.full(mi.UInt32, 1, dr.width(new.film))
    geometry = mi.Float(0)
    # The densities so far of the previous vertex, and the cosine of the direction that leaves it
    before, cosine = _no_logs(), mi.Float(1)
    p_before = mi.Point3f(origin)
    light_weight = mi.Spectrum(1)
    scatter, shadow = mi.UInt32(0), mi.UInt32(0)
    is_found = mi.Bool(False)
    # Whether the path has passed only null surfaces. If lights are hidden, it does not see the sky
    is_straight = mi.Bool(True)
    while dr.hint(active, label="path"):
        si = query.interaction(pi, ray)
        place = memory.places[at + index]
        is_end = index == length
        is_new = (index > plan.keeps) & (index <= plan.grown)

        # ----- The stored vertex of the path? -----
        light = _light(space, si, active & is_end)
        emitter = dr.select(is_end & is_new & (light != NO_LIGHT), light, emitter)
        unhittable = kinds.is_unhittable(emitter, is_end)
        is_infinite = kinds.is_infinite(emitter, is_end)
        is_direction = is_end & (is_infinite | kinds.is_beam(emitter, is_end))
        distance = dr.norm(si.p - p_before)
        target = memory.places[at + index + 1]
        next_is_end = index + 1 == length
        grows = (index + 1 > plan.keeps) & (index + 1 <= plan.grown)
        towards_light = next_is_end & ~grows
        given = towards_light & kinds.is_infinite(emitter, towards_light)
        ahead = dr.select(is_end | grows | given, dr.inf, dr.norm(target.p - place.p))
        found = is_new | space.is_same(si, place.p, dr.minimum(distance, ahead))
        shines = (light != NO_LIGHT) & (light == emitter)
        ends = dr.select(unhittable, ~is_new, shines & (is_infinite | found))
        if dr.hint(space.hides_emitters, mode="scalar"):
            ends &= ~(is_infinite & is_straight)
        active &= dr.select(is_end, ends, si.is_valid() & found)

        # ----- The densities of the segment that ends here -----
        d = mi.Vector3f(ray.d)
        arrival = dr.abs(dr.dot(si.n, d)) * dr.rcp(dr.square(distance))
        arrival = dr.select(is_end & (unhittable | is_infinite), 1, arrival)
        from_camera = log(arrival * dr.select(index == 1, film_density, 1))
        reached = dr.select(is_end & unhittable, dr.norm(place.p - p_before), distance)
        departure = cosine * dr.select(is_direction, 1, dr.rcp(dr.square(reached)))
        before = replace(before, from_light=before.from_light + log(departure))
        geometry += from_camera

        # ----- The light -----
        ref = dr.zeros(mi.Interaction3f, dr.width(si))
        ref.p, ref.time = p_before, si.time
        starts, leaves = light_start_densities(
            kinds, emission, scene, emitter, -d, emission.front(si), ref, active & is_end
        )
        L = kinds.emitter(emitter, active & is_end & ~unhittable).eval(
            si, active & is_end & ~unhittable
        )
        value = dr.select(is_end, value * dr.select(unhittable, light_weight, L), value)
        is_found |= active & is_end
        goes_on = active & ~is_end

        # ----- The direction to the next vertex -----
        bsdf = si.bsdf(ray)
        walks = grows & ~plan.perturbs
        number, sample = numbers.next_1d(), numbers.next_2d()
        lobe = dr.select(walks, number, place.lobe)
        joins = (index == plan.grown) | (index == plan.grown + 1)
        was_discrete = (place.is_discrete == 1) & ~joins
        # All other directions follow from the stored vertices
        is_sampled = goes_on & (walks | was_discrete)
        bs, weight = sample_bsdf(bsdf, ctx, si, lobe, sample, is_sampled)
        goes_on &= ~walks | (bs.pdf > 0)
        is_sampled_discrete = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        is_discrete = dr.select(walks, is_sampled_discrete, was_discrete)
        next_d = towards(si.p, target, given)
        is_given = mi.Bool(False)
        if dr.hint(kinds.has_unhittable, mode="scalar"):
            is_given = towards_light & kinds.is_unhittable(emitter, towards_light) & goes_on
            ds, weight_now = kinds.emitter(emitter, is_given).sample_direction(
                si, mi.Point2f(0.5), is_given
            )
            next_d = dr.select(is_given, ds.d, next_d)
            light_weight = dr.select(is_given, weight_now, light_weight)
            occluded = query.occluded(scene, si, ds, is_given)
            shadow += dr.select(is_given, 1, 0)
            goes_on &= ~is_given | (~occluded & (ds.pdf > 0))
            beam_end = is_given & kinds.is_beam(emitter, is_given)
            end_p = dr.select(beam_end, ds.p, target.p)
            memory.places.write(
                Place(end_p, target.lobe, target.is_discrete, target.d), at + index + 1,
                goes_on & beam_end,
            )
        aside = turned(memory.places[old.at + index].d, sample, LOW, HIGH)
        sampled_d = dr.select(plan.perturbs & ~is_discrete, aside, si.to_world(bs.wo))
        next_d = dr.select(grows, sampled_d, next_d)
        wo = si.to_local(next_d)

        # ----- The BSDF and its densities -----
        smooth, pdf = eval_bsdf(bsdf, ctx, si, wo, goes_on & ~is_discrete)
        reverse = reverse_density(ctx, bsdf, si, wo, goes_on & ~is_discrete)
        agrees = is_sampled_discrete & (dr.squared_norm(bs.wo - wo) < _MAX_MISS)
        goes_on &= ~is_discrete | agrees
        if dr.hint(space.hides_emitters, mode="scalar"):
            is_straight &= is_discrete & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        factor = dr.select(is_discrete, weight, smooth)
        through = mi.BSDFSample3f(bs)
        through.wo = wo
        through.sampled_type = dr.select(is_discrete, bs.sampled_type, mi.UInt32(0))
        factor, _count, hero_is_alone = space.heroes.scatter(
            hero_is_alone, factor, bsdf, si, through
        )
        value = dr.select(goes_on, value * si.to_world_mueller(factor, -wo, si.wi), value)
        goes_on &= dr.max(dr.abs(value)) > 0

        ray = query.starts.along(si, next_d)
        # Aimed from the offset origin of the ray, which would miss a near vertex otherwise
        aimed = dr.normalize(target.p - ray.o)
        ray.d = dr.select(grows | given | is_given, next_d, aimed)

        # ----- Store -----
        before_at, here_at = at + index - 1, at + index
        through_lobe = dr.select(is_discrete & ~is_end, _lobe_ratio(si, bs), 0)
        before = replace(before, from_light=before.from_light + through_lobe)
        memory.logs.write(before, before_at, active)
        memory.logs.write(
            Logs(from_camera, log(starts), mi.Float(0), log(leaves)), here_at, active & is_end
        )
        memory.places.write(
            Place(
                dr.select(is_new, dr.select(is_infinite, d, si.p), place.p),
                lobe,
                dr.select(is_end, mi.UInt32(0), dr.select(is_discrete, mi.UInt32(1), 0)),
                ray.d,
            ),
            here_at, active & (is_end | goes_on),
        )
        before = Logs(
            from_camera,
            mi.Float(0),
            dr.select(is_discrete, 0, log(pdf)),
            dr.select(is_discrete, 0, log(reverse)),
        )
        cosine = geometric_cosine(si, wo)
        p_before = mi.Point3f(si.p)
        active = goes_on
        pi = query.closest(scene, ray, coherent=False, active=active)
        scatter += dr.select(active, 1, 0)
        index += 1

    is_found &= dr.all(dr.isfinite(value)) & dr.isfinite(geometry)
    head = replace(new, emitter=emitter)
    colour = dr.select(is_found, to_rgb(value, rays.ray.wavelengths), 0)
    found = Evaluation(rays.position, colour, geometry, scatter, shadow, is_found)
    return memory, head, numbers, found


def _no_logs() -> Logs:
    return Logs(mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0))


def _light(space: PathSpace, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
    """The index of the light hit by a ray."""
    emitter = si.emitter(space.scene, active)
    index = space.emission.index(emitter, active)
    return dr.select(emitter != None, index, NO_LIGHT)  # noqa: E711


def _lobe_ratio(si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f) -> mi.Float:
    """The logarithm of the ratio of solid angles behind and before a delta lobe: the factor by
    which a density of directions changes for the reverse direction through the lobe. It is 0 except
    for refraction, where ``η² cos θ dω`` is the same on both sides. The lobe may have its own
    normal."""
    refracts = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
    n = si.wi + bs.eta * bs.wo
    ratio = dr.abs(dr.dot(n, si.wi)) / (dr.abs(dr.dot(n, bs.wo)) * dr.square(bs.eta))
    return dr.select(refracts, log(ratio), 0)
