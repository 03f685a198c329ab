"""Makes integrators from text, files and dicts."""

from __future__ import annotations

import contextlib
import json
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union
from xml.etree import ElementTree

from ..scene.aovs import MASK_TYPES, check_aovs, check_nodes
from ..startup.plugin_parameters import parameter_names
from ..startup.registry import plugin_names
from ..util.errors import InputError, one_line
from .content_hash import hash_code, hash_value
from .names import explained, is_file_of_mitsuba, is_plugin, unknown_parameter, unknown_plugin
from .plugin_text import parse_plugin
from .scenes import check_variant

if TYPE_CHECKING:
    import mitsuba as mi

Value = Union[bool, int, float, str]

#: The ways to specify an integrator; see :func:`make_named`.
Specification = Union[str, Path, Mapping[str, Any], "mi.Integrator"]


@dataclass
class NamedIntegrator:
    """An integrator, its name and its parameters.

    Attributes:
        label: The integrator's name in tables.
        name: The plugin's name.
        parameters: The known parameters; a nested plugin is a dict.
        integrator: The integrator.
        identity: Text that changes whenever the integrator could render different images or take
            different time. It covers the plugins, their parameters, and the code of plugins written
            in Python. If these are unknown (for an existing integrator, or code without a file),
            the identity is random, so stored runs are never used.
    """

    label: str
    name: str
    parameters: dict[str, Any]
    integrator: mi.Integrator = field(repr=False)
    identity: str = field(repr=False)


def make_named(
    specification: Specification,
    inherited: Mapping[str, Value] | None = None,
    label: str | None = None,
) -> NamedIntegrator:
    """Makes an integrator in the active variant.

    Args:
        specification: ``name`` or ``name:key=value,key=value``
            (:func:`.plugin_text.parse_plugin`); the path of an XML file whose root is an
            ``<integrator>``, or of a JSON file with a dict for ``mi.load_dict``; such a dict; or an
            existing integrator (which inherits nothing).
        inherited: Parameters (from :attr:`LoadedScene.settings`) for each integrator, including
            nested ones, that has them and does not set them.
        label: The label. By default, it is derived from the specification.

    Raises:
        InputError: The file or plugin does not exist, is not an integrator, rejects a parameter, or
            belongs to another variant.
    """
    import mitsuba as mi

    check_variant(specification)
    if isinstance(specification, mi.Integrator):
        name = getattr(specification, "name", None) or specification.class_name()
        return NamedIntegrator(label or name, name, {}, specification, _never_again())
    content: str | dict[str, Any] = ""
    if isinstance(specification, Mapping):
        default = str(specification.get("type", "integrator"))
        content = dict(specification)
        made = _from_parser(default, content, inherited)
        label = label or _label_of_dict(specification)
    elif not isinstance(specification, (str, Path)):
        raise InputError(
            f"an integrator must be named by text, a file or a dict, found an object of type "
            f"{type(specification).__name__}"
        )
    elif Path(specification).suffix.lower() in (".xml", ".json"):
        content = _read_fragment(Path(specification))
        check_variant(content)
        made = _from_parser(str(specification), content, inherited)
    else:
        plugin = parse_plugin(str(specification))
        made = _make(plugin, inherited or {})
    return NamedIntegrator(
        str(specification) if label is None else label,
        made.name,
        made.parameters,
        made.integrator,
        _never_again() if _is_alive(specification) else _identity(made, content),
    )


@dataclass
class _Made:
    """An integrator, its parameters, and the classes of its own plugin and of all nested ones
    (``None`` for a class that is unknown)."""

    name: str
    parameters: dict[str, Any]
    integrator: mi.Integrator
    classes: list[type | None]


def _identity(made: _Made, content: str | dict[str, Any]) -> str:
    """The identity of an integrator that was made from its parameters, or from ``content``."""
    try:
        # str() shows the defaults of parameters that are not set; addresses vary
        state = re.sub("0x[0-9a-f]+", "", str(made.integrator))
    except Exception:  # to_string() is optional for a class in Python
        state = ""
    code = None if None in made.classes else hash_code(made.classes)
    if code is None:
        return _never_again()
    parts = [made.name, made.parameters, hash_value(content), state, code]
    return json.dumps(parts, sort_keys=True, default=repr)


def _never_again() -> str:
    """An identity that no other integrator has, not even this one in another process."""
    return uuid.uuid4().hex


def _is_alive(specification: object) -> bool:
    """Whether it is a Mitsuba object, or a dict that contains one. Its state can change."""
    import mitsuba as mi

    if isinstance(specification, Mapping):
        return any(map(_is_alive, specification.values()))
    return isinstance(specification, mi.Object)


def names_masks(specification: str | None) -> bool:
    """Whether the text of an integrator, or its file, may name a mask."""
    if not specification:
        return False
    file, text = Path(specification), specification
    if file.suffix.lower() in (".xml", ".json"):
        with contextlib.suppress(OSError, ValueError):
            text = file.read_text(encoding="utf-8")
    return any(f":{kind}" in text for kind in MASK_TYPES)


def is_fragment(path: Path) -> bool:
    """Whether the file is an integrator rather than a scene. False if it cannot be read."""
    if path.suffix.lower() == ".json":
        return True
    try:
        for _event, element in ElementTree.iterparse(path, ["start"]):
            return element.tag == "integrator"
    except (OSError, ElementTree.ParseError):
        pass
    return False


