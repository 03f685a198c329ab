"""``mitsuba-ext render``: a scene to an image."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from ..names import check_integrator
from .common import (
    INTERRUPTED,
    MAX_SEED,
    kernels_compiled,
    progress_bars,
    scene_options,
    select_variant,
)


@click.command(short_help="Render a scene to an image.")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, metavar="FILE",
    help="Image to write: .exr (float, with metadata), .png, .jpg, .hdr or .pfm.",
)
@click.option(
    "--integrator", "specification", metavar="INTEGRATOR",
    help="Use this one instead of the scene's: NAME[:key=value,…], or an XML or JSON file. It "
    "takes over max_depth and rr_depth from there unless it sets them.",
)
@click.option(
    "--spp", type=click.IntRange(min=1), metavar="N",
    help="Samples per pixel, instead of the scene's.",
)
@click.option(
    "--time", "seconds", type=click.FloatRange(min=0, min_open=True), metavar="S",
    help="As many samples as fit into S seconds of rendering. Their number follows from a few "
    "short renders, which come on top.",
)
@click.option(
    "--seed", type=click.IntRange(0, MAX_SEED), default=0, metavar="N",
    show_default=True, help="Seed of the random numbers.",
)
@scene_options
@click.argument("scene", type=click.Path(path_type=Path))
def render(
    scene: Path,
    output: Path,
    specification: str | None,
    spp: int | None,
    seconds: float | None,
    seed: int,
    size: tuple[int, int] | None,
    definitions: Sequence[tuple[str, str]],
    plugins: Sequence[str],
    variant: str,
) -> int:
    """Render SCENE (an XML file) to an image."""
    if specification and not plugins:
        check_integrator(specification)
    from ..scenes import InputError, check_scene_file, load_scene, one_line

    check_scene_file(scene)
    from ..batches import sample_count
    from ..compare import images, machine, timing
    from ..specifications import make_named

    if spp is not None and seconds is not None:
        raise click.UsageError("--spp and --time exclude each other")
    images.check_target(output)
    select_variant(variant, plugins)
    compiled = kernels_compiled()
    loaded = load_scene(scene, size, dict(definitions), keep_integrator=not specification)
    if specification:
        named = make_named(specification, loaded.settings)
        integrator, name, parameters = named.integrator, named.name, named.parameters
    else:
        integrator, name = loaded.scene.integrator(), loaded.integrator_name
        parameters = dict(loaded.settings)
    if integrator is None:
        raise InputError(f"{scene}: the scene has no integrator: name one with --integrator")

    if kernels_compiled() > compiled:
        # Those of the render take longer, and nothing can be printed meanwhile
        click.echo("compiling kernels (later renders like this one find them in a cache)", err=True)
    film = loaded.scene.sensors()[0].film()
    interrupted = measuring = False
    start = time.perf_counter()
    try:
        with progress_bars() as progress:
            if seconds is not None:
                measuring = True
                bar = progress.add_task("measuring the speed", total=None)
                spp = timing.samples_for(seconds, integrator, loaded.scene, seed)
                progress.remove_task(bar)
                measuring = False
            bar = progress.add_task(name, total=None)
            if hasattr(integrator, "progress"):
                integrator.progress = lambda done: progress.update(bar, total=1.0, completed=done)
            start = time.perf_counter()
            timing.timed_render(integrator, loaded.scene, seed, spp or 0)
    except KeyboardInterrupt:
        interrupted = True
    except (ValueError, RuntimeError) as error:
        raise InputError(f'{scene}: "{name}": {one_line(error)}') from error
    elapsed = time.perf_counter() - start

    report = getattr(integrator, "statistics", None)
    no_image = measuring or not _film_is_prepared(film) or (report and not report.passes)
    if interrupted and no_image:
        click.echo("interrupted before there was an image: nothing written", err=True)
        return INTERRUPTED
    metadata = {
        "scene": str(scene),
        "scene_parameters": dict(definitions),
        "integrator": name,
        "parameters": parameters,
        "seed": seed,
        "spp": report.spp if report else sample_count(loaded.scene.sensors()[0], spp or 0),
        "seconds": elapsed,
        "versions": machine.versions(),
    }
    images.write_film(output, film, metadata)
    if interrupted:
        click.echo(f"interrupted: {output} has the samples so far", err=True)
        return INTERRUPTED
    click.echo(f"{output}: {metadata['spp']} spp in {elapsed:.1f} s")
    return 0


def _film_is_prepared(film: Any) -> bool:
    try:
        film.develop()
    except RuntimeError:
        return False
    return True
