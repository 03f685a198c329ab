"""``mitsuba-ext merge``: merges the samples of several renders."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from . import candidates
from .common import FilledPath, say

if TYPE_CHECKING:
    from ..long_renders.folder import CheckpointFolder
    from ..long_renders.state import RenderState


@click.command(short_help="Merge renders that --checkpoint has saved.")
@click.option(
    "-o", "--output", type=FilledPath(), required=True, metavar="DIR",
    help="The folder to make; render --checkpoint DIR continues it, and writes the image.",
)
@click.argument(
    "folders", type=FilledPath(), nargs=-1, required=True, metavar="DIR…",
    shell_complete=candidates.folders,
)
def merge(folders: Sequence[Path], output: Path) -> int:
    """Merge the samples of renders that 'mitsuba-ext render --checkpoint DIR' has saved: of the
    same scene, by the same integrator, with different seeds. Each render is weighted by its
    samples."""
    from ..long_renders.folder import CheckpointFolder, check_same
    from ..util.errors import InputError
    from ..util.files import make_folder

    if len(folders) < 2:
        raise click.UsageError("there is nothing to merge with: name two or more folders")
    if output.exists():
        raise InputError(f"{output}: exists already")
    first, *others = (CheckpointFolder(folder) for folder in folders)
    description, state = first.description(), _loaded(first)
    for other in others:
        check_same(description, other.description(), first.path, free=["seed"])
        try:
            state = state.plus(_loaded(other))
        except InputError as error:
            raise InputError(f"{first.path} and {other.path}: {error}") from None
    # Made under a temporary name: an unfinished folder could be mistaken for a render's start
    make_folder(output.parent)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as made:
            target = CheckpointFolder(Path(made) / output.name)
            with target.in_use():
                target.describe(description)
                target.save(state)
            os.rename(target.path, output)
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror})") from error
    say(f"{output}: {state.spp} spp in {len(state.done)} batches", err=False)
    return 0


def _loaded(folder: CheckpointFolder) -> RenderState:
    state = folder.load()
    if folder.damaged:
        say(f"mitsuba-ext: warning: {folder.damaged}: is damaged: the previous state is merged")
    return state
