"""Speed against error: the same scene with several integrators, under equal conditions.

- Every integrator gets the scene's ``max_depth`` and ``rr_depth`` unless its specification says
  otherwise: they solve the same problem.
- Kernels are compiled beforehand, by a small render. A measured run that had to compile after all
  (a size of pass that the small one did not have) is thrown away and repeated.
- The integrators take turns (A B C A B C …), one round per seed: a machine that becomes slower
  becomes so for all of them.
- The clock runs around the whole of ``render()``, what it learns included, and stops when the
  image is there.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from ..scenes import InputError, LoadedScene, Value, make_integrator, one_line, parse_integrator
from . import images, metrics
from .references import Reference
from .timing import Timed, sample_count, timed_render


@dataclass
class Run:
    """One measured render.

    Attributes:
        seed: Its seed.
        spp: Samples per pixel that were taken.
        seconds: Wall clock of the render, learning included, compilation excluded.
        image: The image, (height, width, 3).
        errors: Against the reference.
        rays: Rays traced by kind (``camera``, ``scatter``, ``shadow``), empty if not known.
        connections: Connections to lights that were considered (``path`` traces a shadow ray for
            each), ``None`` if not known.
        zero_radiance: Share of the camera samples without radiance, ``None`` if not known.
        memory: Bytes, ``None`` if not known.
    """

    seed: int
    spp: int
    seconds: float
    image: np.ndarray
    errors: metrics.Errors
    rays: dict[str, int]
    connections: int | None
    zero_radiance: float | None
    memory: int | None


@dataclass
class Contender:
    """An integrator of an experiment, and its runs.

    Attributes:
        label: The specification as it was given.
        name: Plugin name.
        parameters: All parameters that it was made with, the scene's depth included.
        runs: One per seed, in the order of the seeds.
        compile_seconds: What the kernels cost to compile or to load, without tracing.
        error: Why there are no (more) runs; empty if all went well.
    """

    label: str
    name: str
    parameters: dict[str, Value]
    integrator: object = field(repr=False)
    runs: list[Run] = field(default_factory=list)
    compile_seconds: float = 0.0
    error: str = ""

    def figures(self, name: str) -> list[float]:
        """The values of one figure over the seeds: a field of :class:`metrics.Errors` or of
        :class:`Run`."""
        return [
            getattr(run.errors if hasattr(run.errors, name) else run, name) for run in self.runs
        ]

    @property
    def efficiency(self) -> float | None:
        """1 / (mean relMSE · median seconds); ``None`` where the error drowns in the reference's
        noise, or something failed."""
        if self.error or not self.runs:
            return None
        relmse = statistics.fmean(self.figures("relmse"))
        return 1 / (relmse * statistics.median(self.figures("seconds"))) if relmse > 0 else None


class Experiment:
    """Renders one scene with several integrators and measures them against a reference.

    Args:
        scene: The scene; its own integrator matters only for the depth that the others take over.
        specifications: Integrators as ``name`` or ``name:key=value,key=value``.
        spp: Samples per pixel of each run.
        seeds: One run of each integrator per seed.

    Raises:
        InputError: An integrator is unknown, rejects a parameter, or is given twice.
    """

    def __init__(
        self,
        scene: LoadedScene,
        specifications: Sequence[str],
        spp: int,
        seeds: Iterable[int] = range(3),
    ) -> None:
        if len(set(specifications)) < len(specifications):
            raise InputError("an integrator is given twice: more runs of it need more --seeds")
        self.scene = scene
        self.spp = spp
        self.seeds = list(seeds)
        self._reference: Reference | None = None
        self.contenders = []
        for text in specifications:
            name, own = parse_integrator(text)
            integrator, parameters = make_integrator(name, own, inherited=scene.depth)
            self.contenders.append(Contender(text, name, parameters, integrator))

    @property
    def reference(self) -> Reference:
        """What :meth:`run` measured against."""
        if self._reference is None:
            raise ValueError("there is no reference before run() is called")
        return self._reference

    @property
    def step_count(self) -> int:
        """How often :meth:`run` calls ``progress``."""
        return len(self.contenders) * (1 + len(self.seeds))

    def run(
        self,
        reference: Reference,
        progress: Callable[[str], None] = lambda _label: None,
        finished: Callable[[int, Contender, Run], None] = lambda _index, _contender, _run: None,
    ) -> None:
        """Measures everything. The results are in :attr:`contenders`, also after an interruption.

        Args:
            reference: What the errors are measured against.
            progress: Called after each warm-up and each run, with the integrator's label.
            finished: Called after each run, with the contender's index.
        """
        self._reference = reference
        # The kernel for one sample per pixel differs from that for many, and that for a power of
        # two from that for other counts (Mitsuba divides the index of a sample by the count).
        warm_up_spp = 1 if self.spp == 1 else 2 if self.spp & (self.spp - 1) == 0 else 3
        for contender in self.contenders:
            self._attempt(contender, lambda c=contender: self._timed(c, 0, warm_up_spp))
            progress(contender.label)
        for seed in self.seeds:
            for index, contender in enumerate(self.contenders):
                if not contender.error:
                    run = self._attempt(contender, lambda c=contender, s=seed: self._measure(c, s))
                    if run is not None:
                        contender.runs.append(run)
                        finished(index, contender, run)
                progress(contender.label)

    def efficiency_ratio(self, contender: Contender) -> float | None:
        """Efficiency relative to the first integrator."""
        first, own = self.contenders[0].efficiency, contender.efficiency
        return own / first if own is not None and first is not None else None

    def _attempt(self, contender: Contender, action: Callable[[], object]):
        """One integrator that fails must not take the others' results with it."""
        try:
            return action()
        except (ValueError, RuntimeError, TypeError) as error:
            contender.error = one_line(error)
            return None

    def _measure(self, contender: Contender, seed: int) -> Run:
        timed = self._timed(contender, seed, self.spp)
        if timed.compiled:
            timed = self._timed(contender, seed, self.spp)
        pixels = images.to_rgb(timed.image)
        if fault := metrics.describe_non_finite(pixels):
            raise ValueError(f"seed {seed}: {fault}")
        reference = self.reference
        report = getattr(contender.integrator, "statistics", None)
        return Run(
            seed=seed,
            spp=report.spp if report else sample_count(self.scene.scene, self.spp),
            seconds=timed.seconds,
            image=pixels,
            errors=metrics.errors(pixels, reference.mean, reference.variance),
            rays=dict(report.rays) if report else {},
            connections=report.connections if report else None,
            zero_radiance=report.zero_radiance if report else None,
            memory=report.memory if report else None,
        )

    def _timed(self, contender: Contender, seed: int, spp: int) -> Timed:
        timed = timed_render(contender.integrator, self.scene.scene, seed, spp)
        contender.compile_seconds += timed.compile_seconds
        return timed


def spread(values: Sequence[float]) -> dict[str, float]:
    """Mean, standard deviation (0 for one value) and median over the seeds."""
    return {
        "mean": statistics.fmean(values),
        "std": statistics.stdev(values) if len(values) > 1 else 0.0,
        "median": statistics.median(values),
    }


def run_record(run: Run) -> dict[str, object]:
    """A run without its image, for JSON."""
    record = {key: value for key, value in vars(run).items() if key not in ("image", "errors")}
    return {**record, **asdict(run.errors)}
