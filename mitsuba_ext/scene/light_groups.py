"""Light groups: names under which the lights of a scene are rendered to channels of their own.

A light belongs to the group that the string ``light_group`` names, on the emitter or its shape.
Mitsuba refuses strings that no plugin reads: our loader (the command line, and
:func:`mitsuba_ext.compare.load_scene`) moves them into the id of the emitter. Without it, ids are
the names of groups, up to the first dot: the lights ``key.001`` and ``key.002`` are in the group
``key``. The id of a light with a surface is the id of its shape.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi

#: The property in a scene.
KEY = "light_group"

#: How the id of an emitter begins that is in a group. A colon and a number follow the name.
_PREFIX = f"{KEY}:"

#: The group of lights that have neither a group nor an id.
UNNAMED = "unnamed"


def light_name(emitter: mi.Emitter) -> str:
    """The id of a light; empty if it has none."""
    shape = emitter.get_shape()
    if shape is not None:
        return shape.id()
    return "" if emitter.id().startswith(_PREFIX) else emitter.id()


def light_group(emitter: mi.Emitter) -> str:
    """The group of a light."""
    if emitter.id().startswith(_PREFIX):
        return emitter.id()[len(_PREFIX) :].rpartition(":")[0]
    return light_name(emitter).partition(".")[0] or UNNAMED


def light_groups(scene: mi.Scene) -> list[str]:
    """The groups of a scene, in alphabetical order."""
    return sorted({light_group(emitter) for emitter in scene.emitters()})


def group_nodes(state: mi.parser.ParserState) -> None:
    """Moves the groups in a parsed scene to where Mitsuba accepts them.

    Raises:
        ValueError: A group is not on a light, or not a name.
    """
    import mitsuba as mi

    for number, node in enumerate(state.nodes):
        if KEY not in node.props:
            continue
        group = mi.Properties(node.props)[KEY]
        if not isinstance(group, str) or not group or set(group) & set("'.:,<> "):
            raise ValueError(
                f'the parameter "{KEY}" is {group!r}; it must be a name without quotes, points, '
                f"colons, commas, angle brackets and spaces"
            )
        lights = [node]
        if node.type != mi.ObjectType.Emitter:
            children = [
                state.nodes[value.index()]
                for value in (node.props[key] for key in list(node.props.keys()) if key != KEY)
                if isinstance(value, mi.Properties.ResolvedReference)
            ]
            lights = [child for child in children if child.type == mi.ObjectType.Emitter]
        if not lights:
            raise ValueError(
                f'"{node.props.plugin_name()}": the parameter "{KEY}" is "{group}", but it is for '
                f"emitters, and for shapes that have one"
            )
        del node.props[KEY]
        for light in lights:
            light.props.set_id(f"{_PREFIX}{group}:{number}")
