"""``mitsuba-ext render``: a scene to an image."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..names import check_integrator
from ..parameters import MOST_SPP
from ..variants import select_variant
from .common import (
    MAX_SEED,
    Every,
    FilledPath,
    Interval,
    kernels_compiled,
    say,
    scene_options,
)
from .stopping import stopping

if TYPE_CHECKING:
    import numpy as np


@click.command(short_help="Render a scene to an image.")
@click.option(
    "-o", "--output", type=FilledPath(), required=True, metavar="FILE",
    help="Image to write: .exr (float, with metadata), .png, .jpg, .hdr or .pfm.",
)
@click.option(
    "--integrator", "specification", metavar="INTEGRATOR",
    help="Integrator to use instead of the scene's: NAME[:key=value,…], or an XML or JSON file. It "
    "inherits max_depth and rr_depth of the scene's integrator unless it sets them.",
)
@click.option(
    "--spp", type=click.IntRange(1, MOST_SPP), metavar="N",
    help="Samples per pixel, instead of the scene's.",
)
@click.option(
    "--time", "seconds", type=click.FloatRange(min=0, min_open=True), metavar="S",
    help="Take as many samples as fit into S seconds of rendering. The first samples tell the "
    "speed; with our integrators and with structured samplers, a few short renders do, which take "
    "additional time.",
)
@click.option(
    "--seed", type=click.IntRange(0, MAX_SEED), default=0, metavar="N",
    show_default=True, help="Seed of the random numbers.",
)
@click.option(
    "-s", "--sensor", "sensor_index", type=click.IntRange(min=0), metavar="N",
    help="Sensor to render, counted from 0. [default: the first]",
)
@click.option(
    "--checkpoint", type=FilledPath(), metavar="DIR",
    help="A folder that keeps the render. The same command goes on from there.",
)
@click.option(
    "--every", type=Every(), default="60s", metavar="TIME", show_default=True,
    help="With --checkpoint: how often to keep it, and to write FILE: 60s, 10m, 2h or 100spp.",
)
@click.option(
    "--add", type=click.IntRange(1, MOST_SPP), metavar="N",
    help="With --checkpoint: samples per pixel, besides those that are there.",
)
@click.option(
    "--until", type=click.FloatRange(min=0, min_open=True), metavar="RELMSE",
    help="End when the relative error, as the variance of the batches announces it, is RELMSE. "
    "--spp and --time limit it.",
)
@click.option(
    "--workers", type=click.IntRange(1, 1024), metavar="N",
    help="Render in N processes of this machine.",
)
@click.option(
    "--dask", metavar="ADDRESS",
    help="Render on the workers of the Dask scheduler at ADDRESS: tcp://host:port.",
)
@click.option(
    "--denoise", is_flag=True,
    help="Denoise the image in the end, guided by the albedo and the normals of what the camera "
    "sees. The image itself is kept in NAME.noisy.exr.",
)
@click.option("--quiet", is_flag=True, help="Show warnings and errors only.")
@click.option(
    "--json", "as_json", is_flag=True,
    help="Print JSON objects to stdout, one a line: events of progress, warnings, and the end.",
)
@click.option(
    # With one thread, Mitsuba 3.9.1 hangs when it reads or writes an EXR file
    "--threads", type=click.IntRange(min=2), metavar="N",
    help="Threads of each process, at least 2.  [default: all cores, divided among --workers]",
)
@scene_options
@click.argument("scene", type=FilledPath())
def render(
    scene: Path,
    output: Path,
    specification: str | None,
    spp: int | None,
    seconds: float | None,
    seed: int,
    sensor_index: int | None,
    checkpoint: Path | None,
    every: Interval,
    add: int | None,
    until: float | None,
    workers: int | None,
    dask: str | None,
    denoise: bool,
    quiet: bool,
    as_json: bool,
    threads: int | None,
    size: tuple[int, int] | None,
    definitions: Sequence[tuple[str, str]],
    plugins: Sequence[str],
    variant: str,
) -> int:
    """Render SCENE (an XML file) to an image.

    Ctrl-C, SIGTERM and SIGHUP end the render after the running pass and keep the image so far: in
    FILE, or in NAME.partial.EXT if FILE exists already. A second signal, half a second later or
    more, ends the process at once, unless the image is being written.

    Mitsuba's own integrators render in passes. A structured sampler stratifies the samples of a
    pass (64 per pixel or more, 16 for large images), not those of the whole render.

    With --checkpoint, --until, --workers or --dask, all integrators render in batches: independent
    renders with seeds of their own. An EXR then holds the variance of the image too. What an
    integrator learns in the first batch, the others use. SIGUSR1 keeps the render at once.
    """
    if specification and not plugins:
        check_integrator(specification)
    from ..scenes import check_scene_file

    check_scene_file(scene)
    from .. import denoising
    from ..compare import images, machine
    from ..long_renders.batch_renderer import RenderRequest
    from .long_job import LongJob, LongOptions
    from .render_job import RenderJob
    from .reports import Report

    report = Report(quiet, as_json)
    if spp is not None and seconds is not None and until is None:
        raise click.UsageError("--spp and --time exclude each other")
    if add is not None and checkpoint is None:
        raise click.UsageError("--add needs --checkpoint: the folder with the samples so far")
    if add is not None and spp is not None:
        raise click.UsageError("--add and --spp exclude each other")
    if workers is not None and dask is not None:
        raise click.UsageError("--workers and --dask exclude each other")
    images.check_target(output)
    noisy = output.with_name(f"{output.stem}.noisy.exr")
    if denoise:
        denoising.denoiser()
        images.check_target(noisy)
    guides = {}

    def metadata() -> dict[str, object]:
        return {
            "scene": str(scene),
            "scene_parameters": dict(definitions),
            "integrator": job.name,
            "parameters": job.parameters,
            "seed": seed,
            "spp": job.spp,
            "seconds": job.seconds,
            "interrupted": job.is_interrupted,
            "versions": machine.versions(),
            **job.about(),
        }

    def write(target: Path, others: Mapping[str, np.ndarray] | None = None) -> None:
        images.write_film(target, job.film, metadata(), {**job.variance(), **(others or {})})

    with stopping() as stop:
        job = None
        try:
            select_variant(variant, plugins)
            if threads:
                import drjit as dr

                dr.set_thread_count(threads)
            compiled = kernels_compiled()
            if checkpoint or until or workers or dask:
                job = LongJob(
                    RenderRequest(
                        str(scene), size, tuple(definitions), specification, sensor_index or 0,
                        seed, variant, tuple(plugins), threads=threads or 0,
                    ),
                    LongOptions(checkpoint, every, add, until, workers or 0, dask or ""),
                )  # fmt: skip
            else:
                job = RenderJob.load(
                    scene, size, dict(definitions), specification, sensor_index, seed
                )
            is_new = kernels_compiled() > compiled
            images.check_film(output, job.film, job.integrator.aov_names())
            for remark in job.remarks(is_sensor_chosen=sensor_index is not None):
                report.warn(remark)
            if denoise and (remark := denoising.remark(job.film)):
                report.warn(remark)
            if is_new:
                # The render's kernels take longer to compile, and nothing can be printed meanwhile
                report.note("compiling kernels (later renders like this one find them in a cache)")
            if denoise:
                guides = denoising.render_guides(job.scene, job.sensor, seed)
            job.run(spp, seconds, functools.partial(write, output), report)
        except (KeyboardInterrupt, OSError) as error:
            # After SIGHUP, showing progress on the closed terminal raises an OSError
            if isinstance(error, OSError) and not stop.is_asked:
                raise
            if job is None or not job.has_image():
                say("interrupted before there was an image: nothing written")
                return stop.exit_code
            # After a signal in the last pass, the image may be complete
            job.is_interrupted = not job.is_complete()

        stop.wait()
        target = output
        if job.is_interrupted and output.exists() and not checkpoint:
            target = output.with_name(f"{output.stem}.partial{output.suffix}")
        if denoise:
            write(noisy, guides)
            denoising.denoise_file(noisy, target, metadata())
        else:
            write(target)
        bad, pixel_count = images.count_non_finite(job.film)
        if bad:
            report.warn(f"{bad} of {pixel_count} pixels of {target} are NaN or infinite")
        figures = {"file": str(target), "spp": job.spp, "seconds": job.seconds, "bad_pixels": bad}
        if job.is_interrupted:
            older = "" if target == output else f" ({output} is an older image, and was kept)"
            report.end(f"interrupted {job.how_far()}: {target}{older}", True, **figures)
            return stop.exit_code
    is_slow = kernels_compiled() > compiled and not is_new  # else it was printed above
    remark = " (compiled kernels: the next such render starts faster)" if is_slow else ""
    report.end(f"{output}: {job.spp} spp in {job.seconds:.1f} s{remark}", **figures)
    return 1 if bad else 0
