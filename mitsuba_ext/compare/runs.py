"""Measured renders, and the folder that keeps them.

Every run is one EXR: its image, and in its header what it cost. The name holds a hash of all that
the run depends on, so that a comparison that is started again takes up the runs that are there, and
never one of another scene, integrator, version or machine.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..scenes import InputError
from . import images
from .metrics import Errors

#: What stands beside a run's file while it is being made, and after the process died of it.
_RUNNING = ".running"
_CRASHED = ".crashed"


#: Tells the processes of one session from others. A supervisor hands its own on to its workers.
SESSION_VARIABLE = "MITSUBA_EXT_SESSION"
SESSION = os.environ.get(SESSION_VARIABLE) or uuid.uuid4().hex


@dataclass
class Run:
    """One measured render.

    Attributes:
        level: What was asked for: samples per pixel, or seconds.
        round: Which of the repetitions it is, from 0 on.
        seed: Its seed.
        spp: Samples per pixel that were taken.
        seconds: Wall clock of the render, learning included, compilation excluded.
        rays: Rays traced by kind (``camera``, ``scatter``, ``shadow``), empty if not known.
        connections: Connections to lights that were considered (``path`` traces a shadow ray for
            each), ``None`` if not known.
        zero_radiance: Share of the camera samples without radiance, ``None`` if not known.
        memory: Peak of the memory that Dr.Jit held, in bytes.
        launches: Kernels launched.
        session: In which it was measured: runs of different ones did not take turns.
        path: The EXR that holds the image.
        errors: Against the reference of the experiment.
    """

    level: float
    round: int
    seed: int
    spp: int
    seconds: float
    rays: dict[str, int]
    connections: int | None
    zero_radiance: float | None
    memory: int | None
    launches: int
    session: str = field(default_factory=lambda: SESSION)
    path: Path = field(default_factory=Path)
    errors: Errors | None = None

    def image(self) -> np.ndarray:
        """The image, (height, width, 3), read from its file."""
        channels, _ = images.read_exr(self.path)
        return np.stack([channels[name] for name in "RGB"], axis=2)

    @property
    def ray_count(self) -> int | None:
        return sum(self.rays.values()) if self.rays else None

    @property
    def shadow_share(self) -> float | None:
        """Shadow rays traced, of those that ``path`` would trace."""
        return self.rays["shadow"] / self.connections if self.connections else None

    def record(self) -> dict[str, object]:
        """The run without image, path and errors, for JSON."""
        skipped = ("path", "errors")
        return {key: value for key, value in asdict(self).items() if key not in skipped}


class RunFolder:
    """The runs of one scene on disk.

    Args:
        folder: Where the EXRs are; made when the first one is written.
        identity: What all runs of the scene depend on: scene, versions, machine.
    """

    def __init__(self, folder: Path, identity: Mapping[str, object]) -> None:
        self.folder = folder
        self._identity = dict(identity)

    def path(self, label: str, integrator: str, level: str, round: int, seed: int) -> Path:
        """The file of a run.

        Args:
            label: The integrator's label, for the eye.
            integrator: All that its images depend on.
            level: The level with its unit (``64spp``, ``10s``).
            round, seed: Of the run.
        """
        identity = {**self._identity, "integrator": integrator, "level": level, "round": round,
                    "seed": seed}
        key = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode())
        readable = re.sub(r"[^\w.=-]+", "_", label)[:60].strip("_")
        return self.folder / f"{readable}_{level}_seed{seed}_{key.hexdigest()[:12]}.exr"

    def load(self, path: Path) -> Run | None:
        """A run that was finished earlier; ``None`` if there is none, or its file is damaged."""
        if not path.is_file():
            return None
        try:
            _, metadata = images.read_exr(path)
            return Run(**json.loads(str(metadata["run"])), path=path)
        except (InputError, KeyError, TypeError, ValueError):
            return None

    def save(
        self, run: Run, image: np.ndarray, path: Path, metadata: Mapping[str, object]
    ) -> Run:
        """Writes a run; what it returns knows its file."""
        header = {**metadata, "spp": run.spp, "seed": run.seed, "seconds": run.seconds,
                  "run": json.dumps(run.record())}
        images.write_exr(path, image, "RGB", header)
        return replace(run, path=path)


def has_crashed(path: Path) -> bool:
    """Did an earlier process die while it was making ``path``?"""
    return path.with_suffix(_CRASHED).exists()


@contextlib.contextmanager
def marked(path: Path) -> Iterator[None]:
    """Leaves a mark beside ``path`` while that file (a run, a reference) is being made. A mark that
    stays tells a supervisor what the process died of (:func:`blame`).

    Raises:
        RuntimeError: A process died of it before.
    """
    if has_crashed(path):
        raise RuntimeError(path.with_suffix(_CRASHED).read_text(encoding="utf-8"))
    mark = path.with_suffix(_RUNNING)
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def blame(folder: Path, message: str) -> bool:
    """After the end of the process that was comparing in ``folder``: notes ``message`` as the end
    of what it was at. Returns whether there was something."""
    marks = list(folder.glob(f"*/*{_RUNNING}"))
    for mark in marks:
        mark.with_suffix(_CRASHED).write_text(message, encoding="utf-8")
        mark.unlink()
    return bool(marks)


def forgive(folder: Path) -> None:
    """Forgets what :func:`blame` noted: the runs are tried again."""
    for suffix in (_RUNNING, _CRASHED):
        for mark in folder.glob(f"*/*{suffix}"):
            mark.unlink()
