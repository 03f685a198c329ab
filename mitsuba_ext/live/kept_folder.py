"""Snapshots of renders that are kept in folders."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..long_renders.folder import CheckpointFolder
from ..long_renders.state import RenderState
from ..util.errors import InputError
from .increments import estimated_error
from .snapshot import Snapshot

#: The fewest batches from which an error is estimated, as in a long render.
_MIN_BATCHES = 8


def of_state(state: RenderState, error: float | None, seconds: float = 0.0) -> Snapshot:
    """A snapshot of the image of all batches, whose relMSE is ``error``."""
    batches = state.images
    colours = [name for name in batches.channels[: batches.image_channel_count] if name != "A"]
    variance = None
    if batches.count > 1:
        variance = batches.variance[..., : len(colours)].astype(np.float32)
    return Snapshot(
        batches.mean.astype(np.float32), batches.channels, batches.image_channel_count, batches.spp,
        seconds, variance, error, state.totals.learned, dict(state.totals.effects),
    )  # fmt: skip


class KeptFolder:
    """A folder of ``--checkpoint``, which another process may be rendering; or a folder of such
    folders, one for each frame or sensor, of which the one that was saved last is shown.

    Parameters:
        path: The folder.

    Raises:
        InputError: No render is kept there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._shown: tuple[Path, int] | None = None
        if not list(self._renders()):
            raise InputError(f"{path}: no render is kept here: name a folder of --checkpoint")

    def news(self) -> tuple[dict[str, str], dict[str, Any], Snapshot] | None:
        """What the image is, figures, and the image itself; ``None`` if it has not changed since
        the last call, or there is none yet.

        Raises:
            InputError: It is damaged.
        """
        states = [
            (state.stat().st_mtime_ns, folder)
            for folder in self._renders() for state in [folder / "state.npz"] if state.exists()
        ]
        if not states or (newest := max(states)) == self._shown:
            return None
        self._shown, (saved, path) = newest, newest
        folder = CheckpointFolder(path)
        state, description = folder.load(), folder.description()
        if not state.done:
            return None
        error = None
        if state.images.count >= _MIN_BATCHES and state.images.channels[:3] == ("R", "G", "B"):
            rgb = (x[..., :3] for x in (state.images.mean, state.images.variance))
            error = estimated_error(*rgb)
        name = path.relative_to(self._path.parent) if path != self._path else Path(self._path.name)
        when = datetime.datetime.fromtimestamp(saved / 1e9).strftime("%Y-%m-%d %H:%M:%S")
        facts = {
            "title": str(name),
            "Scene": str(description.get("scene", "")),
            "Integrator": str(description.get("integrator", "")),
            "Seeds": ", ".join(map(str, sorted({batch.seed for batch in state.done}))),
            "Saved": when,
        }
        figures = {"spp": state.spp, "seconds": state.totals.render_seconds}
        return facts, figures, of_state(state, error, state.totals.render_seconds)

    def _renders(self) -> Iterator[Path]:
        for folder in (self._path, *sorted(self._path.glob("*/"))):
            if (folder / "render.json").is_file():
                yield folder
