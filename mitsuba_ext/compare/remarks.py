"""What a reader of the figures must know: where they cannot be given, or are not what they seem."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence

from .experiment import TIME_TOLERANCE, Contender, Experiment
from .references import Reference
from .runs import Run

#: A reference whose own relMSE is more than this share of an error is too noisy to measure it.
_NOISE_LIMIT = 0.5

#: Where relMSE is so many times the trimmed relMSE, a thousandth of the pixels decides it.
_FIREFLIES = 1.5


def warnings(experiment: Experiment) -> list[str]:
    """About a scene and its reference."""
    return list(_warnings(experiment))


def notes(experiment: Experiment, contender: Contender) -> list[str]:
    """About the runs of one integrator."""
    return [*contender.notes, *_notes(experiment, contender)]


def refusal(reference: Reference | None, runs: Sequence[Run]) -> str:
    """Why the errors of a level cannot be told with this reference; empty if they can."""
    noise = reference.noise if reference else None
    if noise is None or not runs:
        return ""
    error = sum(run.errors.relmse for run in runs) / len(runs)
    if noise <= _NOISE_LIMIT * error:
        return ""
    text = f"the reference is too noisy: its own relMSE is {noise:.2g}, "
    text += f"the error {error:.2g}" if error > 0 else "the error less than that"
    if reference.spp:
        # Sixteen times less noise than error; an error that is not known is at most the noise
        needed = reference.spp * 16 * noise / max(error, noise / 16)
        text += f"; needs --reference-spp {1 << math.ceil(math.log2(needed))}"
    return text


def _warnings(experiment: Experiment) -> Iterator[str]:
    scene, reference = experiment.scene, experiment.reference
    sensor_count = experiment.sensor_count
    if sensor_count > 1:
        yield f"the scene has {sensor_count} sensors: the first is used"
    if reference is None:
        return
    if reference.variance is None:
        yield "the variance of the reference is unknown: its noise is part of the errors"
    metadata = reference.metadata
    rendered = metadata.get("content_hash")
    if rendered is not None and rendered != scene.content_hash:
        yield f"the reference is of another scene, or state of the scene: {metadata.get('scene')}"
    claimed = {**_parsed(metadata.get("parameters")), **metadata}.get("max_depth")
    actual = scene.settings.get("max_depth")
    if isinstance(claimed, int) and actual is not None and claimed != actual:
        yield f"the reference has max_depth {claimed}, the scene {actual}"
    yield from _sessions(experiment)


def _sessions(experiment: Experiment) -> Iterator[str]:
    """About runs between which the machine may have changed."""
    first, *others = experiment.contenders
    all_runs = [run for contender in experiment.contenders for run in contender.runs]
    if len({run.session for run in all_runs}) < 2:
        return
    repeated = [c.label for c in experiment.contenders if any(run.timed_again for run in c.runs)]
    yield (
        "runs of different sessions, between which the machine may have become faster or slower: "
        "ratios of times and efficiencies compare times of one session"
        + (f" (timed again for that: {', '.join(repeated)})" if repeated else "")
        + "; seconds are those of each run's own session"
    )
    for contender in others:
        partners = {(run.level, run.round): run for run in first.runs}
        pairs = [(run, partners.get((run.level, run.round))) for run in contender.runs]
        if any(other and not run.times.keys() & other.times.keys() for run, other in pairs):
            yield (
                f"{contender.label} and {first.label} have no times of one session in some rounds, "
                f"which are left out of the ratios: the same command adds them"
            )


def _notes(experiment: Experiment, contender: Contender) -> Iterator[str]:
    budget = experiment.budget
    if budget.is_time:
        wanted = budget.values[0]
        missed = [r for r in contender.runs if abs(r.seconds / wanted - 1) > TIME_TOLERANCE]
        if missed:
            yield (
                f"{len(missed)} of {len(contender.runs)} runs took another time than {wanted:g} s "
                f"by more than {TIME_TOLERANCE:.0%}"
            )
    for level in contender.levels()[-1:]:
        errors = [run.errors for run in contender.at(level)]
        relmse = sum(e.relmse for e in errors)
        trimmed = sum(e.relmse_trimmed for e in errors)
        if relmse > _FIREFLIES * trimmed > 0:
            yield (
                f"at {level:g} {'s' if budget.is_time else 'spp'}, 0.1 % of the pixels make up "
                f"{1 - trimmed / relmse:.0%} of relMSE: its interval is too narrow, and trimmed "
                f"relMSE says more"
            )
    if budget.target and len(contender.levels()) == 1 and not contender.error:
        yield "reached with the first number of samples: the cost is at most that"


def _parsed(parameters: object) -> dict[str, object]:
    try:
        value = json.loads(str(parameters))
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
