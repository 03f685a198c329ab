"""Parameters of frames, computed by a function of the user's."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..inputs.variants import import_from_here
from ..util.errors import InputError


class FrameParameters(NamedTuple):
    """The changes that a frame makes to a scene.

    Attributes:
        definitions: Values of the scene file's ``$name`` parameters.
        values: Values of parameters of the loaded scene, as JSON; see
            :func:`~mitsuba_ext.inputs.scene_values.as_text`.
    """

    definitions: dict[str, str]
    values: str


def load_function(text: str) -> Callable[[int], FrameParameters]:
    """Loads the user's function, and wraps it in one from a frame's number to its parameters.

    Args:
        text: ``file.py:function`` or ``module:function``. The function returns a dict. Keys with a
            dot are keys of ``mi.traverse``; others are ``<default>``s of the scene.

    Raises:
        InputError: The file or the function does not exist. The wrapper also raises it if the
            user's function fails or does not return such a dict.
    """
    source, colon, name = text.rpartition(":")
    if not colon or not source or not name.isidentifier():
        raise InputError(f'--parameters: expected something like animate.py:frame, found "{text}"')
    try:
        function = getattr(_module(source), name, None)
    except InputError:
        raise
    except Exception as error:  # the module may raise anything
        raise InputError(f"{source}: {type(error).__name__}: {error}") from error
    if not callable(function):
        raise InputError(f'{source}: there is no function "{name}"')

    def parameters(frame: int) -> FrameParameters:
        from ..inputs.scene_values import as_text
        from ..inputs.scenes import as_xml

        try:
            found = function(frame)
        except Exception as error:  # the function may raise anything too
            raise InputError(f"{text}: frame {frame}: {type(error).__name__}: {error}") from error
        if not isinstance(found, Mapping) or not all(isinstance(key, str) for key in found):
            raise InputError(f"{text}: frame {frame}: must return a dict with names as keys")
        definitions = {key: as_xml(value) for key, value in found.items() if "." not in key}
        try:
            values = as_text({key: value for key, value in found.items() if "." in key})
        except InputError as error:
            raise InputError(f"{text}: frame {frame}: {error}") from None
        return FrameParameters(definitions, values)

    return parameters


def _module(source: str) -> Any:
    if not source.endswith(".py"):
        return import_from_here(source)
    path = Path(source)
    if not path.is_file():
        raise InputError(f"{source}: no such file")
    spec = importlib.util.spec_from_file_location(f"parameters_of_frames_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
