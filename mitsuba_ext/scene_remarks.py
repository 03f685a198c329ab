"""What an integrator passes over in a scene without a word."""

from __future__ import annotations

from collections.abc import Iterable

import mitsuba as mi

from .nesting import with_nested

#: Integrators that need no light and have nothing to do with media: two look at surfaces only, one
#: renders primitives that emit.
_NO_LIGHT_NEEDED = {
    "AOVIntegrator", "DepthIntegrator", "BasicVolumetricPrimitiveRadianceFieldIntegrator",
}  # fmt: skip

#: "volpath", "volpathmis" and "prbvolpath".
_SEES_MEDIA = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator"}


def scene_remarks(
    scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator, name: str
) -> list[str]:
    """Sentences about media that ``integrator``, to be called ``name``, does not see, and about
    missing lights. Nothing is said about integrators that are neither Mitsuba's nor ours."""
    tracers = [
        each
        for each in with_nested(integrator)
        if type(each).__module__.split(".")[0] in ("mitsuba", "mitsuba_ext")
        and not _is_one_of(each, _NO_LIGHT_NEEDED)
        and len(with_nested(each)) == 1
    ]
    remarks = []
    blind = [each for each in tracers if not _is_one_of(each, _SEES_MEDIA)]
    if blind and (sensor.get_medium() is not None or _has_media(scene.shapes())):
        remarks.append(
            f'the scene has participating media, and "{name}" treats them as absent: use "volpath"'
        )
    if tracers and not scene.emitters():
        remarks.append("the scene has no light: the image is black")
    return remarks


def _is_one_of(integrator: mi.Integrator, classes: set[str]) -> bool:
    # Classes in Python are called by their name there, those in C++ by Mitsuba's
    return not classes.isdisjoint([integrator.class_name(), type(integrator).__name__])


def _has_media(shapes: Iterable[mi.Shape]) -> bool:
    return any(
        shape.is_medium_transition() or _has_media(getattr(shape, "children", ()))
        for shape in shapes
    )
