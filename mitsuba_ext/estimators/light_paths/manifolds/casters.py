"""The surfaces that cast caustics: smooth glass and smooth metal."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....scene.bsdfs import bsdf_table, is_in_table
from ....util.arrays import from_numpy

import numpy as np

#: The BSDFs whose directions follow from the shading normal alone.
_SMOOTH = ("SmoothConductor", "SmoothDielectric")
#: What may contain them, and changes the normal or leaves light through.
_OTHERS = ("BumpMap", "NormalMap", "MaskBSDF", "BlendBSDF")


def caster_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes that cast caustics."""
    return [shape for shape in scene.shapes() if _is_caster(shape.bsdf())]


def _is_caster(bsdf: mi.BSDF | None) -> bool:
    if bsdf is None:
        return False
    if bsdf.class_name() == "TwoSidedBRDF":
        smooth = int(mi.BSDFFlags.Smooth)
        return not int(bsdf.flags()) & smooth and not _contains(bsdf, _OTHERS)
    return bsdf.class_name() in _SMOOTH


from ....scene.bsdfs import _contains  # noqa: E402
