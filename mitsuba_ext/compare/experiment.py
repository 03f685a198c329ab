"""Measures the time and error of several integrators on one scene, under equal conditions.

- Errors are measured against a reference or, without one, between the seeds of each integrator.

- Every integrator gets the settings of the scene's own integrator (``max_depth``, ``rr_depth``,
  ``hide_emitters``) unless its specification sets them, so that all solve the same problem.
- Small renders compile the kernels beforehand. A measured run that still compiled a kernel (for a
  pass size that did not occur in the small renders) is discarded and repeated.
- With a time budget, integrators that learn plan for it (``timing.plans_for_time``). For others,
  the number of samples is computed from their speed.
- The integrators take turns (A B C A B C …), round by round, so that a slowdown of the machine
  affects all of them. Each round and each level has a separate seed, which the integrators share.
- Times are compared only within one session. A stored run of an earlier session is timed again (its
  image is kept) when a run of this session is compared with it.
- The measured time covers all of ``render()``, including learning, until the image is in memory.
"""

from __future__ import annotations

import traceback
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from ..images import image_files, metrics
from ..inputs.scene_remarks import scene_remarks
from ..inputs.scenes import LoadedScene
from ..inputs.specifications import Specification
from ..startup.machine import machine, versions
from ..util.errors import one_line
from ..util.marks import has_crashed, mark_of, marked, renew
from . import timing
from .budgets import Budget
from .contenders import Contender, make_all
from .progress import Step
from .references import Reference
from .runs import Run, RunFolder
from .zero_radiance import zero_radiance_share

#: Is shown the runs of an integrator: its label, and its runs at one level.
Watch = Callable[[str, Sequence[Run]], None]

#: With a time budget, the maximum relative deviation of a run's time, and the maximum number of
#: attempts: a run that misses its time is repeated with a corrected number of samples.
TIME_TOLERANCE = 0.05
_TIME_ATTEMPTS = 3

#: The maximum samples per pixel of ``until`` if the reference's file does not give its own.
_MAX_UNTIL_SPP = 1 << 16


