"""Integrators as a command line, a notebook or a file names them."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union
from xml.etree import ElementTree

from .content_hash import hash_code
from .errors import InputError
from .names import unknown_integrator
from .scenes import one_line

if TYPE_CHECKING:
    import mitsuba as mi

Value = Union[bool, int, float, str]

#: How an integrator can be named; see :func:`make_named`.
Specification = Union[str, Path, Mapping[str, Any], "mi.Integrator"]


@dataclass
class NamedIntegrator:
    """An integrator, and how it was asked for.

    Attributes:
        label: What tells it from others in tables.
        name: Its plugin's name.
        parameters: What it was made with, as far as that is known.
        integrator: The integrator.
        identity: Text that changes whenever the integrator could render other images or take other
            time: its plugins, its parameters, and the code of those that are written in Python.
            Where these cannot be known (an integrator that exists already, code without a file), it
            is never the same again.
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
        specification: ``name`` or ``name:key=value,key=value``; the path of an XML file whose root
            is an ``<integrator>``, or of a JSON file with what ``mi.load_dict`` takes; such a dict;
            or an integrator that exists already (nothing is inherited then).
        inherited: Parameters (a :attr:`LoadedScene.settings`) that apply to each integrator, nested
            ones included, that knows them and does not set them.
        label: Instead of one made from the specification.

    Raises:
        InputError: There is no such file or plugin, it is no integrator, or it rejects a parameter.
    """
    import mitsuba as mi

    if isinstance(specification, mi.Integrator):
        name = getattr(specification, "name", None) or specification.class_name()
        parts = (name, {}, specification)
    elif isinstance(specification, Mapping):
        default = str(specification.get("type", "integrator"))
        parts = _from_parser(default, dict(specification), inherited)
        label = label or _label_of_dict(specification)
    elif Path(specification).suffix.lower() in (".xml", ".json"):
        parts = _from_parser(str(specification), _read_fragment(Path(specification)), inherited)
    else:
        name, own = parse_integrator(str(specification))
        integrator, parameters = make_integrator(name, own, inherited)
        parts = (name, parameters, integrator)
    name, parameters, integrator = parts
    if label is None:
        label = name if isinstance(specification, mi.Integrator) else str(specification)
    identity = _identity(specification, name, parameters, integrator)
    return NamedIntegrator(label, name, parameters, integrator, identity)


def _identity(
    specification: Specification, name: str, parameters: dict[str, Any], integrator: mi.Integrator
) -> str:
    unique = uuid.uuid4().hex
    if _is_alive(specification):
        return unique
    try:
        state = str(integrator)
    except Exception:  # a class in Python without to_string()
        return unique
    is_builtin = isinstance(specification, str) and type(integrator).__module__ == "mitsuba"
    code = "" if is_builtin else hash_code(type(integrator))
    if code is None:
        return unique
    return json.dumps([name, parameters, state, code], sort_keys=True, default=repr)


def _is_alive(specification: object) -> bool:
    """Is it, or does it hold, an object whose state can change?"""
    import mitsuba as mi

    if isinstance(specification, Mapping):
        return any(map(_is_alive, specification.values()))
    return isinstance(specification, mi.Object)


def is_fragment(path: Path) -> bool:
    """Is the file an integrator, and not a scene? What cannot be read is not."""
    if path.suffix.lower() == ".json":
        return True
    try:
        for _event, element in ElementTree.iterparse(path, ["start"]):
            return element.tag == "integrator"
    except (OSError, ElementTree.ParseError):
        pass
    return False


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
            knows them (a :attr:`LoadedScene.settings`).

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
            raise unknown_integrator(name) from error
        raise InputError(f'integrator "{name}": {one_line(error)}') from error
    if not isinstance(integrator, mi.Integrator):
        raise InputError(f'"{name}" is a plugin of Mitsuba, but not an integrator')
    integrator = (integrator.expand() or [integrator])[0]  # "volpathmis" is made in two steps
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


def _read_fragment(path: Path) -> str | dict[str, Any]:
    """XML text with the version that Mitsuba insists on, or a dict."""
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
) -> tuple[str, dict[str, Any], mi.Integrator]:
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    try:
        is_text = isinstance(content, str)
        parse = mi.parser.parse_string if is_text else mi.parser.parse_dict
        state = parse(config, content)
        for node in state.nodes:
            for key, value in (inherited or {}).items():
                if key not in node.props and _knows(node.props.plugin_name(), key, value):
                    node.props[key] = value
        root = mi.Properties(state.root.props)  # a copy: what is read counts as known to the plugin
        name = root.plugin_name()
        parameters = {
            key: root[key] for key in root.keys() if isinstance(root[key], (bool, int, float, str))
        }
        mi.parser.transform_all(config, state)
        integrator = mi.parser.instantiate(config, state)
    except Exception as error:  # a plugin's constructor may raise anything
        raise InputError(f'integrator "{source}": {one_line(error)}') from error
    if not isinstance(integrator, mi.Integrator):
        raise InputError(f'"{name}" ({source}) is a plugin of Mitsuba, but not an integrator')
    return name, parameters, integrator


def _knows(name: str, key: str, value: Value) -> bool:
    """Does a plugin query the parameter? (One that cannot be made alone, as a wrapper: no.)"""
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
        if key != "type" and isinstance(value, (bool, int, float, str))
    ]
    return str(specification.get("type", "integrator")) + (":" if values else "") + ",".join(values)


def _as_text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
