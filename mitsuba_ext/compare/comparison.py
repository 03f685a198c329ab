"""Compares several integrators on several scenes, with references, runs, ``results.json`` and
report in one folder. A comparison restarted in its folder renders only what is missing."""

from __future__ import annotations

import contextlib
import datetime
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union

import drjit as dr
import mitsuba as mi

from ..images import image_files, metrics
from ..inputs.scene_changes import UNCHANGED, SceneChanges
from ..inputs.scene_remarks import scene_remarks
from ..inputs.scenes import LoadedScene, check_source, load_scene, scene_name
from ..inputs.specifications import NamedIntegrator, Specification, make_named
from ..startup.machine import machine, versions
from ..util.errors import InputError
from ..util.files import replacing
from ..util.marks import REFERENCES, in_use
from . import references, results, timing
from .budgets import Budget
from .contenders import make_all
from .experiment import Experiment, Watch
from .notebook import Results
from .progress import Step, reporting
from .reference_choice import choose_integrator
from .references import Reference
from .report import write_report

if TYPE_CHECKING:
    from ..long_renders.divided_references import ReferenceWorkers

SceneSource = Union[str, Path, Mapping[str, Any]]

#: The samples of a reference, as a multiple of the samples of the longest run.
_REFERENCE_FACTOR = 16


@dataclass(frozen=True)
class SceneSetup:
    """A scene of a comparison, with settings for this scene only.

    Attributes:
        source: An XML file, or a dict for ``mi.load_dict``. Its integrator is replaced.
        size: Width and height that replace the film's.
        parameters: Values for the ``$name`` placeholders of the file.
        reference: The file of its reference. By default, a reference is rendered.
        changes: Other changes to the scene.
    """

    source: SceneSource
    size: tuple[int, int] | None = None
    parameters: Mapping[str, object] | None = None
    reference: str | Path | None = None
    changes: SceneChanges = UNCHANGED


