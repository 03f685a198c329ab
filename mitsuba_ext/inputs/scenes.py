"""Loads scenes for the command line and for notebooks.

Mitsuba's ``load_file`` cannot change the size of a film, and returns neither the files of a scene
nor the maximum depth of its integrator. :func:`load_scene` gets these from ``mi.parser``, and turns
every error in a scene into an :class:`InputError` of one line.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..scene.aovs import check_nodes, has_masks
from ..scene.light_groups import group_nodes
from ..util.errors import InputError, did_you_mean, one_line
from ..util.files import is_utf8, printable
from .content_hash import hash_each, hash_files
from .names import explained
from .parsed_scene import check_parsed
from .scene_changes import UNCHANGED, SceneChanges, change_films
from .scene_files import files_of, named_in, parameters_of

if TYPE_CHECKING:
    import mitsuba as mi

#: The settings that all integrators of a comparison share: the maximum depth, the depth at which
#: Russian roulette begins, and whether emitters are hidden from the camera.
SETTINGS = ("max_depth", "rr_depth", "hide_emitters")

#: The number that Mitsuba's integrators print for an unlimited depth.
_UNLIMITED = 2**32 - 1


def check_source(source: object) -> None:
    """Checks that ``source`` can be a scene: a file, or a dict of the active variant.

    Raises:
        InputError: ``source`` is neither.
    """
    if isinstance(source, Mapping):
        check_variant(source)
    elif not isinstance(source, (str, Path)):
        raise InputError(
            f"a scene must be an XML file or a dict, found an object of type "
            f"{type(source).__name__}"
        )
    else:
        check_scene_file(Path(source))


def check_variant(value: object) -> None:
    """Checks that the Mitsuba objects in ``value`` (a scene's dict, or an item of one) belong to
    the active variant: Mitsuba ignores or misinterprets others. (It crashes on ``None``.)

    Raises:
        InputError: An object belongs to another variant, or is ``None``.
    """
    import mitsuba as mi

    if isinstance(value, Mapping):
        for key, item in value.items():
            if item is None:
                raise InputError(f'the parameter "{key}" has no value (None, null): leave it out')
            check_variant(item)
    elif isinstance(value, mi.Object) and value.variant_name() not in ("", mi.variant()):
        raise InputError(
            f'the object "{value.class_name()}" was made in the variant "{value.variant_name()}", '
            f'and the active one is "{mi.variant()}": make it again, or give a dict'
        )


@dataclass
class LoadedScene:
    """A scene, with data that Mitsuba's scene object does not have.

    Attributes:
        scene: The ``mi.Scene``.
        path: The XML file; ``None`` for a scene made from a dict.
        parameters: The ``$name`` parameters that were passed to it.
        files: The absolute paths of the XML file and of all files that it names.
        file_hashes: SHA-256 of each file, by its path with links resolved.
        content_hash: SHA-256 over the XML or dict, its parameters, and all these files.
        settings: ``max_depth`` and ``rr_depth`` of the scene's own integrator, if it has them, and
            ``hide_emitters`` if it is set.
        integrator_name: Plugin name of the scene's own integrator; empty if there is none.
        only_says_path: Whether the scene specifies no more about its integrator than ``path`` and
            these ``settings``. Also true if it has no integrator.
        changes: The caller's changes other than the size.
        has_media: Whether the scene has participating media. Also true if its file names one and
            the scene has instances, which may contain it.
        size: Width and height of the image in pixels (of the crop window, if there is one).
    """

    scene: mi.Scene
    path: Path | None
    parameters: dict[str, str]
    files: list[Path]
    file_hashes: dict[Path, str]
    content_hash: str
    settings: dict[str, int | bool]
    integrator_name: str
    only_says_path: bool
    changes: SceneChanges
    has_media: bool
    size: tuple[int, int]

    @property
    def source(self) -> str:
        """The name of the scene in messages."""
        return "the scene" if self.path is None else str(self.path)


def scene_name(source: str | Path | Mapping[str, Any] | None) -> str:
    """A short name, taken from the file. A file ``scene.xml`` gets the name of its folder if the
    path includes it: ``kitchen/scene.xml`` is "kitchen", and ``scene.xml`` is "scene"."""
    if source is None or isinstance(source, Mapping):
        return "scene"
    path = Path(source)
    folder = path.parent.name if path.stem == "scene" else ""
    return path.stem if folder in ("", "..") else folder


def check_scene_file(path: Path) -> None:
    """Raises :class:`InputError` if the file does not exist; does not import Mitsuba."""
    name = str(path.resolve())
    if not is_utf8(name):
        raise InputError(
            f"{printable(name)}: the name of the file, or of a folder, is not UTF-8, which Mitsuba "
            f"needs: rename it"
        )
    if not path.is_file():
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such scene'}")


def load_scene(
    source: str | Path | Mapping[str, Any],
    size: tuple[int, int] | None = None,
    parameters: Mapping[str, object] | None = None,
    keep_integrator: bool = True,
    keep_names: bool = False,
    moved: Callable[[str], str] | None = None,
    changes: SceneChanges = UNCHANGED,
) -> LoadedScene:
    """Loads a scene in the active variant.

    Args:
        source: The XML file, or a dict as for ``mi.load_dict``.
        size: Width and height that replace the film's.
        parameters: Values for the ``$name`` placeholders of the file.
        keep_integrator: ``False`` drops the scene's integrator, so that a scene whose integrator is
            not installed can be rendered with another one.
        keep_names: Whether to keep the file's objects for ``mi.traverse``. By default, Mitsuba
            merges meshes of the same material, and equal materials, except where the scene's
            integrator has masks.
        moved: A function that maps the old absolute path of a file to its present path and returns
            all other texts unchanged.
        changes: Other changes to the scene.

    Raises:
        InputError: The file is missing or broken, an object in it cannot be made or belongs to
            another variant, it has no sensor, or ``size`` or ``changes`` do not fit the scene.
    """
    import mitsuba as mi

    from ..scene.media import has_instances, has_media

    is_dict = isinstance(source, Mapping)
    check_source(source)
    path = None if is_dict else Path(source)
    label = "the scene" if is_dict else str(path)
    strings = {key: as_xml(value) for key, value in (parameters or {}).items()}
    if is_dict and strings:
        raise InputError(f"a scene from a dict has no $parameters: found {', '.join(strings)}")
    config = mi.parser.ParserConfig(mi.variant())
    if keep_names:
        config.merge_meshes = config.merge_equivalent = False
    with _search_path(path):
        try:
            if is_dict:
                state = mi.parser.parse_dict(config, _with_own_bitmaps(source))
            else:
                state = mi.parser.parse_file(config, str(path), **strings)
            check_nodes(state)
            group_nodes(state)
            check_parsed(state)
            if moved:
                for (node, key), name in list(named_in(state)):
                    node.props[key] = moved(name)
            files = files_of(state, strings)
            file_hashes = hash_each(files)
            named = {**strings, **changes.described()}
            content_hash = hash_files(file_hashes, named, source if is_dict else None)
            if changes.max_depth is not None:
                _set_max_depth(state, changes.max_depth, keep_integrator)
            integrator = _integrator_node(state)
            # Before transform_all(), after which a node's memory may be freed
            integrator_name = integrator.props.plugin_name() if integrator else ""
            settings, only_says_path = _settings(integrator), _only_says_path(state)
            if changes.max_depth is not None:
                settings[SETTINGS[0]] = changes.max_depth
            if keep_integrator and has_masks(state):
                config.merge_meshes = config.merge_equivalent = False
            names_media = any(node.type == mi.ObjectType.Medium for node in state.nodes)
            if not keep_integrator:
                _drop_integrators(state)
            change_films(state, size, changes)
            mi.parser.transform_all(config, state)
            scene = mi.parser.instantiate(config, state)
        except InputError as error:
            raise InputError(f"{label}: {error}") from error
        except Exception as error:  # a plugin's constructor may raise anything
            message = explained(one_line(error))
            if "unused parameters" in message and path is not None:
                message = _unused(path, list(strings))
            raise InputError(message if label in message else f"{label}: {message}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"{label}: the outermost element must be a <scene>")
    if not scene.sensors():
        raise InputError(f"{label}: the scene has no sensor")
    film = scene.sensors()[0].film()
    return LoadedScene(
        scene=scene,
        path=path,
        parameters=strings,
        files=files,
        file_hashes=file_hashes,
        content_hash=content_hash,
        settings=settings,
        integrator_name=integrator_name,
        only_says_path=only_says_path,
        changes=changes,
        has_media=has_media(scene) or (names_media and has_instances(scene)),
        size=(int(film.crop_size()[0]), int(film.crop_size()[1])),
    )


def _unused(path: Path, given: list[str]) -> str:
    """Says which given ``$parameter`` a scene file does not have."""
    known = parameters_of(path)
    key = next((key for key in given if key not in known), given[0])
    hint = did_you_mean(key, known)
    if not hint:
        hint = f" (it has {', '.join(f'${name}' for name in known)})" if known else ""
    return f"the scene has no parameter ${key}{hint}"


def _with_own_bitmaps(source: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a scene's dict and of its bitmaps. In spectral variants, Mitsuba's ``bitmap``
    converts the pixels of a ``mi.Bitmap`` in place: without a copy, the dict would give another
    scene the next time."""
    import mitsuba as mi

    def copy(value: Any) -> Any:
        if isinstance(value, mi.Bitmap):
            return mi.Bitmap(value)
        return _with_own_bitmaps(value) if isinstance(value, Mapping) else value

    return {key: copy(value) for key, value in source.items()}


def as_xml(value: object) -> str:
    """The text of a value in a scene file."""
    return str(value).lower() if isinstance(value, bool) else str(value)


@contextlib.contextmanager
def _search_path(path: Path | None) -> Iterator[None]:
    """Makes Mitsuba search for meshes and textures beside the file ``path``: ``mi.load_file`` adds
    this folder to the search path, but the functions of ``mi.parser`` do not."""
    import mitsuba as mi

    if path is None:
        yield
        return
    resolver = mi.file_resolver()
    resolver.prepend(str(path.resolve().parent))
    try:
        yield
    finally:
        del resolver[0]


def _integrator_nodes(state: mi.parser.ParserState) -> list[mi.parser.SceneNode]:
    import mitsuba as mi

    return [
        node
        for node in state.nodes
        if node.type == mi.ObjectType.Integrator
        or (node.type == mi.ObjectType.Unknown and _is_integrator(node, ""))
    ]


def _only_says_path(state: mi.parser.ParserState) -> bool:
    nodes = _integrator_nodes(state)
    is_path = all(node.props.plugin_name() == "path" for node in nodes)
    return len(nodes) < 2 and is_path and all(set(n.props.keys()) <= set(SETTINGS) for n in nodes)


def _integrator_node(state: mi.parser.ParserState) -> mi.parser.SceneNode | None:
    """The scene's integrator that traces the paths: inside a wrapper such as ``aov``, the first one
    that sets ``max_depth``."""
    nodes = _integrator_nodes(state)
    with_depth = [node for node in nodes if SETTINGS[0] in node.props]
    return (with_depth or nodes or [None])[0]


def _settings(node: mi.parser.SceneNode | None) -> dict[str, int | bool]:
    """The :data:`SETTINGS` of an integrator: the values in the file, otherwise the default depths,
    which can be read only from the integrator's ``str()``."""
    import mitsuba as mi

    if node is None:
        return {}
    own = mi.Properties(node.props)  # a copy: reading a property marks it as queried
    text = _printed(node)
    settings: dict[str, int | bool] = {}
    for key in SETTINGS:
        printed = re.search(rf"\b{key} = (-?\d+)", text)
        if key in own:
            settings[key] = own[key]
        elif printed:
            value = int(printed.group(1))
            settings[key] = -1 if value == _UNLIMITED else value
    return settings


def _printed(node: mi.parser.SceneNode) -> str:
    """The ``str()`` of an integrator with its default parameters; empty if it cannot be made."""
    import mitsuba as mi

    with contextlib.suppress(Exception):  # a wrapper or an unknown plugin
        properties = mi.Properties(node.props.plugin_name())
        return str(mi.PluginManager.instance().create_object(properties))
    return ""


def _set_max_depth(state: mi.parser.ParserState, max_depth: int, is_needed: bool) -> None:
    """Sets the maximum depth of all integrators in the scene that have this parameter.

    Raises:
        InputError: ``is_needed`` is true, and no integrator has this parameter.
    """
    key, nodes = SETTINGS[0], _integrator_nodes(state)
    found = [node for node in nodes if key in node.props or f"{key} =" in _printed(node)]
    for node in found:
        node.props[key] = max_depth
    if is_needed and nodes and not found:
        name = nodes[0].props.plugin_name()
        raise InputError(f'"{name}" has no maximum depth that --max-depth could replace')


def _drop_integrators(state: mi.parser.ParserState) -> None:
    import mitsuba as mi

    properties = state.root.props
    for key in list(properties.keys()):
        value = properties[key]
        if isinstance(value, mi.Properties.ResolvedReference):
            is_integrator = _is_integrator(state.nodes[value.index()], key)
        else:
            is_integrator = isinstance(value, mi.Integrator)
        if is_integrator:
            del properties[key]


def _is_integrator(node: mi.parser.SceneNode, key: str) -> bool:
    """Whether the node is an integrator. The parser of dicts does not know the kind of a plugin
    that is written in Python, so this function instantiates it."""
    import mitsuba as mi

    if node.type != mi.ObjectType.Unknown:
        return node.type == mi.ObjectType.Integrator
    try:
        properties = mi.Properties(node.props.plugin_name())
        return isinstance(mi.PluginManager.instance().create_object(properties), mi.Integrator)
    except Exception:  # unknown, or needs parameters
        return key == "integrator"
