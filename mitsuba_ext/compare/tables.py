"""The results of an experiment as a table on the terminal and as ``results.json``.

``results.json`` holds one object::

    schema        1
    date          ISO 8601, UTC
    scene         path, parameters, content_hash, size [width, height], depth {max_depth, rr_depth}
    spp, seeds    of the runs
    reference     path, noise (its own relMSE, null if unknown), metadata
    integrators   a list, in the order of the command line:
        label, name, parameters
        error              why it failed; empty if it did not
        compile_seconds
        runs               a list: seed, spp, seconds, relmse, relmse_trimmed, mse, rmse,
                           rays {camera, scatter, shadow}, connections, zero_radiance,
                           memory (bytes), image
        summary            seconds, relmse, relmse_trimmed, mse, rmse: {mean, std, median}
        efficiency         1 / (mean relMSE · median seconds)
        efficiency_ratio   to the first integrator
    versions      mitsuba_ext, mitsuba, drjit, variant, numpy, python
    machine       system, processor, cores

Seconds are wall clock without compilation, learning included. Unknown numbers are null.
"""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Callable
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from . import experiment as experiments
from .experiment import Contender, Experiment, Run
from .images import replacing, write_exr
from .machine import machine, versions

SCHEMA = 1

_FIGURES = ("relmse", "relmse_trimmed", "mse", "rmse", "seconds")


def table(experiment: Experiment) -> Table:
    """A row per integrator: mean over the seeds (seconds: median) ± standard deviation in %."""
    result = Table(
        title=_title(experiment), title_justify="left", title_style="", box=box.SIMPLE_HEAD,
        show_edge=False, padding=0,
    )
    result.add_column("integrator", overflow="fold", min_width=12)
    for heading in ("relMSE", "trimmed", "rMSE", "seconds", "rays", "shadow", "eff."):
        result.add_column(heading, justify="right", no_wrap=True)
    for contender in experiment.contenders:
        label = Text(contender.label)
        if contender.error:
            label.append(f"\n{contender.error}", style="red")
        if not contender.runs:
            result.add_row(label, *["–"] * 7)
            continue
        ratio = experiment.efficiency_ratio(contender)
        result.add_row(
            label,
            *(_spread(contender, name, "mean") for name in ("relmse", "relmse_trimmed", "rmse")),
            _spread(contender, "seconds", "median"),
            _rays(contender),
            _shadow_share(contender),
            "–" if ratio is None else f"{ratio:.2f}x",
        )
    return result


def footnote(experiment: Experiment) -> str:
    """What a reader has to know to trust the table."""
    reference = experiment.reference
    noise = reference.noise
    run_count = max(len(contender.runs) for contender in experiment.contenders)
    lines = [
        f"Mean ± standard deviation over {run_count} seed(s); median of the seconds "
        f"(compilation excluded, learning included); eff. = 1 / (relMSE · seconds), "
        f"relative to the first; shadow = shadow rays traced, of those that 'path' would trace.",
        f"Reference: {reference.path}, "
        + (
            "variance unknown: its noise is part of the errors."
            if noise is None
            else f"relMSE of its own {noise:.2g}, subtracted."
        ),
    ]
    claimed = reference.metadata.get("max_depth")
    actual = experiment.scene.depth.get("max_depth")
    if isinstance(claimed, int) and actual is not None and claimed != actual:
        lines.append(
            f"Warning: the reference has max_depth {claimed}, the scene {actual}."
        )
    return "\n".join(lines)


def results(experiment: Experiment) -> dict[str, object]:
    """The content of ``results.json``."""
    scene, reference = experiment.scene, experiment.reference
    return {
        "schema": SCHEMA,
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "scene": {
            "path": str(scene.path),
            "parameters": scene.parameters,
            "content_hash": scene.content_hash,
            "size": list(scene.size),
            "depth": scene.depth,
        },
        "spp": experiment.spp,
        "seeds": experiment.seeds,
        "reference": {
            "path": str(reference.path),
            "noise": reference.noise,
            "metadata": reference.metadata,
        },
        "integrators": [
            _contender_record(experiment, index, contender)
            for index, contender in enumerate(experiment.contenders)
        ],
        "versions": versions(),
        "machine": machine(),
    }


def write_results(path: Path, experiment: Experiment) -> None:
    """Writes ``results.json``."""
    text = json.dumps(_without_nan(results(experiment)), indent=2, default=str)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def image_name(index: int, contender: Contender, run: Run) -> str:
    """File name of a run's image: ``2_neepp_seed0.exr`` is of the second integrator."""
    return f"{index + 1}_{contender.name}_seed{run.seed}.exr"


def image_writer(
    folder: Path, experiment: Experiment
) -> Callable[[int, Contender, Run], None]:
    """What to pass as ``finished`` to :meth:`Experiment.run` to keep the images in ``folder``."""

    def write(index: int, contender: Contender, run: Run) -> None:
        metadata = {
            "scene": str(experiment.scene.path),
            "content_hash": experiment.scene.content_hash,
            "integrator": contender.name,
            "parameters": contender.parameters,
            "seed": run.seed,
            "spp": run.spp,
            "seconds": run.seconds,
            "versions": versions(),
        }
        write_exr(folder / image_name(index, contender, run), run.image, "RGB", metadata)

    return write


def _title(experiment: Experiment) -> str:
    scene = experiment.scene
    depth = ", ".join(f"{key} {value}" for key, value in scene.depth.items())
    size = "x".join(map(str, scene.size))
    return ", ".join(filter(None, [str(scene.path), size, f"{experiment.spp} spp", depth]))


def _contender_record(
    experiment: Experiment, index: int, contender: Contender
) -> dict[str, object]:
    return {
        "label": contender.label,
        "name": contender.name,
        "parameters": contender.parameters,
        "error": contender.error,
        "compile_seconds": contender.compile_seconds,
        "runs": [
            {**experiments.run_record(run), "image": image_name(index, contender, run)}
            for run in contender.runs
        ],
        "summary": {
            name: experiments.spread(contender.figures(name)) for name in _FIGURES
        } if contender.runs else {},
        "efficiency": contender.efficiency,
        "efficiency_ratio": experiment.efficiency_ratio(contender),
    }


def _spread(contender: Contender, name: str, center: str) -> str:
    values = experiments.spread(contender.figures(name))
    if not math.isfinite(values[center]):
        return "–"
    deviation = ""
    if len(contender.runs) > 1 and values[center] != 0:
        deviation = f" ±{abs(values['std'] / values[center]):.0%}"
    return f"{values[center]:#.3g}{deviation}"


def _rays(contender: Contender) -> str:
    """Rays of one run, in millions; Mitsuba's own integrators do not count theirs."""
    rays = [sum(run.rays.values()) for run in contender.runs if run.rays]
    return f"{sum(rays) / len(rays) / 1e6:.3g} M" if rays else "–"


def _shadow_share(contender: Contender) -> str:
    """Shadow rays traced, in percent of the connections (of those that ``path`` traces)."""
    shares = [run.rays["shadow"] / run.connections for run in contender.runs if run.connections]
    return f"{sum(shares) / len(shares):.1%}" if shares else "–"


def _without_nan(value: object) -> object:
    """JSON knows neither NaN nor infinity."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
