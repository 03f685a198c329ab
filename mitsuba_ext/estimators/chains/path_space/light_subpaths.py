"""Makes the part of a proposal that starts at the light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import sample_bsdf
from ....transport.numbers import Numbers
from .memory import Head, PathMemory, Place
from .plan import Plan
from .space import PathSpace, turned

#: The minimum and the maximum angle, in radians, by which perturbations turn directions. For light
#: from infinity: the displacement of the ray, in units of the scene's radius.
LOW, HIGH = 1e-4, 0.1


@dr.syntax
def grow_from_light(
    space: PathSpace,
    memory: PathMemory,
    old: Head,
    new: Head,
    plan: Plan,
    ray: mi.Ray3f,
    numbers: Numbers,
    active: mi.Bool,
) -> tuple[PathMemory, Head, Numbers, mi.Bool]:
    """Makes the vertices from ``plan.rest`` − 1 down to ``plan.grown`` + 1.

    Parameters:
        memory: The memory, with the old path and the kept vertices of the new path.
        ray: Any camera ray of the new path, for its time and wavelengths.

    Returns:
        The memory; the new path with its light; the random numbers; and the lanes in which all
        vertices were made.
    """
    active = mi.Bool(active)
    begins = active & (plan.rest > new.length)
    ray, index, emitter, is_sound, memory = _begin(
        space, memory, old, new, plan, ray, numbers, active, begins
    )
    head = Head(
        new.at, new.length, new.film, new.aperture, new.time, new.wavelength,
        dr.select(begins, emitter, new.emitter),
    )  # fmt: skip
    ctx = space.heroes.context()
    ctx.mode = mi.TransportMode.Importance
    last = plan.grown + 1
    active &= is_sound
    # The vertex on the light may be the only one to make
    is_done = active & (index < last)
    active &= ~is_done
    while dr.hint(active, label="light subpath"):
        pi = space.query.closest(space.scene, ray, coherent=False, active=active)
        si = space.query.interaction(pi, ray)
        bsdf = si.bsdf(ray)
        place = memory.places[head.at + index]
        is_kept = index == plan.rest
        is_last = index == last
        # The ray must hit the kept vertex
        active &= si.is_valid() & (~is_kept | space.is_same(si, place.p, si.t))

        # ----- The direction to the next vertex -----
        lobe, sample = numbers.next_1d(), numbers.next_2d()
        lobe = dr.select(plan.perturbs, place.lobe, lobe)
        bs, weight = sample_bsdf(bsdf, ctx, si, lobe, sample, active & ~is_last)
        is_discrete = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        d = si.to_world(bs.wo)
        scatters = (bs.pdf > 0) & (dr.max(dr.abs(weight)) > 0)
        turns = plan.perturbs & is_kept
        before = memory.places[old.at + index - 1]
        d = dr.select(turns, turned(dr.normalize(before.p - place.p), sample, LOW, HIGH), d)
        # Between its first and its last vertex, a perturbation passes only through delta lobes
        goes_on = ~is_last & (turns | (scatters & (~plan.perturbs | is_discrete)))

        # ----- Store the vertex -----
        p = dr.select(is_kept, place.p, si.p)
        discrete = dr.select(goes_on & is_discrete & ~turns, mi.UInt32(1), 0)
        here = Place(p, lobe, discrete, mi.Vector3f(0))
        memory.places.write(here, head.at + index, active)
        is_done |= active & is_last
        active &= goes_on
        ray = space.query.starts.along(si, d)
        index -= 1
    return memory, head, numbers, is_done


def _begin(space, memory, old, new, plan, ray, numbers, active, begins):
    """The first ray of the walk: from a sampled point on a light, or a ray that hits the kept
    vertex at which the walk starts. Returns the ray with the index of the vertex to which it leads,
    the emitter, the lanes with such a ray, and the memory."""
    emitted = space.emission.sample(numbers, ray.time, ray.wavelengths, begins)
    kinds = space.kinds
    is_infinite = kinds.is_infinite(emitted.index, begins)
    p = dr.select(is_infinite, -emitted.ray.d, emitted.start.p)
    end = Place(p, mi.Float(0), mi.UInt32(0), mi.Vector3f(0))
    memory.places.write(end, new.at + new.length, begins)
    is_sound = begins & (dr.max(emitted.weight) > 0)

    # ----- Back to a kept vertex -----
    kept = active & ~begins
    place = memory.places[new.at + plan.rest]
    ahead, behind = plan.rest + 1, plan.rest - 1
    is_end = plan.rest == new.length
    neighbour = memory.places[dr.select(is_end, old.at + behind, new.at + ahead)]
    beyond = kinds.is_infinite(new.emitter, kept)
    is_direction = beyond & ~is_end & (ahead == new.length)
    way = dr.select(
        is_direction, neighbour.p * (0.01 * space.radius), 0.5 * (neighbour.p - place.p)
    )
    o, d = place.p + way, -dr.normalize(way)
    index = dr.select(begins, new.length - 1, plan.rest)

    # ----- Perturb the direction at a light without a surface -----
    leaves = kept & is_end & (beyond | kinds.is_point(new.emitter, kept))
    sample = numbers.next_2d()
    aim = dr.normalize(neighbour.p - place.p)
    aside = _aside(place.p, sample) * space.radius
    # At the distance where rays emitted by lights at infinity begin
    far = neighbour.p + aside + place.p * (2 * space.radius)
    o = dr.select(leaves, dr.select(beyond, far, place.p), o)
    aimed = dr.select(beyond, -place.p, turned(aim, sample, LOW, HIGH))
    d = dr.select(leaves, aimed, d)
    index = dr.select(leaves, plan.rest - 1, index)

    start = mi.Ray3f(ray)
    start.o = dr.select(begins, emitted.ray.o, o)
    start.d = dr.select(begins, emitted.ray.d, d)
    start.maxt = dr.largest(mi.Float)
    return start, index, emitted.index, is_sound | kept, memory


def _aside(d: mi.Vector3f, sample: mi.Point2f) -> mi.Vector3f:
    """A random displacement perpendicular to ``d``; the logarithm of its length is uniform."""
    length = LOW * dr.power(HIGH / LOW, sample.x)
    y, x = dr.sincos(dr.two_pi * sample.y)
    return mi.Frame3f(d).to_world(mi.Vector3f(length * x, length * y, 0))
