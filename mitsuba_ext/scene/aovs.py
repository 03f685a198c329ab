"""Lists of arbitrary output variables: the types of Mitsuba's ``aov``, light path expressions,
light groups, and masks. Lists are checked before Mitsuba reads them: an item without a type makes
Mitsuba 3.9.1 crash (a segmentation fault)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..util.errors import did_you_mean
from .expressions.notation import Expression

if TYPE_CHECKING:
    import mitsuba as mi

#: The types that ``aov`` of Mitsuba 3.9.1 accepts.
AOV_TYPES = (
    "albedo", "depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv", "duv_dx",
    "duv_dy", "prim_index", "shape_index",
)  # fmt: skip

#: The named passes, and the expressions for which they stand. The parts of the first event add up
#: to the image (``emission``, ``diffuse``, ``glossy``, ``transmission``, ``volume``), and so do
#: ``emission``, ``direct`` and ``indirect``.
PASSES = {
    "emission": "CL",
    "direct": "C.L",
    "indirect": "C..+L",
    "diffuse": "C<RD>.*L",
    "glossy": "C<R[GS]>.*L",
    "transmission": "C<T.>.*L",
    "volume": "CV.*L",
    "caustics": "C.*D[GS]+L",
}

#: The type that stands for a channel for each light group.
LIGHT_GROUPS = "light_groups"

#: Types of masks: the number of the object or material that covers most of a pixel, and
#: Cryptomatte.
MASK_TYPES = ("object_id", "material_id", "cryptomatte_object", "cryptomatte_material")

#: The types that Mitsuba's ``aov`` does not have.
_OWN_TYPES = (*PASSES, LIGHT_GROUPS, *MASK_TYPES)


@dataclass(frozen=True)
class Aovs:
    """A list of output variables.

    Attributes:
        by_mitsuba: The items that Mitsuba's ``aov`` computes, as a list for it.
        expressions: The light path expressions, by the names of their channels.
        groups: The names of the items that stand for all light groups.
        masks: The names and types of the masks.
    """

    by_mitsuba: str = ""
    expressions: dict[str, Expression] = field(default_factory=dict)
    groups: tuple[str, ...] = ()
    masks: tuple[tuple[str, str], ...] = ()

    @property
    def numbers_shapes(self) -> bool:
        """Whether there is a ``shape_index``, the number of a shape."""
        return any(kind == "shape_index" for _name, kind in split_aovs(self.by_mitsuba))

    @classmethod
    def read(cls, plugin: str, aovs: str) -> Aovs:
        """Reads a list, ``name:type,name:type``. Commas and spaces separate the items, except
        within quotes and brackets.

        Parameters:
            plugin: The plugin that has the parameter ``aovs``.

        Raises:
            ValueError: An item does not have this form, its type is unknown, its expression has a
                syntax error, or two items have the same name.
        """
        by_mitsuba, expressions, groups, masks = [], {}, [], []
        names: set[str] = set()
        for name, kind in split_aovs(aovs):
            is_word = re.fullmatch(r"[a-z_:]*", kind) is not None
            if not name or (is_word and kind not in (*AOV_TYPES, *_OWN_TYPES)):
                raise ValueError(_message(plugin, name, kind, (*AOV_TYPES, *_OWN_TYPES)))
            if name in names:
                raise ValueError(f'"{plugin}": two items of "aovs" have the name "{name}"')
            names.add(name)
            if kind in AOV_TYPES:
                by_mitsuba.append(f"{name}:{kind}")
            elif kind == LIGHT_GROUPS:
                groups.append(name)
            elif kind in MASK_TYPES:
                masks.append((name, kind))
            else:
                expressions[name] = _expression(plugin, PASSES.get(kind, kind))
        return cls(",".join(by_mitsuba), expressions, tuple(groups), tuple(masks))

    def of_groups(self, groups: list[str]) -> dict[str, Expression]:
        """All expressions, including the expressions for these light groups."""
        found = dict(self.expressions)
        for name in self.groups:
            for group in groups:
                found[f"{name}.{group}"] = Expression.parse(f"C.*<L.'{group}'>")
        return found


def split_aovs(aovs: str) -> list[tuple[str, str]]:
    """The names and types of a list of output variables."""
    return [(name, kind) for name, _, kind in (item.partition(":") for item in _items(aovs))]


def _items(aovs: str) -> list[str]:
    """The items of a list."""
    items, item, depth, quoted = [], "", 0, False
    for character in aovs:
        quoted ^= character == "'"
        if not quoted:
            depth += (character in "<[({") - (character in ">])}")
        if character in ", \n\t" and depth <= 0 and not quoted:
            items.append(item)
            item = ""
        else:
            item += character
    return [item for item in (*items, item) if item]


def _expression(plugin: str, text: str) -> Expression:
    from .expressions.alphabet import can_be_met

    try:
        expression = Expression.parse(text)
        is_possible = can_be_met(expression)
    except ValueError as error:
        raise ValueError(f'"{plugin}": the parameter "aovs": {error}') from None
    if not is_possible:
        raise ValueError(
            f'"{plugin}": the parameter "aovs": no path belongs to the expression "{text}": a path '
            f"begins with C (the camera) and ends with L (a light), as in C<RD>.*L"
        )
    return expression


def check_aovs(plugin: str, aovs: str) -> None:
    """Checks a list of output variables for Mitsuba's ``aov``, ``name:type,name:type``.

    Args:
        plugin: The plugin that has the parameter ``aovs``.
        aovs: The list.

    Raises:
        ValueError: An item does not have this form, or its type is unknown.
    """
    for name, kind in split_aovs(aovs):
        if not name or kind not in AOV_TYPES:
            raise ValueError(_message(plugin, name, kind, AOV_TYPES))


def _message(plugin: str, name: str, kind: str, types: tuple[str, ...]) -> str:
    if name and kind in _OWN_TYPES:
        hint = f' ("{kind}" is a type of the parameter "aovs" of our integrators)'
    else:
        hint = did_you_mean(kind, types)
    return (
        f'"{plugin}": the parameter "aovs" must be a list of name:type, such as '
        f'"d:depth,n:sh_normal", and not "{name}{":" * bool(kind)}{kind}"; the types are '
        f'{", ".join(types)}{hint}'
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