def _make(
    plugin: Mapping[str, Any], inherited: Mapping[str, Value], kind: str = "integrator"
) -> _Made:
    """Makes an integrator after the plugins nested in it (whose ``kind`` is "nested plugin").

    Raises:
        InputError: The plugin is unknown, or rejects a parameter.
    """
    import mitsuba as mi

    own = {key: value for key, value in plugin.items() if key != "type"}
    nested = {
        key: _make(value, inherited, "nested plugin")
        for key, value in own.items()
        if isinstance(value, Mapping)
    }
    objects = {key: made.integrator for key, made in nested.items()}
    if any(isinstance(item, mi.Integrator) for item in objects.values()):
        inherited = {}  # meant for the nested integrator, which traces the paths
    name = plugin["type"]
    if _is_ours(name):  # it refuses parameters that it does not have
        known = parameter_names(name)
        inherited = {key: value for key, value in inherited.items() if key in known}
    given = {**inherited, **own, **objects}
    properties = mi.Properties(name)
    for key, value in given.items():
        properties[key] = value
    try:
        if name == "aov" and isinstance(own.get("aovs"), str):
            check_aovs(name, own["aovs"])
        made = mi.PluginManager.instance().create_object(properties)
    except Exception as error:  # a plugin's constructor may raise anything
        if "not found!" in str(error) and f'Plugin "{name}"' in str(error):
            raise unknown_plugin(name, kind != "integrator") from error
        message = one_line(error)
        if not message.startswith(f'"{name}"'):  # our plugins name themselves
            message = f'"{name}": {message}'
        words = [key for key, value in own.items() if isinstance(value, str) and is_plugin(value)]
        if "must be nested" in message and words:
            message += f" (nested plugins are in brackets: {words[0]}=[{own[words[0]]}])"
        raise InputError(f"{kind} {message}") from error
    if kind == "integrator" and not isinstance(made, mi.Integrator):
        raise InputError(f'"{name}" is a plugin of Mitsuba, but not an integrator')
    made = (made.expand() or [made])[0]  # "volpathmis" is made in two steps
    unknown = set(properties.unqueried())
    for key in own:
        if key in unknown:
            raise unknown_parameter(kind, name, key)
    parameters = {
        key: {"type": nested[key].name, **nested[key].parameters} if key in nested else value
        for key, value in given.items()
        if key not in unknown
    }
    inner = [cls for item in nested.values() for cls in item.classes]
    return _Made(name, parameters, made, [type(made), *inner])


def _read_fragment(path: Path) -> str | dict[str, Any]:
    """XML text, with the version attribute that Mitsuba requires, or a dict."""
    if not path.is_file():
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix.lower() == ".json":
            content = json.loads(text)
            if not isinstance(content, dict) or "type" not in content:
                raise InputError(f'{path}: expected an object with a "type"')
            return content
        root = ElementTree.fromstring(text)
    except (ValueError, OSError, ElementTree.ParseError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: unreadable ({one_line(error)})") from error
    if root.tag != "integrator":
        raise InputError(f"{path}: expected an <integrator>, found <{root.tag}>")
    root.attrib.setdefault("version", "3.0.0")
    return ElementTree.tostring(root, encoding="unicode")


def _from_parser(
    source: str, content: str | dict[str, Any], inherited: Mapping[str, Value] | None
) -> _Made:
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    try:
        is_text = isinstance(content, str)
        parse = mi.parser.parse_string if is_text else mi.parser.parse_dict
        state = parse(config, content)
        check_nodes(state)
        names = {node.props.plugin_name() for node in state.nodes}
        for node in state.nodes:
            for key, value in (inherited or {}).items():
                if key not in node.props and _knows(node.props.plugin_name(), key, value):
                    node.props[key] = value
        root = mi.Properties(state.root.props)  # a copy: reading a property marks it as queried
        name = root.plugin_name()
        parameters = {
            key: root[key] for key in root.keys() if isinstance(root[key], (bool, int, float, str))
        }
        mi.parser.transform_all(config, state)
        integrator = mi.parser.instantiate(config, state)
    except Exception as error:  # a plugin's constructor may raise anything
        raise InputError(f'integrator "{source}": {explained(one_line(error))}') from error
    if not isinstance(integrator, mi.Integrator):
        raise InputError(f'"{name}" ({source}) is a plugin of Mitsuba, but not an integrator')
    nested = [_class_of(other) for other in names - {name}]
    return _Made(name, parameters, integrator, [type(integrator), *nested])


def _class_of(name: str) -> type | None:
    """The class of a plugin; ``None`` if that is unknown."""
    import mitsuba as mi

    try:
        return type(mi.PluginManager.instance().create_object(mi.Properties(name)))
    except Exception:  # a plugin that needs parameters, such as a wrapper
        pass
    if _is_ours(name):
        return _Made  # the hash of any class of this package covers all its files
    return mi.Object if is_file_of_mitsuba(name) else None


def _is_ours(name: str) -> bool:
    return any(name in names for names in plugin_names().values())


def _knows(name: str, key: str, value: Value) -> bool:
    """Whether a plugin queries the parameter. False if it needs others, as a wrapper does."""
    import mitsuba as mi

    properties = mi.Properties(name)
    properties[key] = value
    try:
        mi.PluginManager.instance().create_object(properties)
    except Exception:  # a plugin's constructor may raise anything
        return False
    return key not in properties.unqueried()


def _label_of_dict(specification: Mapping[str, Any]) -> str:
    values = [
        f"{key}={_as_text(value)}"
        for key, value in specification.items()
        if key != "type" and isinstance(value, (bool, int, float, str, Mapping))
    ]
    return str(specification.get("type", "integrator")) + (":" if values else "") + ",".join(values)


def _as_text(value: Value | Mapping[str, Any]) -> str:
    if isinstance(value, Mapping):
        return f"[{_label_of_dict(value)}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