class Comparison:
    """Compares integrators on scenes.

    Args:
        scenes: XML files, dicts, or :class:`SceneSetup` objects of these.
        integrators: Specifications (:func:`mitsuba_ext.inputs.specifications.make_named`), or a
            mapping of labels to them. Ratios are given relative to the first.
        budget: The samples, seconds or error of each run; see :mod:`.budgets`.
        seeds: The number of runs of each integrator at each level.
        folder: The folder for ``results.json``, ``report.html``, images and references; made if
            missing. Stored runs and references are reused. By default, a temporary folder that is
            deleted with the object.
        reference_spp: Samples per pixel of rendered references. By default, 16 times the samples of
            the longest run; with a time budget, as many as take 16 times as long; with ``until``,
            enough for a relMSE of 1/16 of the target.
        reference_integrator: The integrator that renders references. By default, ``path``, unless
            it cannot render everything in the scene (:mod:`.reference_choice`).
        reference_workers: The workers that render references. By default, this process. Measured
            runs are rendered in this process, one at a time, because times on other machines or
            shared cores are not comparable.
        command: The command line, for the report.
        only_stored: Whether to render nothing, and make figures and report from the stored runs.
        with_reference: Whether to measure errors against a reference. Without one, errors are the
            variance between seeds, which does not include bias.
        cpu_time: Whether to measure the CPU time of all threads instead of the wall clock. Other
            programs on the machine hardly change it.
        warn: A function that is called with each remark about a scene, its reference and its stored
            runs as soon as it is known; the results also hold the remarks.
        watch: A function that is called after each run with the name of its image, which names the
            scene if there are several, and with all runs of its integrator at its level.

    Raises:
        InputError: No scene was given, an integrator cannot be made, ``budget`` is not a
            :class:`Budget`, ``seeds`` is below 1 (3 without a reference), ``until`` has no
            reference, the variant is scalar, CPU time is requested without an LLVM variant, or the
            folder has no name.
    """

    def __init__(
        self,
        scenes: SceneSource | SceneSetup | Sequence[SceneSource | SceneSetup],
        integrators: Sequence[Specification] | Mapping[str, Specification],
        budget: Budget,
        seeds: int = 3,
        folder: str | Path | None = None,
        reference_spp: int | None = None,
        reference_integrator: Specification | None = None,
        command: str | None = None,
        only_stored: bool = False,
        with_reference: bool = True,
        cpu_time: bool = False,
        reference_workers: ReferenceWorkers | None = None,
        warn: Callable[[str], None] = lambda remark: None,
        watch: Watch | None = None,
    ) -> None:
        self.only_stored = only_stored
        self.scenes = _setups(scenes)
        if not isinstance(seeds, int) or seeds < 1:
            raise InputError(f"at least 1 seed is needed, found {seeds!r}")
        if not dr.is_jit_v(mi.Float):
            raise InputError(
                f'comparisons do not work in the variant "{mi.variant()}": select one that starts '
                f'with "llvm" or "cuda"'
            )
        if not isinstance(budget, Budget):
            raise InputError(
                f"the budget must be made by equal_samples(64), equal_time(10), sweep([4, 16, 64]) "
                f"or until(0.01) of mitsuba_ext.compare, found {budget!r}"
            )
        if not with_reference and (budget.target or seeds < metrics.MIN_SEEDS):
            raise InputError(
                f"without a reference, errors are the variance between seeds: this needs at least "
                f"{metrics.MIN_SEEDS} seeds, and a budget of samples or time"
            )
        if cpu_time and not mi.variant().startswith("llvm"):
            raise InputError(f'CPU time needs an LLVM variant, found "{mi.variant()}"')
        make_all(integrators)  # to report an unknown name before a reference is rendered
        is_needed = with_reference and not all(setup.reference for setup in self.scenes)
        if reference_integrator is not None and is_needed:
            make_named(reference_integrator)
        self.integrators = integrators
        self.budget = budget
        self.seeds = seeds
        self.command = command
        self._with_reference = with_reference
        self._cpu_time = cpu_time
        self._reference_spp = reference_spp
        self._reference_integrator = reference_integrator
        self._reference_workers = reference_workers
        self._warn, self._watch = warn, watch
        self._temporary = None
        if folder is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="mitsuba_ext_")
            folder = self._temporary.name
        if not str(folder).strip():
            raise InputError("the name of the folder is empty")
        self.folder = Path(folder)
        self._records: list[dict[str, object]] = []
        self._running: tuple[str, Experiment] | None = None
        self.is_finished = False

    def run(self, progress: bool | Callable[[Step], None] = True) -> Results:
        """Measures everything, writes ``results.json`` and ``report.html``, returns the results.

        After Ctrl-C, it writes both files from the finished runs and raises the exception again.

        Args:
            progress: ``True`` shows a bar on a terminal, and otherwise writes a line to stderr
                every half minute; ``False`` shows nothing; a function is called before each step.

        Raises:
            InputError: The only scene or its reference cannot be used (with several scenes, the
                results record the error instead); another comparison is running in the folder; or
                the folder cannot be made.
        """
        self._records, self.is_finished = [], False
        with in_use(self.folder), reporting(progress) as report_step:
            self._run(report_step)
        return self.results()

    def _run(self, progress: Callable[[Step], None]) -> None:
        try:
            for setup in self.scenes:
                if self._records:
                    self.write()
                name = self._unique_name(setup.source)
                try:
                    self._run_scene(setup, name, progress)
                except InputError as error:
                    if len(self.scenes) == 1:
                        raise
                    self._records.append(_failed_record(name, setup.source, str(error)))
            self.is_finished = not self.only_stored
        finally:
            if self._running:
                self._keep_record()
            if self._records:
                self.write()

    def results(self) -> Results:
        """The content of ``results.json``; see :mod:`.results`."""
        content = {
            "schema": results.SCHEMA,
            "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "command": self.command,
            "state": "finished" if self.is_finished else "interrupted",
            "budget": {"kind": self.budget.kind, "values": self.budget.values},
            "errors": "to the reference" if self._with_reference else "between seeds",
            "clock": "cpu" if self._cpu_time else "wall",
            "seeds": self.seeds,
            "scenes": self._records,
            "versions": versions(),
            "machine": machine(),
        }
        return Results(results.clean(content), self.folder)

    def _repr_html_(self) -> str | None:
        """For notebooks: the results, or ``None`` before the first measurement."""
        return self.results()._repr_html_() if self._records else None

    def write(self) -> None:
        """Writes ``results.json`` and ``report.html``."""
        text = json.dumps(self.results(), indent=2)
        with replacing(self.folder / "results.json") as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
        write_report(self.folder)

    def _run_scene(self, setup: SceneSetup, name: str, progress: Callable[[Step], None]) -> None:
        scene = load_scene(
            setup.source, setup.size, setup.parameters, keep_integrator=False,
            changes=setup.changes,
        )  # fmt: skip
        experiment = Experiment(
            scene, self.integrators, self.budget, self.seeds, self.folder / name, self.only_stored,
            self._cpu_time, self._warn, self._watch and self._shown(name),
        )  # fmt: skip

        def report_step(step: Step) -> None:
            count = f" ({len(self._records) + 1} of {len(self.scenes)})" * (len(self.scenes) > 1)
            progress(step._replace(label=f"{name}{count}: {step.label}"))

        try:
            image_files.check_comparable(scene.scene.sensors()[0].film())
        except InputError as error:
            raise InputError(f"{scene.source}: {error}") from error
        reference = None
        if self._with_reference:
            reference = self._reference_of(setup, experiment, report_step)
            if reference is None:
                return
        self._running = (name, experiment)
        experiment.run(reference, report_step)
        self._keep_record()

    def _shown(self, scene: str) -> Watch:
        prefix = f"{scene}: " if len(self.scenes) > 1 else ""
        return lambda label, runs: self._watch(f"{prefix}{label}", runs)

    def _reference_of(
        self, setup: SceneSetup, experiment: Experiment, progress: Callable[[Step], None]
    ) -> Reference | None:
        if not setup.reference:
            return self._render_reference(experiment, progress)
        reference = references.load_reference(setup.reference, experiment.scene.size)
        self._remark_on_file(experiment, reference)
        return reference

    def _remark_on_file(self, experiment: Experiment, reference: Reference) -> None:
        """Adds remarks on a reference file given by the user."""
        if reference.fault not in ("", image_files.NO_CHECKSUM):
            experiment.remark(f"{reference.path}: {reference.fault}: it was damaged, or edited")
        # Its name only, because parameters can name files
        name = str(reference.metadata.get("integrator", "")).partition(":")[0]
        if name.isidentifier():
            with contextlib.suppress(InputError):  # a plugin that is not installed
                self._remark_on_integrator(experiment, make_named(name))

    def _remark_on_integrator(self, experiment: Experiment, named: NamedIntegrator) -> None:
        for remark in scene_remarks(experiment.scene, named.integrator, named.label):
            experiment.remark(f"the reference: {remark}")

    def _keep_record(self) -> None:
        """Adds the figures of the running scene to the results, and releases the scene."""
        name, experiment = self._running
        self._running = None
        record = {"name": name, **results.scene_record(experiment, self.folder)}
        if any(contender.runs or contender.error for contender in experiment.contenders):
            self._records.append(record)

    def _render_reference(
        self, experiment: Experiment, progress: Callable[[Step], None]
    ) -> Reference | None:
        scene, integrator = experiment.scene, self._reference_integrator
        if integrator is None:
            integrator, remarks = choose_integrator(scene)
            for remark in remarks:
                experiment.remark(remark)
        else:
            self._remark_on_integrator(experiment, make_named(integrator, scene.settings))
        folder = self.folder / REFERENCES
        folder.mkdir(exist_ok=True)
        if self.only_stored:
            return references.stored_reference(scene, folder, integrator)
        progress(Step("reference", 0.0, None))
        asked = self._reference_spp
        spp = asked or self._derived_spp(scene, integrator)
        return references.render_reference(
            scene,
            spp,
            folder,
            integrator,
            lambda done: progress(Step(f"reference {done:.0%}", 0.0, None)),
            # A derived number varies with the measured speed or noise, so a stored reference with
            # half as many samples is accepted
            enough=asked or spp // 2,
            workers=self._reference_workers,
            warn=experiment.remark,
        )

    def _derived_spp(self, scene: LoadedScene, specification: Specification) -> int:
        if self.budget.target:
            noise = self.budget.target / _REFERENCE_FACTOR
            needed = references.samples_for_noise(scene, noise, specification)
            return max(needed, _REFERENCE_FACTOR * int(self.budget.level(0)))
        if self.budget.is_time:
            integrator = make_named(specification, scene.settings).integrator
            seconds = _REFERENCE_FACTOR * self.budget.values[0]
            spp = timing.samples_for(seconds, integrator, scene.scene, references.FIRST_SEED)
            return max(references.MIN_BATCH_COUNT, 1 << round(math.log2(spp)))
        longest = int(max(self.budget.values))
        return max(references.MIN_BATCH_COUNT, _REFERENCE_FACTOR * longest)

    def _unique_name(self, source: SceneSource) -> str:
        name = scene_name(source)
        taken = {record["name"] for record in self._records} | {REFERENCES}
        candidates = [name] + [f"{name}-{number}" for number in range(2, len(self.scenes) + 3)]
        return next(candidate for candidate in candidates if candidate not in taken)


def _setups(scenes: Any) -> list[SceneSetup]:
    if isinstance(scenes, (str, Mapping)) or not isinstance(scenes, Iterable):
        scenes = [scenes]
    setups = [s if isinstance(s, SceneSetup) else SceneSetup(s) for s in scenes]
    if not setups:
        raise InputError("no scene was given")
    for setup in setups:
        check_source(setup.source)
    return setups


def _failed_record(name: str, source: SceneSource, error: str) -> dict[str, object]:
    return {
        "name": name,
        "path": None if isinstance(source, Mapping) else str(source),
        "parameters": {},
        "content_hash": "",
        "size": [],
        "settings": {},
        "error": error,
        "warnings": [],
        "reference": None,
        "integrators": [],
    }
