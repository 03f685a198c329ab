"""``mitsuba-ext list``: shows the plugins and their pages."""

from __future__ import annotations

import click

from . import candidates
from .common import console_for_tables

_MITSUBA_PLUGINS = "https://mitsuba.readthedocs.io/en/stable/src/plugin_reference.html"
_MITSUBA_INTEGRATORS = (
    "https://mitsuba.readthedocs.io/en/stable/src/generated/plugins_integrators.html"
)


@click.command("list", short_help="Show the plugins, or the parameters of one.")
@click.argument("name", required=False, shell_complete=candidates.plugins)
def list_plugins(name: str | None) -> int:
    """Show the plugins, or the page of the plugin NAME."""
    from rich.table import Table

    from ..startup import pages, plugin_folders

    files = {kind: plugin_folders.plugin_files(kind) for kind in plugin_folders.plugin_names()}
    console = console_for_tables()
    if name is None:
        overview = Table("plugin", "kind", "what it does")
        decisions = plugin_folders.decision_names()
        for kind, paths in files.items():
            for path in paths:
                page = pages.read_page(path)
                what = "decision" if page.name in decisions else kind[:-1]
                overview.add_row(page.name, what, page.title or page.summary)
        console.print(overview)
        return 0
    file = next((path for paths in files.values() for path in paths if path.stem == name), None)
    if file is None:
        raise _no_page(name, sorted(path.stem for paths in files.values() for path in paths))
    page = pages.read_page(file)
    if page.title:
        console.print(page.title, style="bold", highlight=False, markup=False)
    if page.parameters:
        parameters = Table("parameter", "type", "default", "description")
        for parameter in page.parameters:
            parameters.add_row(
                parameter.name, parameter.type, parameter.default or "–", parameter.description
            )
        console.print(parameters)
    console.print(page.text, highlight=False, markup=False)
    return 0


def _no_page(name: str, ours: list[str]) -> click.UsageError:
    from ..inputs import names
    from ..util.errors import did_you_mean

    if name in names.MITSUBA_INTEGRATORS:
        return click.UsageError(
            f'"{name}" is an integrator of Mitsuba\'s own: its page is in {_MITSUBA_INTEGRATORS}, '
            f"and 'mitsuba-ext render --integrator {name}' uses it"
        )
    if names.is_file_of_mitsuba(name):
        return click.UsageError(
            f'"{name}" is a plugin of Mitsuba\'s own: its page is in {_MITSUBA_PLUGINS}'
        )
    hint = did_you_mean(name, [*ours, *names.MITSUBA_INTEGRATORS])
    return click.UsageError(f'no plugin "{name}"{hint} (there are: {", ".join(ours)})')
