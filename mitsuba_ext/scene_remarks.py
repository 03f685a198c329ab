"""What an integrator passes over in a scene without a word."""

from __future__ import annotations

from collections.abc import Iterable

import mitsuba as mi

from .nesting import with_nested

#: They look at surfaces only.
_NO_LIGHT_NEEDED = ("AOVIntegrator", "DepthIntegrator")


def scene_remarks(
    scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator, name: str
) -> list[str]:
    """Sentences about media that ``integrator``, to be called ``name``, does not see, and about
    missing lights. Nothing is said about integrators that are neither Mitsuba's nor ours."""
    tracers = [
        each
        for each in with_nested(integrator)
        if type(each).__module__.split(".")[0] in ("mitsuba", "mitsuba_ext")
        and each.class_name() not in _NO_LIGHT_NEEDED
        and len(with_nested(each)) == 1
    ]
    remarks = []
    blind = [each for each in tracers if not _sees_media(each)]
    if blind and (sensor.get_medium() is not None or _has_media(scene.shapes())):
        remarks.append(
            f'the scene has participating media, and "{name}" treats them as absent: use "volpath"'
        )
    if tracers and not scene.emitters():
        remarks.append("the scene has no light: the image is black")
    return remarks


def _sees_media(integrator: mi.Integrator) -> bool:
    return "Vol" in integrator.class_name() or "vol" in type(integrator).__module__


def _has_media(shapes: Iterable[mi.Shape]) -> bool:
    return any(
        shape.is_medium_transition() or _has_media(getattr(shape, "children", ()))
        for shape in shapes
    )
