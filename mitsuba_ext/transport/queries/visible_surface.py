"""What covers a pixel: the first surface that a camera ray meets and does not see through."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...scene.bsdfs import is_in_table
from ...scene.surface_names import SurfaceNames
from ...util.arrays import channel_mean
from ..hidden_emitters import behind_emitters
from ..scene_query import SceneQuery


class VisibleSurface(NamedTuple):
    """The surface that covers the pixel of a ray.

    Attributes:
        shape: The shape, inside an instance too.
        instance: The instance, if the scene has any.
        is_valid: Whether there is a surface.
    """

    shape: mi.ShapePtr
    instance: mi.ShapePtr | None
    is_valid: mi.Bool


def first_surface(
    query: SceneQuery, scene: mi.Scene, ray: mi.Ray3f, names: SurfaceNames
) -> VisibleSurface:
    """The first surface that each ray meets."""
    ray = mi.Ray3f(ray)
    pi = query.closest(scene, ray, coherent=True, active=mi.Bool(True))
    return _surface(query, ray, pi, names)


def visible_surface(
    query: SceneQuery,
    scene: mi.Scene,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    names: SurfaceNames,
    hide_emitters: bool,
) -> VisibleSurface:
    """The surface that covers the pixel of each ray, which meets ``pi`` first.

    Opacity masks, the BSDF ``null`` and filters of light are transparent: a ray passes through them
    with the probability of the light that passes straight on. Panes of ``thindielectric``, glass
    and mirrors cover the pixel.

    Parameters:
        hide_emitters: Whether rays pass through area lights.
    """
    # A loop changes the objects of its state
    ray, pi = mi.Ray3f(ray), dr.copy(pi)
    if hide_emitters:
        ray, pi = behind_emitters(query, scene, ray, pi, mi.Bool(True))
    if names.transparent is not None:
        ray, pi = _behind(query, scene, ray, pi, names)
    return _surface(query, ray, pi, names)


def _surface(query, ray, pi, names) -> VisibleSurface:
    if not names.has_instances:
        return VisibleSurface(pi.shape, None, pi.is_valid())
    si = query.interaction(pi, ray)  # which finds the shape inside an instance
    return VisibleSurface(si.shape, si.instance, si.is_valid())


def _may_be_transparent(pi: mi.PreliminaryIntersection3f, names: SurfaceNames) -> mi.Bool:
    found = is_in_table(names.transparent, pi.shape.bsdf())
    if names.has_instances:  # the shape inside is not known yet
        found |= pi.instance != None  # noqa: E711
    return pi.is_valid() & found


@dr.syntax
def _behind(query, scene, ray, pi, names):
    """The first surface that is not transparent, and the ray that meets it."""
    # Random numbers of the ray itself, so that masks do not change the numbers of the image
    bits = [dr.reinterpret_array(mi.UInt32, x) for x in (*ray.o, *ray.d, ray.time)]
    first, second = bits[0] + 3 * bits[2] + 5 * bits[4], bits[1] + 3 * bits[3] + 5 * bits[5]
    second += 7 * bits[6]
    active = _may_be_transparent(pi, names)
    while active:
        si = query.interaction(pi, ray)
        bsdf = si.bsdf()
        T = channel_mean(mi.unpolarized_spectrum(bsdf.eval_null_transmission(si, active)))
        first += 0x9E3779B9
        active &= is_in_table(names.transparent, bsdf)
        active &= mi.sample_tea_float32(first, second) < T
        if active:
            ray = query.starts.along(si, ray.d)
            pi = query.closest(scene, ray, coherent=False, active=mi.Bool(True))
        active &= _may_be_transparent(pi, names)
    return ray, pi


def object_number(names: SurfaceNames, surface: VisibleSurface) -> mi.UInt32:
    """The number of the object; 0 where there is none."""
    shape = surface.shape
    if names.has_instances:
        shape = dr.select(surface.instance != None, surface.instance, shape)  # noqa: E711
    return _looked_up(names.object_numbers, shape, surface.is_valid)


def material_number(names: SurfaceNames, surface: VisibleSurface) -> mi.UInt32:
    """The number of the material; 0 where there is none."""
    return _looked_up(names.material_numbers, surface.shape.bsdf(), surface.is_valid)


def _looked_up(table: mi.UInt32, pointer: mi.ShapePtr | mi.BSDFPtr, active: mi.Bool) -> mi.UInt32:
    index = dr.reinterpret_array(mi.UInt32, pointer)
    return dr.gather(mi.UInt32, table, index, active & (index < dr.width(table)))
