"""Finds participating media in scenes, and raises errors for integrators that do not render them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from .bounds import scene_bounds, shape_bounds
from .movers import all_shapes, movers


def has_media(scene: mi.Scene) -> bool:
    """Whether any sensor or shape of ``scene`` borders on a medium. Media within instances cannot
    be found; only :func:`may_have_media` takes them into account."""
    return any(True for _ in scene_media(scene))


def may_have_media(scene: mi.Scene) -> bool:
    """Like :func:`has_media`, but also true if an instance may contain a medium."""
    if has_media(scene):
        return True
    return has_instances(scene) and _any_is_alive()


def has_instances(scene: mi.Scene) -> bool:
    """Whether ``scene`` has instances, whose contents are not accessible."""
    return any(shape.class_name() == "Instance" for shape in all_shapes(scene.shapes()))


def may_have_grids(scene: mi.Scene) -> bool:
    """Whether ``scene`` may have a medium that is not homogeneous."""
    return has_instances(scene) or any(not m.is_homogeneous() for m in scene_media(scene))


def has_homogeneous_media(scene: mi.Scene) -> bool:
    """Whether ``scene`` has a homogeneous medium outside instances."""
    return any(medium.is_homogeneous() for medium in scene_media(scene))


def extinction_varies(scene: mi.Scene) -> bool:
    """Whether the extinction of any medium of ``scene`` outside instances varies between colours
    (or wavelengths). Compares them at random points."""
    # By identity, along with the medium itself, so that it stays the same object
    found: dict[int, tuple[mi.Medium, mi.ScalarBoundingBox3f]] = {}
    everything = scene_bounds(scene)
    places = [(sensor.get_medium(), everything) for sensor in scene.sensors()]
    for shape in all_shapes(scene.shapes()):
        if shape.is_medium_transition():
            places.append((shape.interior_medium(), shape_bounds(shape)))
            places.append((shape.exterior_medium(), everything))
    for medium, box in places:
        if medium is not None:
            found.setdefault(id(medium), (medium, mi.ScalarBoundingBox3f()))[1].expand(box)
    return any(_extinction_varies(medium, box) for medium, box in found.values())


def may_be_chromatic(scene: mi.Scene) -> bool:
    """Like :func:`extinction_varies`, but also true where that cannot be found out: for media in
    instances, and while a user records a whole render (``dr.freeze``), when no array can be
    read."""
    if mi.is_monochromatic or not may_have_media(scene):
        return False
    if has_instances(scene) or dr.flag(dr.JitFlag.FreezingScope):
        return True
    return extinction_varies(scene)


def refuse_media(scene: mi.Scene, what: str, instead: str) -> None:
    """Raises an error if there are media in ``scene``.

    Parameters:
        what: The beginning of the message: the plugin or parameter that does not support media.
        instead: The end of the message, which says what to do.

    Raises:
        NotImplementedError: There are media in ``scene``.
    """
    if has_media(scene):
        raise NotImplementedError(
            f"{what} does not see the participating media of this scene: {instead}."
        )


def refuse_moving_grids(scene: mi.Scene, what: str) -> None:
    """Raises an error if a shape that moves encloses a medium that would not move with it.

    Parameters:
        what: The beginning of the message.

    Raises:
        NotImplementedError: A moving shape encloses a medium that is not ``homogeneous``.
    """
    if any(not medium.is_homogeneous() for medium in _of_shapes(movers(scene))):
        raise NotImplementedError(
            f"{what}: a shape that moves encloses a grid medium, which would stay where it is: "
            f'use a "homogeneous" medium.'
        )


def scene_media(scene: mi.Scene) -> Iterator[mi.Medium]:
    """The media of ``scene``, outside instances. Each can occur several times."""
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            yield sensor.get_medium()
    yield from _of_shapes(scene.shapes())


#: The number of points and wavelengths at which the extinction of a medium is examined.
_PROBES = 1024


def _extinction_varies(medium: mi.Medium, box: mi.ScalarBoundingBox3f) -> bool:
    numbers = mi.PCG32(_PROBES)
    at = dr.zeros(mi.MediumInteraction3f, _PROBES)
    share = mi.Point3f(*(numbers.next_float32() for _ in range(3)))
    at.p = mi.Point3f(box.min) + share * mi.Vector3f(box.max - box.min)
    if mi.is_spectral:
        at.wavelengths, _ = mi.sample_rgb_spectrum(mi.sample_shifted(numbers.next_float32()))
    _scattering, _absorption, extinction = medium.get_scattering_coefficients(at)
    σ = np.array(extinction)
    return bool(np.ptp(σ, axis=0).max() > 1e-4 * abs(σ).max())


def _of_shapes(shapes: Iterable[mi.Shape]) -> Iterator[mi.Medium]:
    for shape in all_shapes(shapes):
        if shape.is_medium_transition():
            for medium in (shape.interior_medium(), shape.exterior_medium()):
                if medium is not None:
                    yield medium


#: The number of Dr.Jit's indices of media that are examined.
_INDICES = 1024


def _any_is_alive() -> bool:
    """Whether any medium is in memory. Dr.Jit numbers media from 1 on. Every medium has a phase
    function, and calls with unused indices return zero."""
    number = dr.opaque(mi.UInt32, 1) + dr.arange(mi.UInt32, _INDICES)
    phase = dr.reinterpret_array(mi.MediumPtr, number).phase_function()
    return bool(dr.any(phase != None))  # noqa: E711
