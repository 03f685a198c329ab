"""Remarks on figures that could not be measured or may mislead."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence

from .contenders import Contender
from .experiment import TIME_TOLERANCE, Experiment
from .references import Reference
from .runs import Run

#: The maximum relMSE of a reference, as a fraction of the error that it is to measure.
_NOISE_LIMIT = 0.5

#: The ratio of relMSE to trimmed relMSE above which a note warns of fireflies.
_FIREFLY_RATIO = 1.5


def warnings(experiment: Experiment) -> list[str]:
    """Remarks about a scene and its reference."""
    return list(_warnings(experiment))


def notes(experiment: Experiment, contender: Contender) -> list[str]:
    """Remarks about the runs of one integrator."""
    return [*contender.notes, *_notes(experiment, contender)]


def refusal(reference: Reference | None, runs: Sequence[Run]) -> str:
    """Why this reference cannot measure the errors of a level; empty if it can."""
    noise = reference.noise if reference else None
    if noise is None or not runs:
        return ""
    error = sum(run.errors.relmse for run in runs) / len(runs)
    if noise <= _NOISE_LIMIT * error:
        return ""
    text = f"the reference is too noisy: its own relMSE is {noise:.2g}, "
    text += f"the error {error:.2g}" if error > 0 else "the error less than that"
    if reference.spp:
        # Samples for a noise of 1/16 of the error, but at most 256 times the present number
        needed = reference.spp * 16 * noise / max(error, noise / 16)
        text += f"; needs --reference-spp {1 << math.ceil(math.log2(needed))}"
    return text


def _warnings(experiment: Experiment) -> Iterator[str]:
    scene, reference = experiment.scene, experiment.reference
    yield from experiment.remarks
    sensor_count = experiment.sensor_count
    if sensor_count > 1:
        yield f"the scene has {sensor_count} sensors: the first is used"
    yield from _sessions(experiment)
    if reference is None:
        return
    if reference.variance is None:
        yield "the variance of the reference is unknown: its noise is part of the errors"
    metadata = reference.metadata
    rendered = metadata.get("content_hash")
    if rendered is not None and rendered != scene.content_hash:
        yield (
            f"the reference was rendered from another scene, or from another version of this one: "
            f"{metadata.get('scene')}"
        )
    claimed = {**_parsed(metadata.get("parameters")), **metadata}.get("max_depth")
    actual = scene.settings.get("max_depth")
    if isinstance(claimed, int) and actual is not None and claimed != actual:
        yield f"the reference has max_depth {claimed}, the scene {actual}"


def _sessions(experiment: Experiment) -> Iterator[str]:
    """Warnings about runs from different sessions."""
    first, *others = experiment.contenders
    all_runs = [run for contender in experiment.contenders for run in contender.runs]
    if len({run.session for run in all_runs}) < 2:
        return
    repeated = [c.label for c in experiment.contenders if any(run.timed_again for run in c.runs)]
    yield (
        "the runs are from different sessions, between which the speed of the machine may have "
        "changed: ratios of times and of efficiencies use times of one session"
        + (f" (timed again for that: {', '.join(repeated)})" if repeated else "")
        + "; seconds come from each run's own session"
    )
    for contender in others:
        partners = {(run.level, run.round): run for run in first.runs}
        pairs = [(run, partners.get((run.level, run.round))) for run in contender.runs]
        if any(other and not run.times.keys() & other.times.keys() for run, other in pairs):
            yield (
                f"{contender.label} and {first.label} have no times of a common session in some "
                f"rounds: the ratios omit these rounds; running the same command adds them"
            )


def _notes(experiment: Experiment, contender: Contender) -> Iterator[str]:
    budget = experiment.budget
    if budget.is_time:
        wanted = budget.values[0]
        missed = [r for r in contender.runs if abs(r.seconds / wanted - 1) > TIME_TOLERANCE]
        if missed:
            yield (
                f"{len(missed)} of {len(contender.runs)} runs missed the time of {wanted:g} s by "
                f"more than {TIME_TOLERANCE:.0%}"
            )
    for level in contender.levels()[-1:]:
        errors = [run.errors for run in contender.at(level)]
        relmse = sum(e.relmse for e in errors)
        trimmed = sum(e.relmse_trimmed for e in errors)
        if relmse > _FIREFLY_RATIO * trimmed > 0:
            yield (
                f"at {level:g} {'s' if budget.is_time else 'spp'}, 0.1 % of the pixels make up "
                f"{1 - trimmed / relmse:.0%} of relMSE: its interval is too narrow; trimmed relMSE "
                f"is more reliable"
            )
    if budget.target and len(contender.levels()) == 1 and not contender.error:
        yield "reached the error at the first level: the cost shown is an upper bound"


def _parsed(parameters: object) -> dict[str, object]:
    try:
        value = json.loads(str(parameters))
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
