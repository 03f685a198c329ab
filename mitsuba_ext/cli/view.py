"""``mitsuba-ext view``: shows a render that another process keeps in a folder."""

from __future__ import annotations

import time
from pathlib import Path

import click

from . import candidates
from .common import FilledPath, say
from .viewing import TEV, CommandWithTev

#: The time between two looks at the folder, in seconds.
_PERIOD = 1.0


@click.command(cls=CommandWithTev, short_help="Show a render that --checkpoint saves.")
@click.option(
    "--serve", "port", type=click.IntRange(0, 65535), metavar="PORT",
    help="The port of the web page; 0 for any that is free.  [default: 0, without --tev]",
)
@click.option(
    "--tev", metavar="[HOST:PORT]",
    help=f"Show it in the image viewer tev.  [default: {TEV}]",
)
@click.argument("folder", type=FilledPath(), shell_complete=candidates.folders)
def view(folder: Path, port: int | None, tev: str | None) -> int:
    """Show the render that 'mitsuba-ext render --checkpoint FOLDER' keeps, on a web page or in tev,
    whenever it is saved, until Ctrl-C. The render may be running, or finished, or may have been
    interrupted; nothing is written."""
    from ..live.kept_folder import KeptFolder
    from ..live.viewer import FOLLOWING, open_viewer
    from ..util.errors import InputError

    kept = KeptFolder(folder)
    news = kept.news()
    port = 0 if port is None and tev is None else port
    viewer, address = open_viewer(
        tev, port, False, lambda text: say(f"mitsuba-ext: warning: {text}"), FOLLOWING
    )
    if address:
        say(f"{folder} is shown at {address} (Ctrl-C ends this)")
    while True:
        if news is not None:
            facts, figures, snapshot = news
            viewer.follow(folder.name, facts, snapshot, figures)
        time.sleep(_PERIOD)
        try:
            news = kept.news()
        except (InputError, OSError) as error:  # while it is written, or moved
            say(f"mitsuba-ext: warning: {error}")
            news = None
