"""Checks lists of arbitrary output variables before Mitsuba's ``aov`` reads them: an item without a
type makes Mitsuba 3.9.1 crash (a segmentation fault)."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi

#: The types that ``aov`` of Mitsuba 3.9.1 accepts.
AOV_TYPES = (
    "albedo", "depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv", "duv_dx",
    "duv_dy", "prim_index", "shape_index",
)  # fmt: skip


def check_aovs(plugin: str, aovs: str) -> None:
    """Checks a list of output variables, ``name:type,name:type``.

    Args:
        plugin: The plugin that has the parameter ``aovs``.
        aovs: The list.

    Raises:
        ValueError: An item does not have this form, or its type is unknown.
    """
    for item in filter(None, re.split("[, ]", aovs)):  # as Mitsuba splits it
        name, _colon, kind = item.partition(":")
        if not name or kind not in AOV_TYPES:
            raise ValueError(
                f'"{plugin}": the parameter "aovs" must be a list of name:type, such as '
                f'"d:depth,n:sh_normal", and not "{item}"; the types are {", ".join(AOV_TYPES)}'
            )


def check_nodes(state: mi.parser.ParserState) -> None:
    """Checks the lists of every ``aov`` of Mitsuba in a parsed scene or integrator.

    Raises:
        ValueError: A list is not well-formed.
    """
    for node in state.nodes:
        if node.props.plugin_name() == "aov" and isinstance(node.props.get("aovs"), str):
            check_aovs("aov", node.props["aovs"])
