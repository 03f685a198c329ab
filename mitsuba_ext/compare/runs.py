"""Measured renders, and the folder that stores them.

Every run is one EXR: its image, and a header with its cost. The file name contains a hash of
everything on which the run depends, so a restarted comparison uses the stored runs, but never runs
of another scene, integrator, version or machine. Files also hold their name and a checksum, so
damaged or renamed files are not used. A run that was timed again in another session has a JSON file
with these times beside it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..images import image_files
from ..images.metrics import Errors
from ..util import marks
from ..util.errors import InputError
from ..util.files import replacing

#: The suffix of the file with a run's times in other sessions.
_TIMES = ".times.json"


@dataclass
class Run:
    """One measured render.

    Attributes:
        level: The budget: samples per pixel, or seconds.
        round: Index of the repetition, starting at 0.
        seed: The seed.
        spp: Samples per pixel taken.
        seconds: Time of the render (wall clock, or CPU time of all threads), including learning but
            not compilation.
        rays: Rays traced, by kind (``camera``, ``scatter``, ``shadow``); empty if unknown.
        connections: Connections to lights considered (``path`` traces a shadow ray for each);
            ``None`` if unknown.
        zero_radiance: Fraction of camera samples without radiance; ``None`` if unknown.
        memory: Dr.Jit's peak memory, in bytes.
        launches: Number of kernel launches.
        mean: The mean of the image over pixels and channels.
        learned: The integrator's report on what it learned; empty if there is none.
        session: The session in which it was measured. Integrators take turns only within a session.
        timed_again: Time of the same render in later sessions, in seconds, by session.
        path: The EXR that holds the image.
        errors: The errors against the reference of the experiment, or between seeds.
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
    mean: float | None = None
    learned: str = ""
    session: str = field(default_factory=lambda: marks.SESSION)
    timed_again: dict[str, float] = field(default_factory=dict)
    path: Path = field(default_factory=Path)
    errors: Errors | None = None

    def image(self) -> np.ndarray:
        """The image, (height, width, 3), read from its file."""
        channels, _ = image_files.read_exr(self.path)
        return np.stack([channels[name] for name in "RGB"], axis=2)

    @property
    def ray_count(self) -> int | None:
        return sum(self.rays.values()) if self.rays else None

    @property
    def shadow_share(self) -> float | None:
        """The number of shadow rays, as a fraction of the number that ``path`` would trace."""
        return self.rays["shadow"] / self.connections if self.connections else None

    @property
    def times(self) -> dict[str, float]:
        """The time in seconds by session: the run's own session first, then later ones."""
        return {self.session: self.seconds, **self.timed_again}

    @property
    def is_timed_now(self) -> bool:
        """Whether it was timed in this session."""
        return marks.SESSION in self.times

    def record(self) -> dict[str, object]:
        """The run without image, path and errors, for JSON."""
        skipped = ("path", "errors")
        return {key: value for key, value in asdict(self).items() if key not in skipped}


class RunFolder:
    """The runs of one scene on disk.

    Args:
        folder: The folder of the EXRs; made when the first EXR is written.
        identity: Everything on which all runs of the scene depend: scene, versions, machine.

    Attributes:
        faults: The faults of the files that :meth:`load` found damaged.
    """

    def __init__(self, folder: Path, identity: Mapping[str, object]) -> None:
        self.folder = folder
        self.faults: dict[Path, str] = {}
        self._identity = dict(identity)

    def path(self, label: str, integrator: str, level: str, round: int, seed: int) -> Path:
        """The file of a run.

        Args:
            label: The integrator's label, which makes the name readable.
            integrator: The integrator's identity: everything on which its images depend.
            level: The level with its unit (``64spp``, ``10s``).
            round, seed: Round and seed of the run.
        """
        identity = {**self._identity, "integrator": integrator, "level": level, "round": round,
                    "seed": seed}
        key = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode())
        name = f"{marks.readable(label)}_{level}_seed{seed}_{key.hexdigest()[:12]}.exr"
        return self.folder / name

    def load(self, path: Path) -> Run | None:
        """A run finished earlier; ``None`` if its file is missing, damaged or of another run."""
        if not path.is_file():
            return None
        try:
            channels, metadata = image_files.read_exr(path)
            if fault := image_files.fault_of(channels, metadata):
                raise InputError(fault)
            if metadata.get("file") != path.name:
                raise InputError("it is another run, renamed")
            run = Run(**json.loads(str(metadata["run"])), path=path)
        except (KeyError, TypeError, ValueError) as error:
            self.faults[path] = str(error).removeprefix(f"{path}: ")
            return None
        run.timed_again = _read_times(path.with_suffix(_TIMES))
        return run

    def save(
        self, run: Run, image: np.ndarray, path: Path, metadata: Mapping[str, object]
    ) -> Run:
        """Writes a run, and returns it with its path."""
        header = {**metadata, "spp": run.spp, "seed": run.seed, "seconds": run.seconds,
                  "run": json.dumps(run.record()), "file": path.name}
        image_files.write_exr(path, image, "RGB", header)
        return replace(run, path=path)

    def add_time(self, run: Run, seconds: float) -> None:
        """Stores the time of a run repeated in this session."""
        run.timed_again[marks.SESSION] = seconds
        with replacing(run.path.with_suffix(_TIMES)) as temporary:
            times = json.dumps(run.timed_again)
            temporary.write_text(json.dumps([_checksum(times), times]), encoding="utf-8")


def _read_times(path: Path) -> dict[str, float]:
    """Times of other sessions; empty if the file is missing or damaged."""
    try:
        checksum, times = json.loads(path.read_text(encoding="utf-8"))
        return json.loads(times) if checksum == _checksum(times) else {}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
