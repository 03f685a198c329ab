"""The output variables of Mitsuba's ``aov``, for scenes with shapes that ``aov`` does not see."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.aovs import split_aovs
from ...scene.surface_names import SurfaceNames
from .lightweight_scene import LightweightQuery
from .moving_aovs import moving_aovs
from .moving_scene import MovingSceneQuery
from .scene import scene_query
from .visible_surface import first_surface, object_number


def output_variables(
    aov: mi.SamplingIntegrator,
    aovs: str,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.RayDifferential3f,
    names: SurfaceNames | None = None,
) -> list[mi.Float]:
    """The channels along camera rays, at their times.

    Parameters:
        aov: Mitsuba's integrator, made with the list ``aovs``.
        names: The names of the objects, if the list has a ``shape_index``: Mitsuba's is a pointer.
    """
    query = scene_query(scene)
    values = _values(aov, aovs, query, scene, sampler, ray)
    channels = aov.aov_names()
    for name in [name for name, kind in split_aovs(aovs) if kind == "shape_index"]:
        number = object_number(names, first_surface(query, scene, ray, names))
        values[channels.index(f"{name}.I")] = mi.Float(number)
    return values


def _values(aov, aovs, query, scene, sampler, ray) -> list[mi.Float]:
    rest = query.rest if isinstance(query, LightweightQuery) else query
    if isinstance(rest, MovingSceneQuery):
        values = moving_aovs(aov, aovs, rest, scene, sampler, ray)
    else:
        values = aov.sample(scene, sampler, ray, None, mi.Bool(True))[2]
    if query is rest:
        return values
    ray_alone = mi.Ray3f(ray)
    pi = query.closest(scene, ray_alone, coherent=True, active=mi.Bool(True))
    is_lightweight = query.is_lightweight(pi)
    si = dr.select(
        is_lightweight, query.interaction(pi, ray_alone), dr.zeros(mi.SurfaceInteraction3f)
    )
    kinds = [kind for _name, kind in split_aovs(aovs)]
    mine = [channel for kind in kinds for channel in _channels(kind, si, ray, is_lightweight)]
    return [dr.select(is_lightweight, a, b) for a, b in zip(mine, values)]


def _channels(
    kind: str, si: mi.SurfaceInteraction3f, ray: mi.RayDifferential3f, active: mi.Bool
) -> list[mi.Float]:
    if kind == "albedo":
        return list(_albedo(si, ray, active))
    if kind == "depth":
        return [si.t]
    if kind == "sh_normal":  # Of the shape: the frames of normal maps are out of reach
        return list(si.sh_frame.n)
    if kind in ("duv_dx", "duv_dy"):
        si.compute_uv_partials(ray)
    if kind == "prim_index":
        return [mi.Float(si.prim_index)]
    if kind == "shape_index":  # replaced by the caller
        return [mi.Float(0)]
    return list(getattr(si, {"position": "p", "geo_normal": "n"}.get(kind, kind)))


def _albedo(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Color3f:
    albedo = mi.unpolarized_spectrum(si.bsdf(ray).eval_diffuse_reflectance(si, active))
    if mi.is_monochromatic:
        return mi.Color3f(albedo.x)
    if not mi.is_spectral:
        return albedo
    pdf = mi.pdf_rgb_spectrum(ray.wavelengths)
    albedo *= dr.select(pdf != 0, dr.rcp(pdf), 0)
    return mi.spectrum_to_srgb(albedo, ray.wavelengths, active)
