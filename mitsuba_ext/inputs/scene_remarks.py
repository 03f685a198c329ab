"""Warnings about parts of a scene that an integrator ignores, and about biased images."""

from __future__ import annotations

import mitsuba as mi

from ..scene.nesting import class_name, with_nested
from .scenes import LoadedScene

#: Integrators that need no light and ignore media by design: two show properties of surfaces, and
#: one renders emissive primitives.
_NO_LIGHT_NEEDED = {
    "AOVIntegrator", "DepthIntegrator", "BasicVolumetricPrimitiveRadianceFieldIntegrator",
}  # fmt: skip

#: "volpath", "volpathmis" and "prbvolpath".
_SEES_MEDIA = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator"}


def scene_remarks(loaded: LoadedScene, integrator: mi.Integrator, name: str) -> list[str]:
    """Warns about media that ``integrator`` does not render, about a scene without lights, and
    about parameters that bias the image.

    Parameters:
        loaded: The scene.
        integrator: The integrator that renders it.
        name: The name of the integrator in the sentences.

    Returns:
        Sentences; none about integrators that are neither Mitsuba's nor ours, because they may
        render media and may need no lights.
    """
    tracers = [
        each
        for each in with_nested(integrator)
        if type(each).__module__.split(".")[0] in ("mitsuba", "mitsuba_ext")
        and class_name(each) not in _NO_LIGHT_NEEDED
        and len(with_nested(each)) == 1
    ]
    remarks = []
    if class_name(integrator) == "MomentIntegrator" and len(with_nested(integrator)) == 1:
        remarks.append(f'"{name}" nests no integrator that renders the image: it is black')
    # Our integrators render media, or refuse scenes that have them
    blind = [
        each
        for each in tracers
        if class_name(each) not in _SEES_MEDIA and not hasattr(each, "sees_media")
    ]
    if blind and loaded.has_media:
        remarks.append(
            f'the scene has participating media, and "{name}" treats them as absent: use "volpath"'
        )
    if tracers and not loaded.scene.emitters():
        remarks.append("the scene has no light: the image is black")
    biases = [bias for each in with_nested(integrator) if (bias := getattr(each, "bias", ""))]
    remarks += [f'"{name}": {bias}: the image is biased' for bias in biases]
    return remarks
