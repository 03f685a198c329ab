"""Changes that the command line makes to the film and the integrator of a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ..util.errors import InputError, one_line
from .plugin_text import parse_plugin

if TYPE_CHECKING:
    import mitsuba as mi

#: The reconstruction filters of Mitsuba.
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")


class SceneChanges(NamedTuple):
    """Changes to a scene other than the size of its film.

    Attributes:
        crop: The crop window in pixels, which replaces the film's: width, height, and the position
            (x, y) of its upper left corner.
        rfilter: The reconstruction filter, as text for :func:`.plugin_text.parse_plugin`. Empty for
            the film's own.
        max_depth: The maximum depth, which replaces the value of the scene's integrator.
    """

    crop: tuple[int, int, int, int] | None = None
    rfilter: str = ""
    max_depth: int | None = None

    def described(self) -> dict[str, str]:
        """The changes, by name."""
        found = {"reconstruction filter": self.rfilter}
        if self.crop is not None:
            found["crop window"] = "{}x{}+{}+{}".format(*self.crop)
        if self.max_depth is not None:
            found["maximum depth"] = str(self.max_depth)
        return {name: value for name, value in found.items() if value}


#: The width and height of a film for which a scene gives none.
_DEFAULT_SIZE = 768, 576

#: Leaves a scene as it is.
UNCHANGED = SceneChanges()


def change_films(
    state: mi.parser.ParserState, size: tuple[int, int] | None, changes: SceneChanges
) -> None:
    """Changes all films of a parsed scene. A sensor without a film gets one.

    Raises:
        InputError: ``size`` is given, and a film has a crop window; the new crop window does not
            fit into a film; or the filter does not exist.
    """
    import mitsuba as mi

    parameters: dict[str, object] = {}
    if size is not None:
        parameters["width"], parameters["height"] = size
    if changes.crop is not None:
        names = ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
        parameters.update(zip(names, changes.crop))
    if changes.rfilter:
        parameters["rfilter"] = _filter(changes.rfilter)
    if not parameters:
        return
    for node in state.nodes:
        if node.type == mi.ObjectType.Film:
            has_window = any(key.startswith("crop_") for key in node.props.keys())
            if size is not None and has_window and changes.crop is None:
                raise InputError(
                    f"a size cannot be given for a film with a crop window, unless --crop gives "
                    f"another one ({mi.parser.file_location(state, node)})"
                )
            if changes.crop is not None:
                _check_crop(changes.crop, size or _size(node))
            if changes.rfilter:
                for key, _child in _children(state, node, mi.ObjectType.ReconstructionFilter):
                    del node.props[key]
            for key, value in parameters.items():
                node.props[key] = value
        elif node.type == mi.ObjectType.Sensor and not (
            _children(state, node, mi.ObjectType.Film)
            or _children(state, node, mi.ObjectType.Sensor)
        ):
            if changes.crop is not None:
                _check_crop(changes.crop, size or _DEFAULT_SIZE)
            node.props["film"] = mi.load_dict({"type": "hdrfilm", **parameters})


def _size(film: mi.parser.SceneNode) -> tuple[int, int]:
    """The width and height of a parsed film."""
    import mitsuba as mi

    own = mi.Properties(film.props)  # a copy: reading marks as queried
    width, height = (own.get(key, x) for key, x in zip(("width", "height"), _DEFAULT_SIZE))
    return width, height


def _check_crop(crop: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    width, height, x, y = crop
    if x + width > size[0] or y + height > size[1]:
        raise InputError(
            f"the crop window {width}x{height}+{x}+{y} does not fit into the image of "
            f"{size[0]}x{size[1]} pixels"
        )


def _children(
    state: mi.parser.ParserState, node: mi.parser.SceneNode, kind: mi.ObjectType
) -> list[tuple[str, object]]:
    """The children of a node that have the given kind, with their keys."""
    import mitsuba as mi

    properties, found = mi.Properties(node.props), []  # a copy: reading marks as queried
    for key in properties.keys():
        value = properties[key]
        if isinstance(value, mi.Properties.ResolvedReference):
            if state.nodes[value.index()].type == kind:
                found.append((key, value))
        elif isinstance(value, mi.Object) and value.type() == kind:
            found.append((key, value))
    return found


def _filter(text: str) -> mi.ReconstructionFilter:
    import mitsuba as mi

    plugin = parse_plugin(text, "reconstruction filter")
    if plugin["type"] not in FILTERS:
        raise InputError(f'unknown reconstruction filter "{text}": use {", ".join(FILTERS)}')
    try:
        return mi.load_dict(plugin)
    except Exception as error:  # a plugin's constructor may raise anything
        message = one_line(error).removeprefix('While loading dictionary node "root": ')
        raise InputError(f'reconstruction filter "{text}": {message}') from error
