"""Scenes and integrators as a command line or a notebook names them.

Mitsuba's ``load_file`` cannot change the size of a film, tell which files a scene is made of, or
say how deep its integrator traces. :func:`load_scene` goes through ``mi.parser`` for these, and
turns everything that can be wrong with a scene into an :class:`InputError` of one line.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Union

if TYPE_CHECKING:
    import mitsuba as mi

Value = Union[bool, int, float, str]

#: What a comparison has to keep equal: how long paths may be, and when roulette may end them.
DEPTH_PARAMETERS = ("max_depth", "rr_depth")

#: How Mitsuba's integrators print a depth without limit.
_UNLIMITED = 2**32 - 1


class InputError(ValueError):
    """Something that the user gave cannot be used. The message is one line: what, and where."""


def one_line(error: BaseException | str) -> str:
    """A Mitsuba message without its source positions ("[parser.cpp:12] ", "[PLYMesh] ") and line
    breaks."""
    text = re.sub(r"\[\w+(?:\.(?:cpp|h):\d+)?\] ", "", str(error))
    # "Found 1 unreferenced property in …:\n  - float "radiusx": 3"
    return re.sub(r"\s*\n\s*(?:- )?", " ", text).strip() or type(error).__name__


@dataclass
class LoadedScene:
    """A scene, and what its file says about it.

    Attributes:
        scene: The ``mi.Scene``.
        path: The XML file.
        parameters: The ``$name`` parameters that were passed to it.
        content_hash: SHA-256 over the XML, its parameters, and all files that it names.
        depth: ``max_depth`` and ``rr_depth`` of the scene's own integrator, as far as it has them.
        integrator_name: Plugin name of the scene's own integrator; empty if there is none.
        size: Width and height of the image in pixels (of the crop window, if there is one).
    """

    scene: mi.Scene
    path: Path
    parameters: dict[str, str]
    content_hash: str
    depth: dict[str, int]
    integrator_name: str
    size: tuple[int, int]


def load_scene(
    path: str | Path,
    size: tuple[int, int] | None = None,
    parameters: Mapping[str, object] | None = None,
    keep_integrator: bool = True,
) -> LoadedScene:
    """Loads a scene in the active variant.

    Args:
        path: The XML file.
        size: Width and height that replace those of the film.
        parameters: Values for the ``$name`` placeholders of the file.
        keep_integrator: ``False`` leaves the scene's integrator out, so that a scene whose
            integrator is unknown here can be rendered with another.

    Raises:
        InputError: The file is missing or broken, something in it cannot be made, it has no
            sensor, or ``size`` was given for a film with a crop window.
    """
    import mitsuba as mi

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such scene'}")
    strings = {key: _as_xml(value) for key, value in (parameters or {}).items()}
    config = mi.parser.ParserConfig(mi.variant())
    with _search_path(path.resolve().parent):
        try:
            state = mi.parser.parse_file(config, str(path), **strings)
            content_hash = _content_hash(state, strings)
            integrator = _integrator_node(state)
            # Now: a node must not be touched after a transformation (it may be freed memory)
            integrator_name = integrator.props.plugin_name() if integrator else ""
            depth = _depth(integrator)
            if not keep_integrator:
                _drop_integrators(state)
            if size is not None:
                _set_film_size(state, size)
            mi.parser.transform_all(config, state)
            scene = mi.parser.instantiate(config, state)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except Exception as error:  # a plugin's constructor may raise anything
            message = one_line(error)
            raise InputError(message if str(path) in message else f"{path}: {message}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"{path}: the outermost element must be a <scene>")
    if not scene.sensors():
        raise InputError(f"{path}: the scene has no sensor")
    film = scene.sensors()[0].film()
    if size is not None and tuple(film.size()) != size:
        # A sensor without a <film> element got Mitsuba's default one
        _resize_default_film(scene, size)
    return LoadedScene(
        scene=scene,
        path=path,
        parameters=strings,
        content_hash=content_hash,
        depth=depth,
        integrator_name=integrator_name,
        size=(int(film.crop_size()[0]), int(film.crop_size()[1])),
    )


def parse_integrator(text: str) -> tuple[str, dict[str, Value]]:
    """Splits ``name:key=value,key=value`` into the name and its parameters.

    >>> parse_integrator("neepp:max_depth=6,threshold=0.1,hide_emitters=true")
    ('neepp', {'max_depth': 6, 'threshold': 0.1, 'hide_emitters': True})
    """
    name, colon, rest = text.partition(":")
    if not re.fullmatch(r"\w+", name) or (colon and not rest):
        raise InputError(f'integrator "{text}": expected NAME or NAME:key=value,key=value')
    parameters: dict[str, Value] = {}
    for item in rest.split(",") if rest else []:
        key, equals, value = item.partition("=")
        if not (re.fullmatch(r"\w+", key) and equals and value):
            raise InputError(f'integrator "{text}": expected key=value, found "{item}"')
        if key in parameters:
            raise InputError(f'integrator "{text}": "{key}" is given twice')
        parameters[key] = _parse_value(value)
    return name, parameters


def make_integrator(
    name: str,
    parameters: Mapping[str, Value] | None = None,
    inherited: Mapping[str, Value] | None = None,
) -> tuple[mi.Integrator, dict[str, Value]]:
    """Makes an integrator in the active variant.

    Args:
        name: The plugin's name.
        parameters: Its parameters; it is an error if the plugin does not know one of them.
        inherited: Parameters that apply where ``parameters`` does not set them and the plugin
            knows them (a :attr:`LoadedScene.depth`).

    Returns:
        The integrator, and the parameters that it was made with.

    Raises:
        InputError: There is no such plugin, it is no integrator, or it rejects a parameter.
    """
    import mitsuba as mi

    own = dict(parameters or {})
    merged = {**(inherited or {}), **own}
    properties = mi.Properties(name)
    for key, value in merged.items():
        properties[key] = value
    try:
        integrator = mi.PluginManager.instance().create_object(properties)
    except Exception as error:  # a plugin's constructor may raise anything
        if "not found!" in str(error) and f'Plugin "{name}"' in str(error):
            message = f'unknown integrator "{name}"'
            raise InputError(f"{message} ('mitsuba-ext list' shows ours)") from error
        raise InputError(f'integrator "{name}": {one_line(error)}') from error
    if not isinstance(integrator, mi.Integrator):
        raise InputError(f'"{name}" is a plugin of Mitsuba, but not an integrator')
    unknown = set(properties.unqueried())
    for key in own:
        if key in unknown:
            raise InputError(f'integrator "{name}" has no parameter "{key}"')
    return integrator, {key: value for key, value in merged.items() if key not in unknown}


def _parse_value(text: str) -> Value:
    if text in ("true", "false"):
        return text == "true"
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass
    return text


def _as_xml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@contextlib.contextmanager
def _search_path(folder: Path) -> Iterator[None]:
    """Makes Mitsuba look for meshes and textures in ``folder``: unlike ``mi.load_file``, the
    functions of ``mi.parser`` leave the search path alone."""
    import mitsuba as mi

    resolver = mi.file_resolver()
    resolver.prepend(str(folder))
    try:
        yield
    finally:
        del resolver[0]


def _content_hash(state: mi.parser.ParserState, parameters: Mapping[str, str]) -> str:
    """Identifies the scene by the bytes of its XML files and of all files that they name."""
    import mitsuba as mi

    files = {Path(str(file)).resolve() for file in state.files}
    for node in state.nodes:
        properties = node.props
        for key in properties.keys():
            if properties.type(key) == mi.Properties.Type.String and properties[key]:
                file = Path(str(mi.file_resolver().resolve(properties[key])))
                if file.is_file():
                    files.add(file.resolve())
    digest = hashlib.sha256(repr(sorted(parameters.items())).encode())
    for file in sorted(files):
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _integrator_node(state: mi.parser.ParserState) -> mi.parser.SceneNode | None:
    """The integrator of the scene that traces the paths: inside a wrapper such as ``aov``, the
    first one that says how deep."""
    import mitsuba as mi

    nodes = [node for node in state.nodes if node.type == mi.ObjectType.Integrator]
    with_depth = [node for node in nodes if DEPTH_PARAMETERS[0] in node.props]
    return (with_depth or nodes or [None])[0]


def _depth(node: mi.parser.SceneNode | None) -> dict[str, int]:
    """``max_depth`` and ``rr_depth`` of an integrator: what the file sets, else its defaults,
    which are only known from how it prints itself."""
    import mitsuba as mi

    if node is None:
        return {}
    text = ""
    with contextlib.suppress(Exception):  # a wrapper or an unknown plugin: no defaults to know
        properties = mi.Properties(node.props.plugin_name())
        text = str(mi.PluginManager.instance().create_object(properties))
    depth = {}
    for key in DEPTH_PARAMETERS:
        printed = re.search(rf"\b{key} = (-?\d+)", text)
        if key in node.props:
            depth[key] = int(node.props[key])
        elif printed:
            value = int(printed.group(1))
            depth[key] = -1 if value == _UNLIMITED else value
    return depth


def _drop_integrators(state: mi.parser.ParserState) -> None:
    import mitsuba as mi

    properties = state.root.props
    for key in list(properties.keys()):
        value = properties[key]
        if isinstance(value, mi.Properties.ResolvedReference):
            if state.nodes[value.index()].type == mi.ObjectType.Integrator:
                del properties[key]


def _set_film_size(state: mi.parser.ParserState, size: tuple[int, int]) -> None:
    import mitsuba as mi

    for node in state.nodes:
        if node.type == mi.ObjectType.Film:
            if any(key.startswith("crop_") for key in node.props.keys()):
                raise InputError(
                    f"a size cannot be given for a film with a crop window "
                    f"({mi.parser.file_location(state, node)})"
                )
            node.props["width"], node.props["height"] = size


def _resize_default_film(scene: mi.Scene, size: tuple[int, int]) -> None:
    import mitsuba as mi

    parameters = mi.traverse(scene.sensors()[0])
    parameters["film.size"] = list(size)
    parameters.update()