class Experiment:
    """Renders one scene with several integrators and measures them.

    Args:
        scene: The scene. Only the settings of its own integrator are used.
        integrators: Specifications (:func:`mitsuba_ext.inputs.specifications.make_named`), or a
            mapping of labels to them. Ratios are relative to the first.
        budget: The samples, seconds or error of each run.
        rounds: The number of runs of each integrator at each level.
        folder: The folder that stores the runs; stored runs are not rendered again.
        only_stored: Whether to use only the stored runs and render nothing.
        cpu_time: Whether to measure the CPU time of all threads instead of the wall clock.
        warn: A function that is called with each sentence added to :attr:`remarks`.
        watch: A function that is called with the label of an integrator, and its runs at a level,
            after each of them; the time that it takes is not measured.

    Attributes:
        remarks: Remarks about the scene, its reference and the folder.

    Raises:
        InputError: An integrator is unknown, rejects a parameter, or is given twice.
    """

    def __init__(
        self,
        scene: LoadedScene,
        integrators: Sequence[Specification] | Mapping[str, Specification],
        budget: Budget,
        rounds: int,
        folder: Path,
        only_stored: bool = False,
        cpu_time: bool = False,
        warn: Callable[[str], None] = lambda remark: None,
        watch: Watch | None = None,
    ) -> None:
        self.only_stored = only_stored
        self._cpu_time = cpu_time
        self.remarks: list[str] = []
        self._warn, self._watch = warn, watch
        self.scene = scene
        self.budget = budget
        self.rounds = rounds
        self.contenders = [
            Contender(named) for named in make_all(integrators, inherited=scene.settings)
        ]
        self.reference: Reference | None = None
        self._film = scene.scene.sensors()[0].film()
        self.sensor_count = len(scene.scene.sensors())
        self._folder = RunFolder(
            folder,
            {
                "scene": scene.content_hash,
                "size": scene.size,
                "versions": versions(),
                "machine": machine(),
                **({"clock": "cpu"} if cpu_time else {}),
            },
        )
        self._progress: Callable[[Step], None] = lambda _step: None
        self._done = 0.0
        for contender in self.contenders:
            found = scene_remarks(scene, contender.named.integrator, contender.label)
            contender.notes += found
            for remark in found:
                warn(remark)

    def remark(self, sentence: str) -> None:
        """Adds a sentence to :attr:`remarks`."""
        self.remarks.append(sentence)
        self._warn(sentence)

    def run(
        self, reference: Reference | None, progress: Callable[[Step], None] = lambda _step: None
    ) -> None:
        """Measures everything. The results are in :attr:`contenders`, even after an interruption.

        Args:
            reference: The image against which errors are measured; ``None`` to measure between
                seeds.
            progress: A function that is called before each run.
        """
        self.reference = reference
        self._progress = progress
        schedule = self._schedule_until() if self.budget.target else self._schedule_levels()
        try:
            for contender, index, round in schedule:
                self._attempt(contender, lambda c=contender, i=index, r=round: self._take(c, i, r))
        finally:
            if reference is None:
                self._compare_seeds()

    # ---- Which run is next ----

    def _schedule_levels(self) -> Iterator[tuple[Contender, int, int]]:
        indices = range(len(self.budget.values))
        for contender in self.contenders:
            # Measure all speeds before the first long run, to estimate the remaining time
            paths = (self._path(contender, i, r) for i in indices for r in range(self.rounds))
            is_complete = all(self._folder.load(path) for path in paths)
            if not (is_complete or has_crashed(self._mark(contender)) or self.only_stored):
                self._attempt(contender, lambda c=contender: self._prepare(c))
        for round in range(self.rounds):
            for index in indices:
                for contender in self.contenders:
                    if not contender.error:
                        yield contender, index, round

    def _schedule_until(self) -> Iterator[tuple[Contender, int, int]]:
        limit = max(self.reference.spp or _MAX_UNTIL_SPP, self.budget.level(0))
        going = list(self.contenders)
        index = 0
        while going and self.budget.level(index) <= limit:
            for round in range(self.rounds):
                for contender in going:
                    if not contender.error:
                        yield contender, index, round
            going = [c for c in going if not c.error and not self._is_done(c, index)]
            index += 1
        for contender in going:
            runs = contender.at(self.budget.level(index - 1))
            contender.notes.append(
                f"error not reached: relMSE {_mean_error(runs):.3g} with {runs[0].spp} spp; "
                f"more samples than the reference has are not tried"
            )

    def _is_done(self, contender: Contender, index: int) -> bool:
        """Whether the error is reached. Also true without runs (with ``only_stored``)."""
        runs = contender.at(self.budget.level(index))
        return not runs or _mean_error(runs) <= self.budget.target

    # ---- One run ----

    def _attempt(self, contender: Contender, action: Callable[[], object]) -> None:
        """Calls ``action`` and records an error of the integrator, so that the others continue."""
        try:
            action()
        except (Exception, SystemExit) as error:  # an integrator may raise anything
            contender.error = one_line(error)
            contender.traceback = traceback.format_exc()

    def _take(self, contender: Contender, index: int, round: int) -> None:
        """Measures a run, or loads it from the folder."""
        path = self._path(contender, index, round)
        run = self._folder.load(path)
        if run is None:
            if self.only_stored:
                return
            if fault := self._folder.faults.get(path):
                self.remark(f"{path}: {fault}: the run is measured anew")
            self._prepare(contender)
            self._progress(Step(contender.label, self._done, self._seconds_left()))
            with marked(self._mark(contender)):
                run = self._measure(contender, index, round, path)
        if (reference := self.reference) is not None:
            run.errors = metrics.errors(run.image(), reference.mean, reference.variance)
        contender.runs.append(run)
        contender._pace = run.seconds / run.spp
        self._done += run.seconds
        if not self.only_stored:
            self._share_session(contender, run)
        if self._watch:
            self._watch(contender.label, contender.at(run.level))

    def _compare_seeds(self) -> None:
        """Measures the errors of all runs between the seeds of each integrator and level."""
        for level in {level for contender in self.contenders for level in contender.levels()}:
            groups = [runs for c in self.contenders if (runs := c.at(level))]
            count = sum(map(len, groups))
            mean = sum(run.image().astype(float) for runs in groups for run in runs) / count
            for runs in groups:
                found = metrics.errors_between_seeds([run.image() for run in runs], mean)
                for run, errors in zip(runs, found):
                    run.errors = errors

    def _share_session(self, contender: Contender, run: Run) -> None:
        """If a run and the first integrator's run of the same round were never timed in the same
        session, times them again in this one."""
        first = self.contenders[0]
        partner = next((r for r in first.at(run.level) if r.round == run.round), run)
        if partner.times.keys() & run.times.keys():
            return
        for other, stored in ((first, partner), (contender, run)):
            if not (stored.is_timed_now or other.error):
                self._attempt(other, lambda c=other, r=stored: self._time_again(c, r))

    def _time_again(self, contender: Contender, run: Run) -> None:
        """Renders a run of an earlier session again to measure its time in this session."""
        self._prepare(contender)
        label = f"{contender.label}: timing again"
        self._progress(Step(label, self._done, self._seconds_left()))
        with marked(self._mark(contender)):
            timed = self._render_compiled(contender, run.level, run.spp, run.seed)
        # If the integrator plans for the time, it took a different number of samples in that time
        self._folder.add_time(run, timed.seconds * run.spp / timed.spp)
        self._done += timed.seconds

    def _measure(self, contender: Contender, index: int, round: int, path: Path) -> Run:
        level, seed = self.budget.level(index), run_seed(index, round)
        timed = self._render(contender, level, seed)
        pixels = image_files.to_rgb(timed.image, image_files.film_channels(self._film))
        if fault := metrics.describe_non_finite(pixels):
            raise ValueError(f"seed {seed}: {fault}")
        report = timing.own_statistics(contender.named.integrator)
        run = Run(
            level=level,
            round=round,
            seed=seed,
            spp=timed.spp,
            seconds=timed.seconds,
            rays=dict(report.rays) if report else {},
            connections=report.connections if report else None,
            zero_radiance=report.zero_radiance if report else contender._zero_radiance,
            memory=timed.memory or None,
            launches=timed.launches,
            mean=float(pixels.mean(dtype=float)),
            learned=report.learned if report else "",
        )
        metadata = {
            "scene": self.scene.source,
            "content_hash": self.scene.content_hash,
            "integrator": contender.named.name,
            "parameters": contender.named.parameters,
            "versions": versions(),
        }
        return self._folder.save(run, pixels, path, metadata)

    def _render(self, contender: Contender, level: float, seed: int) -> timing.Timed:
        """Renders without compiling. With a time budget, adjusts the number of samples in a few
        attempts and returns the one whose time is closest."""
        spp = self._samples(contender, level)
        attempts: list[timing.Timed] = []
        while len(attempts) < _TIME_ATTEMPTS:
            timed = self._render_compiled(contender, level, spp, seed)
            if not self.budget.is_time:
                return timed
            attempts.append(timed)
            better = max(1, round(spp * level / timed.seconds))
            if abs(timed.seconds / level - 1) <= TIME_TOLERANCE or better == spp:
                break
            spp = better
        return min(attempts, key=lambda timed: abs(timed.seconds - level))

    def _render_compiled(
        self, contender: Contender, level: float, spp: int, seed: int
    ) -> timing.Timed:
        """Renders ``spp`` samples; with a time budget, renders for the time ``level`` if the
        integrator plans for it."""
        timed = self._timed(contender, level, spp, seed)
        return self._timed(contender, level, spp, seed) if timed.compiled else timed

    def _prepare(self, contender: Contender) -> None:
        """Compiles the kernels of the runs and measures the speed of the integrator."""
        if contender._is_prepared:
            return
        with marked(self._mark(contender)):
            self._warm_up(contender)
        contender._is_prepared = True

    def _warm_up(self, contender: Contender) -> None:
        self._progress(Step(f"{contender.label}: compiling", self._done, None))
        integrator = contender.named.integrator
        counts = () if self.budget.is_time else self._counts()
        # One sample per pixel, powers of two and other counts have different kernels (Mitsuba
        # divides the index of a sample by the count): compile each kind that occurs
        kinds = sorted({1 if n == 1 else 2 if n & (n - 1) == 0 else 3 for n in counts})
        for spp in kinds:
            self._timed(contender, 0, spp, seed=0)
        level = self.budget.values[0]
        contender._plans = (  # by the wall clock
            self.budget.is_time and not self._cpu_time
            and timing.plans_for_time(integrator, self.scene.scene)
        )  # fmt: skip
        if self.budget.is_time and not contender._plans:
            spp = timing.samples_for(
                level, integrator, self.scene.scene, run_seed(0, 0), cpu_time=self._cpu_time
            )
            contender._pace = level / spp
        else:
            timed = self._timed(contender, level, kinds[-1] if kinds else 0, seed=0)
            contender._pace = timed.seconds / timed.spp
        if timing.own_statistics(integrator) is None:
            contender._zero_radiance = zero_radiance_share(integrator, self.scene.scene, seed=0)

    def _timed(self, contender: Contender, level: float, spp: int, seed: int) -> timing.Timed:
        renew(self._mark(contender))
        integrator, scene = contender.named.integrator, self.scene.scene
        if contender._plans:
            timed = timing.render_for(level, integrator, scene, seed)
        else:
            timed = timing.timed_render(integrator, scene, seed, spp, cpu_time=self._cpu_time)
        contender.compile_seconds += timed.compile_seconds
        return timed

    # ---- Numbers ----

    def _counts(self) -> list[int]:
        """The samples per pixel of the levels that are known beforehand."""
        if self.budget.kind == "until":
            return [int(self.budget.level(0))]
        return [int(value) for value in self.budget.values]

    def _samples(self, contender: Contender, level: float) -> int:
        return max(1, round(level / contender._pace)) if self.budget.is_time else int(level)

    def _seconds_left(self) -> float | None:
        """The estimated time of the missing runs, in seconds; ``None`` for ``until``."""
        if self.budget.kind == "until":
            return None
        left = 0.0
        for contender in self.contenders:
            if contender.error or contender._pace is None:
                continue
            have = {(run.level, run.round) for run in contender.runs}
            for level in self.budget.values:
                missing = sum((level, round) not in have for round in range(self.rounds))
                left += missing * (level if self.budget.is_time else level * contender._pace)
        return left

    # ---- The folder ----

    def _mark(self, contender: Contender) -> Path:
        return mark_of(self._folder.folder, contender.label)

    def _path(self, contender: Contender, index: int, round: int) -> Path:
        level = f"{self.budget.level(index):g}{'s' if self.budget.is_time else 'spp'}"
        named = contender.named
        return self._folder.path(
            named.label, named.identity, level, round, run_seed(index, round)
        )


def run_seed(index: int, round: int) -> int:
    """The seed of a run of the ``index``-th level. It is a hash because, at seed s + ``spp``,
    Mitsuba's stratified samplers give a pixel the strata of its neighbour at seed s. It has 31
    bits, to fit into an integer attribute of an EXR."""
    return zlib.crc32(f"level {index}, round {round}".encode()) >> 1


def _mean_error(runs: Sequence[Run]) -> float:
    return sum(run.errors.relmse for run in runs) / len(runs) if runs else float("inf")
