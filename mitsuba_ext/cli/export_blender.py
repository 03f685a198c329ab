"""``mitsuba-ext export-blender``: adds our integrators to the menus of the add-on mitsuba-blender.

The add-on makes its menus from ``engine/integrators.json``, a table of plugins::

    {"path": {"label", "description", "parameters": {
        "max_depth": {"label", "description", "type", "default", "min"}, …}}, …}

Of the add-on's types, our parameters have ``integer``, ``float`` and ``boolean``. The add-on does
not support strings, and it writes every parameter of the table into the scene, even with its
default value. The table therefore omits string parameters, and parameters that are refused unless
another one is set. It also omits integrators that nest others (the add-on makes classes for each
nesting) and ``composed_prb``, which is for gradients.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..util.errors import InputError
from ..util.files import check_target, replacing
from .common import say

if TYPE_CHECKING:
    from ..startup.pages import Page, Parameter

_TYPES = {
    "int": "integer", "integer": "integer", "float": "float", "bool": "boolean",
    "boolean": "boolean",
}  # fmt: skip

#: The entry of ``path``, which the table needs because the add-on selects it in new scenes.
_PATH = {
    "label": "Path tracer",
    "description": "Mitsuba's own path tracer.",
    "parameters": {
        "max_depth": {
            "label": "Max Depth", "description": "Longest path, -1 for no limit.",
            "type": "integer", "default": -1, "min": -1,
        },
        "rr_depth": {
            "label": "Rr Depth", "description": "Path depth at which Russian roulette begins.",
            "type": "integer", "default": 5, "min": 0,
        },
        "hide_emitters": {
            "label": "Hide Emitters", "description": "Hide directly visible emitters.",
            "type": "boolean", "default": False,
        },
    },
}  # fmt: skip


@click.command("export-blender", short_help="Write the table of integrators for mitsuba-blender.")
@click.option(
    "-o", "--output", metavar="FILE", type=click.Path(path_type=Path, dir_okay=False),
    help="The add-on's engine/integrators.json. If it exists, its other integrators are kept. "
    "Default: print the table.",
)  # fmt: skip
def export_blender(output: Path | None) -> int:
    """Write the parameters of our integrators for the menus of the add-on mitsuba-blender.

    FILE is engine/integrators.json in the folder of the add-on. With Blender 4.2 on Linux, that is
    ~/.config/blender/4.2/scripts/addons/mitsuba-blender/engine/integrators.json. Restart Blender
    afterwards. To render with our integrators, Blender needs an add-on for Mitsuba 3.9; with an
    older one, export the scene as XML, and use mitsuba-ext render.
    """
    old = _read(output) if output is not None and output.exists() else {"path": _PATH}
    table = {**old, **blender_table()}
    text = json.dumps(table, indent=4) + "\n"
    if output is None:
        click.echo(text, nl=False)
        return 0
    check_target(output)
    with replacing(output) as temporary:
        temporary.write_text(text, encoding="utf-8")
    say(f"{output}: {len(table)} integrators")
    return 0


def blender_table() -> dict[str, dict[str, Any]]:
    """The entries of our integrators that render images and do not nest others."""
    from ..startup import pages, plugin_folders

    found = [pages.read_page(file) for file in plugin_folders.plugin_files("integrators")]
    return {page.name: _entry(page) for page in found if not _is_left_out(page)}


def _is_left_out(page: Page) -> bool:
    nests = any(parameter.type == "integrator" for parameter in page.parameters)
    return nests or page.name == "composed_prb"


def _entry(page: Page) -> dict[str, Any]:
    parameters: dict[str, dict[str, Any]] = {}
    for row in page.parameters:
        value = None if _is_conditional(row) else _default(row)
        if value is not None:
            for name in row.name.split(", "):
                parameters[name] = _parameter(name, row, value)
    return {
        "label": page.title.replace(f" ({page.name})", ""),
        "description": _sentence(page.summary),
        "parameters": parameters,
    }


def _parameter(name: str, row: Parameter, value: bool | int | float) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "label": name.replace("_", " ").title(),
        "description": _sentence(row.description),
        "type": _TYPES[row.type],
        "default": value,
    }
    if entry["type"] == "integer":
        entry["min"] = min(0, int(value))
    return entry


def _is_conditional(row: Parameter) -> bool:
    """Whether the parameter is refused, even with its default value, unless another one is set."""
    return bool(re.search(r"^With [a-z]|only with |accepted only if ", row.description))


def _default(row: Parameter) -> bool | int | float | None:
    """The default value for the table; ``None`` if it is not a single number or Boolean."""
    kind = _TYPES.get(row.type)
    if kind == "boolean":
        return {"true": True, "false": False}.get(row.default)
    number = re.match(r"(-?\d+(?:\.\d+)?)(?=$|[:,])", row.default)
    if kind is None or number is None:
        return None
    return int(number[1]) if kind == "integer" else float(number[1])


def _sentence(text: str) -> str:
    """The first sentence, for a tooltip."""
    return re.split(r"(?<=[.?!]) ", text, maxsplit=1)[0]


def _read(file: Path) -> dict[str, Any]:
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as a table of integrators ({error})") from error
    if not isinstance(table, dict) or not all(isinstance(one, dict) for one in table.values()):
        raise InputError(f"{file}: is not a table of integrators: expected objects by name")
    return {"path": _PATH, **table}
