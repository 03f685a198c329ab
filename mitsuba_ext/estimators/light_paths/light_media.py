"""Finds the participating medium in which a light path begins. Mitsuba's emitters do not store it.

The surfaces around a light determine it: it is the medium on the near side of the first surface
that borders on a medium and that a ray from the light meets. A light that no such surface surrounds
lies in the medium outside of all boundaries.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.media import may_have_media
from ...transport.path_decisions import SceneQuery
from .emission import EmittedRay


@dr.syntax
def medium_at_start(
    query: SceneQuery, scene: mi.Scene, emitted: EmittedRay, outside: mi.MediumPtr, active: mi.Bool
) -> mi.MediumPtr:
    """The medium in which emitted rays begin; null in a vacuum.

    Rays pass through all surfaces in search of a boundary. A ray that meets none is followed in the
    opposite direction: boundaries need not be closed (the surface of a sea).

    Parameters:
        query: How rays intersect the scene.
        outside: The medium outside of all boundaries (:func:`outer_medium`).
    """
    start, d = emitted.start, emitted.ray.d
    # A light may be a boundary itself
    knows = active & start.is_medium_transition()
    medium = dr.select(knows, start.target_medium(d), outside)
    ray, has_turned = mi.Ray3f(emitted.ray), mi.Bool(False)
    back = mi.Ray3f(emitted.ray)
    back.d = -d
    searches = active & ~knows
    while dr.hint(searches, label="medium of a light"):
        pi = query.closest(scene, ray, coherent=False, active=searches)
        is_met = searches & pi.is_valid()
        si = query.interaction(pi, ray)
        knows = is_met & si.is_medium_transition()
        medium = dr.select(knows, si.target_medium(-ray.d), medium)
        turns = searches & ~is_met & ~has_turned
        ray = dr.select(is_met, query.starts.along(si, ray.d), ray)
        ray = dr.select(turns, back, ray)
        has_turned |= turns
        searches &= turns | (is_met & ~knows)
    return medium


def outside_of(
    plugin: str, query: SceneQuery, scene: mi.Scene, sensor: mi.Sensor
) -> mi.MediumPtr | None:
    """:func:`outer_medium` of a scene; ``None`` if the scene has no media.

    No light from infinity would get through a medium that has no boundary. ``volpath`` lets such
    light begin at a distance that depends on the size of the scene.

    Parameters:
        plugin: The plugin's name in error messages.

    Raises:
        NotImplementedError: A light at infinity shines through a medium that has no boundary.
    """
    if not may_have_media(scene):
        return None
    outside = outer_medium(query, scene, sensor)
    infinite = [e for e in scene.emitters() if mi.has_flag(e.flags(), mi.EmitterFlags.Infinite)]
    if infinite and dr.any(outside != None):  # noqa: E711
        raise NotImplementedError(
            f'"{plugin}": the light "{infinite[0].class_name()}" shines from infinity, through a '
            f'participating medium that nothing bounds: enclose the medium in a shape with the '
            f'BSDF "null", or use "composed_path"'
        )
    return outside


def outer_medium(query: SceneQuery, scene: mi.Scene, sensor: mi.Sensor) -> mi.MediumPtr:
    """The medium outside of all boundaries: behind the last one that a ray from the sensor crosses;
    if it crosses none, the sensor's medium."""
    # Not through the centre of the film, where edges may meet
    ray, _ = sensor.sample_ray(
        sensor.shutter_open(), 0.5, mi.Point2f(0.47, 0.54), mi.Point2f(0.5)
    )  # fmt: skip
    medium = _behind_all(query, scene, mi.Ray3f(ray), mi.MediumPtr(sensor.get_medium()))
    dr.make_opaque(medium)
    return medium


@dr.syntax
def _behind_all(
    query: SceneQuery, scene: mi.Scene, ray: mi.Ray3f, medium: mi.MediumPtr
) -> mi.MediumPtr:
    """The medium behind the last boundary that a ray crosses; ``medium`` if it crosses none."""
    active = mi.Bool(True)
    while dr.hint(active, label="outer medium"):
        pi = query.closest(scene, ray, coherent=False, active=active)
        active &= pi.is_valid()
        si = query.interaction(pi, ray)
        crosses = active & si.is_medium_transition()
        medium = dr.select(crosses, si.target_medium(ray.d), medium)
        ray = dr.select(active, query.starts.along(si, ray.d), ray)
    return medium
