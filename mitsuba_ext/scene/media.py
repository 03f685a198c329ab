"""Finds participating media in scenes, and raises errors for integrators that do not render them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import drjit as dr
import mitsuba as mi

from .movers import all_shapes, movers


def has_media(scene: mi.Scene) -> bool:
    """Does any sensor or shape of ``scene`` border on a medium? Media within instances cannot be
    found: they count for :func:`may_have_media` only."""
    return any(True for _ in _media(scene))


def may_have_media(scene: mi.Scene) -> bool:
    """Like :func:`has_media`, but also true if an instance may contain a medium."""
    if has_media(scene):
        return True
    return any(s.class_name() == "Instance" for s in all_shapes(scene.shapes())) and _any_is_alive()


def may_have_grids(scene: mi.Scene) -> bool:
    """May there be a medium in ``scene`` that is not homogeneous?"""
    is_known = all(s.class_name() != "Instance" for s in all_shapes(scene.shapes()))
    return not is_known or any(not medium.is_homogeneous() for medium in _media(scene))


def has_homogeneous_media(scene: mi.Scene) -> bool:
    """Is there a homogeneous medium in ``scene``, outside of instances?"""
    return any(medium.is_homogeneous() for medium in _media(scene))


def refuse_media(scene: mi.Scene, what: str, instead: str) -> None:
    """Raises an error if there are media in ``scene``.

    Parameters:
        what: The beginning of the message: the plugin or parameter that does not support media.
        instead: The end of the message: what to do.

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


def refuse_missing_colours(scene: mi.Scene, what: str) -> None:
    """Raises an error if a medium has no extinction in one colour: distances that are sampled with
    this colour never end in the medium.

    Parameters:
        what: The beginning of the message.

    Raises:
        NotImplementedError: A homogeneous medium has an extinction of zero in some colours only.
    """
    if not mi.is_rgb:
        return
    for medium in _media(scene):
        σ = medium.get_majorant(dr.zeros(mi.MediumInteraction3f), True).numpy()
        if medium.is_homogeneous() and σ.min() <= 0 < σ.max():
            raise NotImplementedError(
                f"{what}: a medium has no extinction in some colours: give these a small one, such "
                f'as 1e-2 of the largest, or use "volpathmis".'
            )


def _media(scene: mi.Scene) -> Iterator[mi.Medium]:
    """The media of ``scene``. Each can occur several times."""
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            yield sensor.get_medium()
    yield from _of_shapes(scene.shapes())


def _of_shapes(shapes: Iterable[mi.Shape]) -> Iterator[mi.Medium]:
    for shape in all_shapes(shapes):
        if shape.is_medium_transition():
            for medium in (shape.interior_medium(), shape.exterior_medium()):
                if medium is not None:
                    yield medium


#: How many of Dr.Jit's indices of media are examined.
_NUMBERS = 1024


def _any_is_alive() -> bool:
    """Is there any medium in memory? Dr.Jit gives media indices from 1 on. Every medium has a phase
    function, and calls with unused indices return zero."""
    number = dr.opaque(mi.UInt32, 1) + dr.arange(mi.UInt32, _NUMBERS)
    phase = dr.reinterpret_array(mi.MediumPtr, number).phase_function()
    return bool(dr.any(phase != None))  # noqa: E711
