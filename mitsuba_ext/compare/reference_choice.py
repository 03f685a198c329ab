"""Chooses the integrator of a reference by the contents of the scene."""

from __future__ import annotations

from typing import NamedTuple

import mitsuba as mi

from ..inputs.scenes import LoadedScene
from ..scene.media import extinction_varies
from ..scene.movers import all_shapes
from ..scene.unseen import has_unseen_shapes
from ..startup.runtime import SUPPORTED_VARIANTS

#: Lights that no ray hits because they are points or shine in a single direction.
_UNHITTABLE = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection


class ReferenceChoice(NamedTuple):
    """The integrator of a reference.

    Attributes:
        integrator: Its name.
        remarks: Sentences on why it is not ``path``, and which light the reference lacks.
    """

    integrator: str
    remarks: tuple[str, ...] = ()


def choose_integrator(loaded: LoadedScene) -> ReferenceChoice:
    """The integrator that renders a scene's reference if the user names none: ``path``, unless it
    cannot render everything in the scene.

    ===================================  ========================================================
    light that no camera path finds      ``bdpt``, where it can render the scene
    media                                ``volpath``, or ``composed_path`` if their extinction is
                                         coloured (``volpathmis`` loses light behind roulette)
    ``moving`` or lightweight shapes     ``composed_path``, if none of the others is chosen
    ===================================  ========================================================
    """
    scene = loaded.scene
    missed = _missed_light(scene, loaded.has_media)
    if missed and _takes_light_paths(loaded):
        why = f'"bdpt" renders the reference: no camera path finds {missed}'
        if "smooth" in missed:
            other = "sppm" if loaded.has_media else "vcm"
            why += (
                "; where such light is seen in a mirror, or through glass, the reference still "
                f'lacks it ("{other}" has it, slightly blurred)'
            )
        return ReferenceChoice("bdpt", (why,))
    lacks = _lacks(missed, '"bdpt" cannot render this scene')
    if loaded.has_media:
        by_us = extinction_varies(scene) or has_unseen_shapes(scene)
        name = "composed_path" if by_us else "volpath"
        why = f'"{name}" renders the reference: the scene has participating media'
        return ReferenceChoice(name, (why, *lacks))
    if has_unseen_shapes(scene):
        why = '"composed_path" renders the reference: the scene has shapes that "path" does not see'
        return ReferenceChoice("composed_path", (why, *lacks))
    return ReferenceChoice("path", tuple(lacks))


def _lacks(missed: str, why: str) -> list[str]:
    """A remark on light missing from the reference because no camera path finds it."""
    lacks = f"the reference lacks light: no camera path finds {missed}, and {why}"
    return [lacks] if missed else []


def _missed_light(scene: mi.Scene, has_media: bool) -> str:
    """The light that no camera path finds, as the object of a sentence; empty if there is none."""
    flags = [int(emitter.flags()) for emitter in scene.emitters()]
    unhittable = [each for each in flags if each & _UNHITTABLE]
    if any(each & mi.EmitterFlags.Surface for each in unhittable):
        return 'the light of "directionalarea"'
    # Integrators for media connect to lights through index-matched surfaces
    smooth = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    smooth |= 0 if has_media else mi.BSDFFlags.Null
    bsdfs = (shape.bsdf() for shape in all_shapes(scene.shapes()))
    if unhittable and any(bsdf is not None and int(bsdf.flags()) & smooth for bsdf in bsdfs):
        return "the light of point lights or parallel light that smooth surfaces redirect"
    return ""


def _takes_light_paths(loaded: LoadedScene) -> bool:
    """Whether ``bdpt`` can render the scene and connect light paths to its sensor."""
    if mi.variant() not in SUPPORTED_VARIANTS:
        return False
    scene = loaded.scene
    return mi.load_dict({"type": "bdpt"}).connects_to(scene, scene.sensors()[0])
