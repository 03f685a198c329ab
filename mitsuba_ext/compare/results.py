"""The figures of a comparison as one JSON object, ``results.json``; tables and reports read it.

Paths are relative to the folder of ``results.json`` where they are inside it. ``F`` stands for
``{"value", "low", "high"}``: an estimate with its 95 % confidence interval over the rounds (the
bounds are null for a single one), or null where there is none. Other unknown numbers are null too::

    schema     2
    date       ISO 8601, UTC
    command    the command line; null from the API
    state      "finished", or "interrupted": some runs are missing
    budget     kind ("spp", "time", "sweep" or "until"), values
    errors     "to the reference", or "between seeds": these are variances, which lack bias
    clock      "wall", or "cpu": seconds are CPU time of all threads
    seeds      runs wanted for each integrator and level
    scenes     a list:
        name, path (null for a scene from a dict), parameters, content_hash, size [width, height],
        settings {max_depth, rr_depth,
        hide_emitters}: what the integrators took over from the scene's own
        error      why the scene could not be measured; empty if it could
        warnings   a list
        reference  path, noise (its own relMSE), spp, integrator, seconds, metadata; null if there
                   is none
        integrators  a list, in the order of the command line:
            label, name, parameters
            error            why it failed; empty if it did not
            traceback        where in Python
            notes            a list
            compile_seconds  of this session: small where the kernels were compiled before, for
                             another integrator or in an earlier session
            runs             a list: level (samples, or seconds), round, seed, spp, seconds,
                             relmse, relmse_trimmed, relmse_worst, mse, rmse, sigma_mu, flip,
                             mean (of the image), learned (a sentence, or empty),
                             rays {camera, scatter, shadow}, connections, zero_radiance,
                             memory (bytes), launches, session, image, timed_again (seconds of
                             the same render in later sessions, by session)
            levels           a list:
                level, run_count
                refused      why the errors are not given: the reference is too noisy for them
                figures      F of spp, seconds (median), relmse, relmse_trimmed, relmse_worst, mse,
                             rmse, sigma_mu, flip, mean, rays, rays_camera, rays_scatter,
                             rays_shadow,
                             shadow_share (shadow rays traced / those that path would trace),
                             zero_radiance, memory, launches,
                             efficiency (1 / (mean relMSE · median seconds))
                ratios       F of seconds, relmse, relmse_trimmed, relmse_worst, mean, efficiency,
                             efficiency_trimmed (by the trimmed relMSE), to the first integrator at
                             the same level; ratios of times are from rounds in which both have
                             a time of one session
            slopes           F of log relMSE against log spp ("spp") and log seconds ("seconds")
            target           F of the spp and seconds that the relMSE of "until" costs; else null.
                             (The runs stop at the first level whose mean relMSE is small enough.
                             Noise can make that a little too early.)
    versions   mitsuba_ext, mitsuba, drjit, variant, numpy, python
    machine    system, processor, cores

Seconds include learning but not compilation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import intervals, remarks
from .contenders import Contender
from .experiment import Experiment
from .intervals import Estimate
from .references import Reference
from .runs import Run

SCHEMA = 2

#: The number of last levels from which the cost of reaching the error of ``until`` is estimated.
_FITTED_LEVELS = 4

_RELATIVE_ERRORS = ("relmse", "relmse_trimmed", "relmse_worst")
_ERRORS = (*_RELATIVE_ERRORS, "mse", "rmse", "sigma_mu", "flip")
_OTHERS = ("mean", "spp", "ray_count", "shadow_share", "zero_radiance", "memory", "launches")
_NAMES = {"ray_count": "rays"}
_EFFORTS = ("spp", "seconds")


def scene_record(experiment: Experiment, folder: Path) -> dict[str, object]:
    """All figures of one scene."""
    scene, reference = experiment.scene, experiment.reference
    return {
        "path": None if scene.path is None else str(scene.path),
        "parameters": scene.parameters,
        "content_hash": scene.content_hash,
        "size": list(scene.size),
        "settings": scene.settings,
        "error": "",
        "warnings": remarks.warnings(experiment),
        "reference": None if reference is None else _reference_record(reference, folder),
        "integrators": [
            _contender_record(experiment, contender, folder)
            for contender in experiment.contenders
        ],
    }


def clean(value: object) -> object:
    """Converts ``value`` to types that JSON has. NaN and infinity become ``None``."""
    if isinstance(value, Estimate):
        return clean(value._asdict())
    if isinstance(value, dict):
        return {str(key): clean(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [clean(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, bool, int, float, type(None))) else str(value)


def _reference_record(reference: Reference, folder: Path) -> dict[str, object]:
    metadata = reference.metadata
    return {
        "path": _relative(reference.path, folder),
        "noise": reference.noise,
        "spp": reference.spp,
        "integrator": metadata.get("integrator"),
        "seconds": metadata.get("seconds"),
        "metadata": metadata,
    }


def _contender_record(
    experiment: Experiment, contender: Contender, folder: Path
) -> dict[str, object]:
    levels = [_level_record(experiment, contender, level) for level in contender.levels()]
    refused = {record["level"] for record in levels if record["refused"]}
    trusted = [run for run in contender.runs if run.level not in refused]
    errors = [run.errors.relmse for run in trusted]
    efforts = {name: [getattr(run, name) for run in trusted] for name in _EFFORTS}
    return {
        "label": contender.label,
        "name": contender.named.name,
        "parameters": contender.named.parameters,
        "error": contender.error,
        "traceback": contender.traceback,
        "notes": remarks.notes(experiment, contender),
        "compile_seconds": contender.compile_seconds,
        "runs": [_run_record(run, folder) for run in contender.runs],
        "levels": levels,
        "slopes": {
            # Within one level, samples and times differ by chance only: no slope can be fitted
            name: intervals.slope(values, errors) if len(levels) > 1 else None
            for name, values in efforts.items()
        },
        "target": _target_record(experiment, trusted, levels),
    }


def _target_record(
    experiment: Experiment, trusted: Sequence[Run], levels: Sequence[Mapping[str, Any]]
) -> dict[str, Estimate | None] | None:
    """The cost of reaching the error of ``until``; ``None`` if it was not reached."""
    target = experiment.budget.target
    errors = [level["figures"]["relmse"] for level in levels]
    if not target or not any(error and error.value <= target for error in errors):
        return None
    if len(levels) == 1:
        figures = levels[0]["figures"]
        return {name: figures[name] and Estimate(figures[name].value) for name in _EFFORTS}
    # Fit the last levels only: convergence over all levels need not be a straight line
    last = trusted[-_FITTED_LEVELS * experiment.rounds :]
    spp = [run.spp for run in last]
    cost = intervals.cost_of(target, spp, [run.errors.relmse for run in last])
    return {
        "spp": cost,
        # Derived from the samples: a line of error against time would add the noise of the times
        "seconds": intervals.follow(cost, spp, [run.seconds for run in last]),
    }


def _run_record(run: Run, folder: Path) -> dict[str, object]:
    errors = {name: getattr(run.errors, name) for name in _ERRORS}
    return {**run.record(), **errors, "image": _relative(run.path, folder)}


def _level_record(
    experiment: Experiment, contender: Contender, level: float
) -> dict[str, object]:
    runs = contender.at(level)
    refused = remarks.refusal(experiment.reference, runs)
    first = experiment.contenders[0].at(level)
    is_measured = not refused and not remarks.refusal(experiment.reference, first)
    figures = _figures(runs, bool(refused))
    of_first = _figures(first, not is_measured) if first else {}
    own_rounds = {run.round: run for run in runs}
    pairs = [(own_rounds[run.round], run) for run in first if run.round in own_rounds]

    def ratio(name: str, of: Callable[[Run], object] = lambda run: run.errors) -> Estimate | None:
        values = [(getattr(of(own), name), getattr(of(other), name)) for own, other in pairs]
        return intervals.ratio(figures[name], of_first.get(name), values)

    ratios = {name: ratio(name) for name in _RELATIVE_ERRORS}
    seconds, efficiency = _timed_ratios(pairs, ratios["relmse"], "relmse")
    _, trimmed = _timed_ratios(pairs, ratios["relmse_trimmed"], "relmse_trimmed")
    return {
        "level": level,
        "run_count": len(runs),
        "refused": refused,
        "figures": figures,
        "ratios": {
            **ratios,
            "mean": ratio("mean", lambda run: run),
            "seconds": seconds,
            "efficiency": efficiency,
            "efficiency_trimmed": trimmed,
        },
    }


def _timed_ratios(
    pairs: Sequence[tuple[Run, Run]], errors: Estimate | None, name: str
) -> tuple[Estimate | None, Estimate | None]:
    """The ratios of the seconds and of the efficiencies.

    Args:
        pairs: Runs of an integrator, and of the first one in the same rounds.
        errors: The ratio of their errors.
        name: The name of these errors.
    """
    timed = [
        (own, other, _common_times(own, other)) for own, other in pairs
        if own.times.keys() & other.times.keys()
    ]
    seconds = [times for _own, _other, times in timed]
    medians = [intervals.median(values) for values in zip(*seconds)] or [None, None]
    ratio = intervals.ratio(*medians, seconds)
    if ratio is None or errors is None or not errors.value > 0:
        return ratio, None
    efficiencies = [
        (getattr(other.errors, name) * times[1], getattr(own.errors, name) * times[0])
        for own, other, times in timed
    ]
    efficiency = Estimate(1 / (errors.value * ratio.value))
    return ratio, intervals.ratio(efficiency, Estimate(1.0), efficiencies)


def _common_times(own: Run, other: Run) -> tuple[float, float]:
    """The seconds of two runs in one session: the first one of ``own`` in which both were timed."""
    session = next(session for session in own.times if session in other.times)
    return own.times[session], other.times[session]


def _figures(runs: Sequence[Run], is_refused: bool) -> dict[str, Estimate | None]:
    figures: dict[str, Estimate | None] = {
        "seconds": intervals.median([run.seconds for run in runs])
    }
    for name in _OTHERS:
        figures[_NAMES.get(name, name)] = _mean([getattr(run, name) for run in runs])
    for kind in ("camera", "scatter", "shadow"):
        figures[f"rays_{kind}"] = _mean([run.rays.get(kind) for run in runs])
    for name in _ERRORS:
        values = [getattr(run.errors, name) for run in runs]
        figures[name] = None if is_refused else _mean(values)
    figures["efficiency"] = None
    relmse, seconds = figures["relmse"], figures["seconds"]
    if relmse is not None and seconds is not None and relmse.value > 0:
        figures["efficiency"] = intervals.ratio(
            Estimate(1.0),
            Estimate(relmse.value * seconds.value),
            [(_efficiency(run), 1.0) for run in runs],
        )
    return figures


def _efficiency(run: Run) -> float:
    return 1 / (run.errors.relmse * run.seconds) if run.errors.relmse > 0 else 0.0


def _mean(values: Sequence[float | None]) -> Estimate | None:
    return None if any(value is None for value in values) else intervals.mean(values)


def _relative(path: Path, folder: Path) -> str:
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return str(path.resolve())
