"""``mitsuba-ext compare``: measures the time and the error of integrators."""

from __future__ import annotations

import contextlib
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..inputs.names import check_integrator
from ..inputs.variants import select_variant
from . import candidates, supervisor
from .common import (
    INTERRUPTED,
    FilledPath,
    NumberList,
    check_executor,
    executor_options,
    say,
    scene_options,
)
from .viewing import CommandWithTev, Sayings, of_runs, view_options, viewing

if TYPE_CHECKING:
    from ..compare.progress import Step
    from ..live.viewer import Viewer
    from ..long_renders.divided_references import ReferenceWorkers


@click.command(
    cls=CommandWithTev, short_help="Measure the speed and the error of integrators on scenes."
)
@click.option(
    "--spp", type=click.IntRange(min=1), metavar="N",
    help="Equal samples: N per pixel for each run.",
)
@click.option(
    "--time", "seconds", type=click.FloatRange(min=0, min_open=True), metavar="S",
    help="Equal time: S seconds for each run, including learning but not compilation.",
)
@click.option(
    "--sweep", type=NumberList(), metavar="N,N,…",
    help="Several numbers of samples, for convergence plots and slopes.",
)
@click.option(
    "--until", type=click.FloatRange(min=0, min_open=True), metavar="RELMSE",
    help="Double the samples until the mean relMSE is at most RELMSE, and report the cost.",
)
@click.option(
    "--seeds", type=click.IntRange(min=1), default=3, show_default=True, metavar="K",
    help="Runs of each integrator at each level, each with a different seed.",
)
@click.option(
    "--reference", type=FilledPath(), metavar="FILE",
    help="EXR with mean.R/G/B or R/G/B, and variance.R/G/B (of the mean) if it is known.",
)
@click.option(
    "--reference-spp", type=click.IntRange(min=8), metavar="N",
    help="Render the reference with N samples per pixel, and store it in DIR for later. "
    "[default: 16 times the longest run]",
)
@click.option(
    "--reference-integrator", metavar="INTEGRATOR", shell_complete=candidates.integrators,
    help="Integrator that renders the reference.  [default: path; if that misses light of the "
    "scene: volpath or composed_path in media, bdpt for lights that no camera path finds]",
)
@click.option(
    "--no-reference", is_flag=True,
    help="Take the variance between seeds as the error. Bias shows only in the images' means.",
)
@click.option(
    "--cpu", is_flag=True,
    help="Measure the CPU time of all threads, not the wall clock, on a machine with other work.",
)
@click.option(
    "--out", type=FilledPath(), default="out/compare", show_default=True, metavar="DIR",
    shell_complete=candidates.folders,
    help="Folder for report.html, results.json, the images, and rendered references. Stored "
    "runs are reused, and timed again only if new runs are compared with them.",
)
@click.option(
    "--limit", type=click.FloatRange(min=0, min_open=True), metavar="S",
    help="Time limit of a render in seconds, including compilation. An integrator that takes "
    "longer is stopped and reported as failed; the others continue. References have no limit.",
)
@view_options("the images of finished runs")
@executor_options("Render references", " Measured runs use one process.")
@click.option("--worker", type=click.Choice(supervisor.JOBS), hidden=True)
@scene_options
@click.argument(
    "names", nargs=-1, required=True, metavar="SCENE… INTEGRATOR…",
    shell_complete=candidates.integrators,
)
@click.pass_context
def compare(
    context: click.Context,
    names: Sequence[str],
    spp: int | None,
    seconds: float | None,
    sweep: Sequence[int] | None,
    until: float | None,
    seeds: int,
    reference: Path | None,
    reference_spp: int | None,
    reference_integrator: str | None,
    no_reference: bool,
    cpu: bool,
    out: Path,
    limit: float | None,
    tev: str | None,
    port: int | None,
    control: bool,
    workers: int | None,
    dask: str | None,
    worker: str | None,
    size: tuple[int, int] | None,
    crop: tuple[int, int, int, int] | None,
    rfilter: str,
    max_depth: int | None,
    definitions: Sequence[tuple[str, str]],
    plugins: Sequence[str],
    variant: str,
) -> int:
    """Render each SCENE with each INTEGRATOR and compare error and time.

    A SCENE is an XML file. An INTEGRATOR is a name, NAME:key=value,…, or an XML or JSON file that
    holds one. All get max_depth and rr_depth of the scene's integrator unless they set their own.
    Ratios are relative to the first integrator.

    A comma begins a parameter only if key= follows: "neepp:aovs=d:depth,a:albedo,grid=8" has two
    parameters. Square brackets hold nested plugins, in the same form:
    "variance:nested=[neepp:grid=8],batches=32".
    """
    from ..inputs.scenes import check_scene_file

    given = {"--spp": spp, "--time": seconds, "--sweep": sweep, "--until": until}
    if sum(value is not None for value in given.values()) != 1:
        raise click.UsageError(f"give one of {', '.join(given)}")
    if reference and reference_spp:
        raise click.UsageError("--reference and --reference-spp cannot be combined")
    if no_reference and (reference or reference_spp or reference_integrator):
        raise click.UsageError("--no-reference cannot be combined with options of references")
    check_executor(workers, dask)
    scenes, integrators = _sort_out(names)
    if not plugins:
        for specification in (*integrators, reference_integrator):
            if specification is not None:
                check_integrator(specification)
    for scene in scenes:
        check_scene_file(scene)
    if reference and len(scenes) > 1:
        raise click.UsageError("one --reference cannot serve several scenes")
    if worker is not None:
        supervisor.become_worker()
    elif context.obj == supervisor.SUPERVISED:
        return supervisor.supervise(sys.argv[1:], out, limit or math.inf)
    elif limit is not None:
        raise click.UsageError("--limit needs worker processes, which only the command has")
    from ..compare import Comparison, SceneChanges, SceneSetup, budgets
    from ..compare import show as show_tables
    from ..compare.progress import reporting

    make = {
        "--spp": budgets.equal_samples, "--time": budgets.equal_time,
        "--sweep": budgets.sweep, "--until": budgets.until,
    }
    (budget,) = (make[name](value) for name, value in given.items() if value is not None)
    select_variant(variant, plugins)
    changes = SceneChanges(crop, rfilter, max_depth)
    stack = contextlib.ExitStack()
    is_stored = worker == supervisor.STORED
    viewer = None
    if not is_stored:
        viewer = stack.enter_context(viewing(tev, port, control, Sayings()))
    comparison = Comparison(
        [SceneSetup(scene, size, dict(definitions), reference, changes) for scene in scenes],
        integrators,
        budget,
        seeds=seeds,
        folder=out,
        reference_spp=reference_spp,
        reference_integrator=reference_integrator,
        command=shlex.join(["mitsuba-ext", *supervisor.without_job(sys.argv[1:])]),
        only_stored=is_stored,
        with_reference=not no_reference,
        cpu_time=cpu,
        reference_workers=_reference_workers(stack, workers, dask, tuple(plugins)),
        warn=lambda remark: say(f"mitsuba-ext: warning: {remark}"),
        watch=(lambda name, runs: viewer.present(lambda: of_runs(runs), name)) if viewer else None,
    )
    interrupted = is_stored
    try:
        with stack, reporting(True) as progress:
            if viewer:
                viewer.begin("", _facts(scenes, integrators, given))
                show, progress = progress, lambda step: (_tell(viewer, step), show(step))
            comparison.run(progress)
    except KeyboardInterrupt:
        interrupted = True
    results = comparison.results()
    if not results["scenes"]:
        say("interrupted before the first run: nothing written")
        return INTERRUPTED
    show_tables(results)
    for name in ("results.json", "report.html"):
        click.echo(out / name)
    if interrupted:
        say("interrupted: the results cover only the finished runs")
        return INTERRUPTED
    return 1 if any(map(_has_trouble, results["scenes"])) else 0


