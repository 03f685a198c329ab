"""Checks a parsed scene for mistakes that Mitsuba reports wrongly or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..util.errors import InputError

if TYPE_CHECKING:
    import mitsuba as mi

#: The emitters that must be nested in shapes.
_IN_SHAPES = ("area", "directionalarea", "solid_angle_area", "goniometric_area")


def check_parsed(state: mi.parser.ParserState) -> None:
    """
    Args:
        state: The parsed scene, before any transformation.

    Raises:
        InputError: A film has no pixels (Mitsuba's sensors blame their field of view), or a light
            that needs a shape has none (Mitsuba's own lights are then missing from the image).
    """
    import mitsuba as mi

    for node in state.nodes:
        own = mi.Properties(node.props)  # a copy: reading a property marks it as queried
        for key in ("width", "height") if node.type == mi.ObjectType.Film else ():
            if key in own and own[key] == 0:
                raise InputError(f"the film has the {key} 0{_place(state, node)}")
    for key in state.root.props.keys():
        value = state.root.props[key]
        if isinstance(value, mi.Properties.ResolvedReference):
            node = state.nodes[value.index()]
            name = node.props.plugin_name()
            if name in _IN_SHAPES:
                raise InputError(
                    f'the emitter "{name}" is in no shape, and gives no light: put it in one'
                    f"{_place(state, node)}"
                )


def _place(state: mi.parser.ParserState, node: mi.parser.SceneNode) -> str:
    import mitsuba as mi

    return f" ({mi.parser.file_location(state, node)})"
