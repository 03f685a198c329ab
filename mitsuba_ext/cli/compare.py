"""``mitsuba-ext compare``: speed against error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from .common import (
    INTERRUPTED,
    console_for_tables,
    make_folder,
    progress_bars,
    scene_options,
    select_variant,
)


@click.command(short_help="Measure the speed and the error of integrators on a scene.")
@click.option(
    "--spp", type=click.IntRange(min=1), required=True, metavar="N",
    help="Samples per pixel of each run.",
)
@click.option(
    "--seeds", type=click.IntRange(min=1), default=3, show_default=True, metavar="K",
    help="Runs of each integrator, with the seeds 0, 1, 2, …",
)
@click.option(
    "--reference", "reference_file", type=click.Path(path_type=Path), metavar="FILE",
    help="EXR with mean.R/G/B and variance.R/G/B (of the mean), or with plain R/G/B.",
)
@click.option(
    "--reference-spp", type=click.IntRange(min=8), metavar="N",
    help="Render the reference with 'path' and N samples; it is kept in DIR for the next time. "
    "[default: 16 times --spp]",
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/compare"), show_default=True,
    metavar="DIR", help="Folder for results.json, the images, and rendered references.",
)
@scene_options
@click.argument("integrators", nargs=-1, required=True, metavar="INTEGRATOR…")
def compare(
    scene: Path,
    integrators: Sequence[str],
    spp: int,
    seeds: int,
    reference_file: Path | None,
    reference_spp: int | None,
    out: Path,
    size: tuple[int, int] | None,
    definitions: Sequence[tuple[str, str]],
    variant: str,
) -> int:
    """Render SCENE with each INTEGRATOR (NAME[:key=value,…]) and compare error and time.

    All get max_depth and rr_depth of the scene's integrator unless they set their own. Kernels are
    compiled beforehand, the integrators take turns, and learning is part of the time.
    """
    from ..compare import Experiment, images, load_reference, render_reference, tables
    from ..scenes import load_scene

    if reference_file and reference_spp:
        raise click.UsageError("--reference and --reference-spp exclude each other")
    select_variant(variant)
    loaded = load_scene(scene, size, dict(definitions), keep_integrator=False)
    experiment = Experiment(loaded, integrators, spp, range(seeds))
    reference = load_reference(reference_file, loaded.size) if reference_file else None
    make_folder(out)
    images.check_folder(out)

    interrupted = False
    try:
        with progress_bars() as progress:
            if reference is None:
                bar = progress.add_task("reference", total=1.0)
                reference = render_reference(
                    loaded, reference_spp or max(8, 16 * spp), out,
                    lambda done: progress.update(bar, completed=done),
                )
                progress.update(bar, completed=1.0)
            bar = progress.add_task("comparing", total=experiment.step_count)
            experiment.run(
                reference,
                progress=lambda label: progress.update(bar, advance=1, description=label),
                finished=tables.image_writer(out, experiment),
            )
    except KeyboardInterrupt:
        interrupted = True
        if not any(contender.runs for contender in experiment.contenders):
            click.echo("interrupted before the first run: nothing written", err=True)
            return INTERRUPTED

    console = console_for_tables()
    console.print(tables.table(experiment))
    console.print(tables.footnote(experiment), highlight=False, markup=False, soft_wrap=True)
    tables.write_results(out / "results.json", experiment)
    console.print(f"{out / 'results.json'}", highlight=False, markup=False, soft_wrap=True)
    if interrupted:
        click.echo("interrupted: the results are of the finished runs", err=True)
        return INTERRUPTED
    return 1 if any(contender.error for contender in experiment.contenders) else 0
