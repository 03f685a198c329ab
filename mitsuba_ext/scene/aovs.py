"""Reads lists of arbitrary output variables, ``name:type,name:type``, and checks them before
Mitsuba's ``aov`` reads them: an item without a type makes Mitsuba 3.9.1 crash (a segmentation
fault)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi

#: The types that ``aov`` of Mitsuba 3.9.1 accepts.
AOV_TYPES = (
    "albedo", "depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv", "duv_dx",
    "duv_dy", "prim_index", "shape_index",
)  # fmt: skip


#: Types of masks: the number of the object or material that covers most of a pixel, and
#: Cryptomatte. They are computed by our integrators only.
MASK_TYPES = ("object_id", "material_id", "cryptomatte_object", "cryptomatte_material")


def split_aovs(aovs: str) -> list[tuple[str, str]]:
    """The names and types of a list of output variables."""
    items = filter(None, re.split("[, ]", aovs))  # as Mitsuba splits it
    return [(name, kind) for name, _colon, kind in (item.partition(":") for item in items)]


def check_aovs(plugin: str, aovs: str, types: Sequence[str] = AOV_TYPES) -> None:
    """Checks a list of output variables.

    Args:
        plugin: The plugin that has the parameter ``aovs``.
        aovs: The list.
        types: The types that the plugin accepts.

    Raises:
        ValueError: An item does not have the form ``name:type``, its type is unknown, or two masks
            have the same name.
    """
    items = split_aovs(aovs)
    for name, kind in items:
        if name and kind in types:
            continue
        hint = ""
        if name and kind in MASK_TYPES:
            hint = f' ("{kind}" is a type of the parameter "aovs" of our integrators)'
        raise ValueError(
            f'"{plugin}": the parameter "aovs" must be a list of name:type, such as '
            f'"d:depth,n:sh_normal", and not "{name}{":" * bool(kind)}{kind}"; the types are '
            f"{', '.join(types)}{hint}"
        )
    masks = [name for name, kind in items if kind in MASK_TYPES]
    for name in masks:
        if [other for other, _kind in items].count(name) > 1:
            raise ValueError(
                f'"{plugin}": the parameter "aovs" has the name "{name}" twice: give each mask '
                f"a name of its own"
            )


def has_masks(state: mi.parser.ParserState) -> bool:
    """Whether an integrator of a parsed scene has masks."""
    texts = [node.props.get("aovs", "") for node in state.nodes]
    return any(
        kind in MASK_TYPES
        for text in texts
        if isinstance(text, str)
        for _name, kind in split_aovs(text)
    )


def check_nodes(state: mi.parser.ParserState) -> None:
    """Checks the lists of every ``aov`` of Mitsuba in a parsed scene or integrator.

    Raises:
        ValueError: A list is not well-formed.
    """
    for node in state.nodes:
        if node.props.plugin_name() == "aov" and isinstance(node.props.get("aovs"), str):
            check_aovs("aov", node.props["aovs"])
