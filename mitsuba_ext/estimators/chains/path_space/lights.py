"""The kinds of lights at which paths end."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....util.arrays import from_numpy
from ...light_paths.emission import LightEmission

#: Bits of the table.
_POINT, _FIXED_DIRECTION, _INFINITE, _SURFACE = 1, 2, 4, 8


class LightKinds:
    """The kind of each light of a scene. The attribute is a Python Boolean, so that kernels can
    omit code for lights that do not occur.

    Parameters:
        scene: A scene with lights.

    Attributes:
        has_unhittable: Whether there is a light that no ray can hit.
    """

    def __init__(self, scene: mi.Scene) -> None:
        kinds = [_kind(emitter) for emitter in scene.emitters()]
        self._kinds = from_numpy(mi.UInt32, kinds)
        self._emitters = scene.emitters_dr()
        any_kind = int(np.bitwise_or.reduce(kinds))
        self.has_unhittable = bool(any_kind & (_POINT | _FIXED_DIRECTION))

    def emitter(self, index: mi.UInt32, active: mi.Bool) -> mi.EmitterPtr:
        return dr.gather(mi.EmitterPtr, self._emitters, index, active)

    def is_unhittable(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether no ray can hit the light: a point, or a light that shines in one direction."""
        return self._has(_POINT | _FIXED_DIRECTION, index, active)

    def is_infinite(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        return self._has(_INFINITE, index, active)

    def is_point(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        return self._has(_POINT, index, active)

    def is_beam(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether the light is a surface that shines in one direction."""
        mark = dr.gather(mi.UInt32, self._kinds, index, active)
        return (mark & (_SURFACE | _FIXED_DIRECTION)) == _SURFACE | _FIXED_DIRECTION

    def _has(self, bits: int, index, active) -> mi.Bool:
        return (dr.gather(mi.UInt32, self._kinds, index, active) & bits) != 0


def _kind(emitter: mi.Emitter) -> int:
    flags = int(emitter.flags())
    kind = 0
    for bit, flag in (
        (_POINT, mi.EmitterFlags.DeltaPosition),
        (_FIXED_DIRECTION, mi.EmitterFlags.DeltaDirection),
        (_INFINITE, mi.EmitterFlags.Infinite),
        (_SURFACE, mi.EmitterFlags.Surface),
    ):
        kind |= bit if flags & int(flag) else 0
    return kind


def light_start_densities(
    kinds: LightKinds,
    emission: LightEmission,
    scene: mi.Scene,
    index: mi.UInt32,
    d: mi.Vector3f,
    n: mi.Normal3f,
    ref: mi.Interaction3f,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float]:
    """The densities with which light paths begin with the last segment of a path.

    Parameters:
        d: The direction of emission.
        n: The normal of the light.
        ref: The vertex before the light.

    Returns:
        The density of the last vertex (see :class:`Logs`), and the factor that emission contributes
        to the density of the previous vertex: the density of the direction or, for lights at
        infinity and beams, the density of the position.
    """
    emitter = kinds.emitter(index, active)
    position, direction = emission.densities(
        scene, emitter, d, n, ref, active, knows_normal=True
    )
    chance = emission.chance(index, active)
    # For beams and lights at infinity, the direction's density is the last vertex's density
    by_direction = kinds.is_infinite(index, active) | kinds.is_beam(index, active)
    return (
        dr.select(by_direction, chance * direction, position),
        dr.select(by_direction, position / chance, direction),
    )