def _facts(
    scenes: Sequence[Path], integrators: Sequence[str], budget: Mapping[str, Any]
) -> dict[str, str]:
    """What a viewer says of the comparison."""
    ((option, value),) = ((key, value) for key, value in budget.items() if value is not None)
    if isinstance(value, Sequence):
        value = ",".join(map(str, value))
    return {
        "title": ", ".join(integrators), "Scene": ", ".join(map(str, scenes)),
        "Budget": f"{option} {value}",
    }  # fmt: skip


def _tell(viewer: Viewer, step: Step) -> None:
    viewer.tell(doing=step.label, seconds=step.done, seconds_left=step.left)


def _reference_workers(
    executors: contextlib.ExitStack, workers: int | None, dask: str | None, plugins: tuple[str, ...]
) -> ReferenceWorkers | None:
    """The workers that render references; ``executors`` shuts them down."""
    from ..long_renders.divided_references import ReferenceWorkers
    from ..long_renders.executors import renderers
    from ..long_renders.workers import threads_of_each

    if workers is None and dask is None:
        return None
    found = executors.enter_context(renderers(workers, dask))
    threads = threads_of_each(workers) if workers else 0
    return ReferenceWorkers(found.executor, found.count(), plugins, threads)


def _has_trouble(scene: Mapping[str, Any]) -> bool:
    """Whether the scene or an integrator failed, or the reference was too noisy for an error."""
    return bool(scene["error"]) or any(
        item["error"] or any(level["refused"] for level in item["levels"])
        for item in scene["integrators"]
    )


def _sort_out(names: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Divides the arguments into scenes and integrators. XML files are scenes, unless their root is
    an <integrator>."""
    from ..inputs.specifications import is_fragment

    paths = [Path(name) for name in names]
    scenes = [
        path for path in paths
        if (path.suffix.lower() == ".xml" or path.is_file()) and not is_fragment(path)
    ]
    integrators = [name for name, path in zip(names, paths) if path not in scenes]
    if not scenes:
        raise click.UsageError("no scene was given (an XML file)")
    if not integrators:
        raise click.UsageError("Missing argument 'INTEGRATOR…'")
    return scenes, integrators
