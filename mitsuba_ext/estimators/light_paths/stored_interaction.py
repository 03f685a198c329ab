"""How an interaction with a surface is stored in words.

Computing a surface interaction again takes longer than reading a few more words: in kitchen, a
tenth of the time of a bidirectional sample. Fields that only some BSDFs read are stored only if the
scene may contain such BSDFs.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...scene.movers import movers
from ...util.octahedral import from_octahedral, octahedral

#: BSDFs that read no more of the interaction than ``wi`` and ``uv``. BSDFs and textures nested in
#: them may read more.
_PLAIN_BSDFS = frozenset({
    "SmoothDiffuse", "SmoothDielectric", "ThinDielectric", "RoughDielectric", "SmoothConductor",
    "RoughConductor", "SmoothPlastic", "RoughPlastic", "PolarizedPlastic", "Principled",
    "PrincipledThin", "TwoSidedBRDF", "MaskBSDF", "BlendBSDF", "Null",
})  # fmt: skip

#: Textures that read no more of the interaction than ``uv``: the beginnings of their class names.
_PLAIN_TEXTURES = (
    "Bitmap", "Checkerboard", "UniformSpectrum", "SRGBReflectanceSpectrum", "RegularSpectrum",
    "IrregularSpectrum",
)  # fmt: skip

#: Words of the fields that all BSDFs read, and of the fields that only some BSDFs read; and which
#: word holds the shape: 0 for an interaction in a medium.
_WORDS, _MORE_WORDS, SHAPE_WORD = 15, 14, 14


def needs_whole_interaction(scene: mi.Scene) -> bool:
    """Whether a BSDF of the scene may read more than ``wi`` and ``uv``. Bump and normal maps do;
    BSDFs written in Python may. The BSDFs of instanced shapes cannot be inspected, so they are
    assumed to do so."""
    shapes = scene.shapes()
    if movers(scene) or any(shape.class_name() == "Instance" for shape in shapes):
        return True
    return not all(_is_plain(bsdf) for bsdf in {shape.bsdf() for shape in shapes} - {None})


def interaction_words(is_whole: bool) -> int:
    """Number of words of an interaction."""
    return _WORDS + _MORE_WORDS * is_whole


def to_words(si: mi.SurfaceInteraction3f, is_whole: bool) -> list[mi.Float]:
    """The words of an interaction, without its time and wavelengths. In a medium, the words of the
    normal are not finite: there is none."""
    frame = si.sh_frame
    words = [*si.p, *si.wi, *si.uv, *octahedral(si.n), *octahedral(frame.n), *octahedral(frame.s)]
    words.append(as_float(si.shape))
    if is_whole:
        words += [*si.dp_du, *si.dp_dv, *si.dn_du, *si.dn_dv]
        words += [as_float(si.prim_index), as_float(si.instance)]
    return words


def from_words(words: list[mi.Float], is_whole: bool) -> mi.SurfaceInteraction3f:
    """The inverse of :func:`to_words`."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(words[0]))
    si.p, si.wi = mi.Point3f(*words[0:3]), mi.Vector3f(*words[3:6])
    si.uv, si.n = mi.Point2f(*words[6:8]), mi.Normal3f(from_octahedral(*words[8:10]))
    n, s = from_octahedral(*words[10:12]), from_octahedral(*words[12:14])
    si.sh_frame = mi.Frame3f(s, dr.cross(n, s), n)
    si.shape = as_shape(words[SHAPE_WORD])
    if is_whole:
        derivatives = (mi.Vector3f(*words[i : i + 3]) for i in range(_WORDS, _WORDS + 12, 3))
        si.dp_du, si.dp_dv, si.dn_du, si.dn_dv = derivatives
        si.prim_index = dr.reinterpret_array(mi.UInt32, words[_WORDS + 12])
        si.instance = as_shape(words[_WORDS + 13])
    return si


def as_float(value: Any) -> mi.Float:
    """The bits of an integer, or of an object's registry index, as a ``Float``."""
    if not isinstance(value, mi.UInt32):
        value = dr.reinterpret_array(mi.UInt32, value)
    return dr.reinterpret_array(mi.Float, value)


def as_shape(word: mi.Float) -> mi.ShapePtr:
    """The inverse of :func:`as_float` for shapes."""
    return dr.reinterpret_array(mi.ShapePtr, dr.reinterpret_array(mi.UInt32, word))


def _is_plain(bsdf: mi.BSDF) -> bool:
    if bsdf.class_name() not in _PLAIN_BSDFS:
        return False

    # Defined here, since the base class only exists once a variant is selected
    class Nested(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.is_plain = True

        def put(self, _name: str, value: object, _flags: int, *_more: object) -> None:
            if isinstance(value, mi.BSDF):
                self.is_plain &= _is_plain(value)
            elif isinstance(value, mi.Texture):
                self.is_plain &= value.class_name().startswith(_PLAIN_TEXTURES)

    nested = Nested()
    bsdf.traverse(nested)
    return nested.is_plain
