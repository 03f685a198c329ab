"""Writes the stub of this package: ``make stubs``."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

from ..startup.pages import Parameter, read_page
from ..startup.plugin_folders import KINDS, plugin_files
from .arguments import arguments

STUB = Path(__file__).with_name("__init__.pyi")

_HEAD = '''"""Signatures of the functions of this package, made from the pages of the plugins by
``make stubs``. The documentation of a parameter explains a default of ``...``."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import mitsuba as mi

class _Described(Protocol):
    """A plugin of mitsuba-scene-description."""
    def to_dict(self) -> dict[str, Any]: ...

class _Transformed(Protocol):
    """A transform of mitsuba-scene-description."""
    def to_mi(self) -> Any: ...

Plugin = Mapping[str, Any] | mi.Object | _Described
Texture = Plugin
Spectrum = float | Plugin
Transform = mi.ScalarTransform4f | _Transformed
Vector = Sequence[float]
'''

_WIDTH = 100


def stub() -> str:
    """The text of the stub."""
    functions = [_function(file) for kind in KINDS for file in plugin_files(kind)]
    return "\n\n".join([_HEAD, *functions])


def _function(file: Path) -> str:
    page, known = read_page(file), arguments(file.stem)
    lines = [f"def {page.name}("]
    signature = [f"{argument.name}: {argument.type} = {argument.default}" for argument in known]
    if any(argument.is_first for argument in known):
        signature += ["id: str = ...", "**numbered: Any"]
    else:
        signature.append("id: str = ...")
    lines += [f"    {text}," for text in ["*", *signature]]
    lines.append(") -> dict[str, Any]:")
    lines += _wrapped(f'"""{page.title}.', 4)
    lines += ["", *_wrapped(page.summary, 4)]
    rows = dict.fromkeys(argument.row for argument in known)
    if rows:
        lines += ["", "    Parameters:"]
        for row in rows:
            lines += _described(row)
    lines.append('    """')
    return "\n".join(lines).replace("\\", "\\\\") + "\n"


def _described(row: Parameter) -> list[str]:
    default = f" (Default: {row.default})" if row.default else ""
    # The first sentence: the page has the others
    (what, *_more) = re.split(r"(?<=\.) (?=[A-Z0-9])", row.description)
    return _wrapped(f"{row.name} ({row.type}): {what}{default}", 8, 12)


def _wrapped(text: str, indent: int, hanging: int | None = None) -> list[str]:
    return textwrap.wrap(
        " ".join(text.split()), _WIDTH, initial_indent=" " * indent,
        subsequent_indent=" " * (indent if hanging is None else hanging), break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
