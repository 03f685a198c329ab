"""``mitsuba-ext render``: renders a scene to an image."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Sequence
from pathlib import Path

import click

from ..inputs.names import check_integrator
from ..inputs.scene_changes import SceneChanges
from ..inputs.variants import select_variant
from ..long_renders.intervals import Interval
from ..rendering.interrupts import requests_to_keep
from ..util.parameters import MOST_SPP
from . import candidates
from .common import (
    MAX_SEED,
    MAX_THREADS,
    FilledPath,
    IntervalType,
    check_executor,
    executor_options,
    scene_options,
)
from .frames import FrameRange, Sensors, pictures
from .viewing import CommandWithTev, view_options, viewing


@click.command(cls=CommandWithTev, short_help="Render a scene to an image.")
@click.option(
    "-o", "--output", type=FilledPath(), required=True, metavar="FILE",
    help="Image to write: .exr (all channels as floats, with metadata), .hdr or .pfm (RGB as "
    "floats), .png or .jpg (8 bits: the sRGB curve, clipped at 1, no exposure or tone mapping).",
)
@click.option(
    "--integrator", "specification", metavar="INTEGRATOR", shell_complete=candidates.integrators,
    help="Integrator to use instead of the scene's: NAME[:key=value,…], or an XML or JSON file. It "
    "inherits max_depth and rr_depth of the scene's integrator unless it sets them. 'scene' is the "
    "scene's own.  [default: the scene's, but auto if that is path or if there is none]",
)
@click.option(
    "--spp", type=click.IntRange(1, MOST_SPP), metavar="N",
    help="Samples per pixel, instead of the scene's.",
)
@click.option(
    "--time", "seconds", type=click.FloatRange(min=0, min_open=True), metavar="S",
    help="Take as many samples as fit into S seconds of rendering. The first samples measure the "
    "speed, with Mitsuba's integrators and with ours that learn (whose kernels are then "
    "compiled within S). With others, and with structured samplers, a few short renders measure "
    "it, which takes additional time.",
)
@click.option(
    "--seed", type=click.IntRange(0, MAX_SEED), default=0, metavar="N",
    show_default=True, help="Seed of the random numbers.",
)
@click.option(
    "-s", "--sensor", "sensors", type=Sensors(), metavar="N,…|all",
    help="Sensors to render, counted from 0. Several images are named NAME.sensorN.EXT. [default: "
    "the first]",
)
@click.option(
    "--frames", type=FrameRange(), metavar="A:B",
    help="Render the frames A to B, both included, to image.####.exr. In -D, {…} is an expression "
    "of frame: -D 'angle={3.6 * frame}'. Existing frames are skipped. Frame n has the seed N + "
    "n.",
)
@click.option(
    "--parameters", metavar="FILE.py:FUNCTION", shell_complete=candidates.modules,
    help="With --frames: a Python function of the frame's number that returns a dict of the "
    "frame's parameters. Keys with a dot are keys of mi.traverse, set without loading the scene "
    "again; others are $KEY parameters of the scene file.",
)
@click.option(
    "--checkpoint", type=FilledPath(), metavar="DIR", shell_complete=candidates.folders,
    help="A folder in which the render is saved. The same command continues it. With several "
    "frames or sensors, each has a subfolder.",
)
@click.option(
    "--every", type=IntervalType(), default="60s", metavar="TIME", show_default=True,
    help="How often --checkpoint saves the render and writes FILE, and --preview is written: 60s, "
    "10m, 2h or 100spp.",
)
@click.option(
    "--preview", type=FilledPath(), metavar="FILE",
    help="A second image, such as a .png, that shows the unfinished render: after the first batch, "
    "and then each --every. With several frames or sensors, it shows the one being rendered.",
)
@click.option(
    "--add", type=click.IntRange(1, MOST_SPP), metavar="N",
    help="With --checkpoint: samples per pixel to add to the samples in the folder.",
)
@click.option(
    "--until", type=click.FloatRange(min=0, min_open=True), metavar="RELMSE",
    help="End when the relative error, estimated from the variance of the batches, reaches RELMSE. "
    "--spp and --time limit it.",
)
@executor_options("Render")
@click.option(
    "--denoise", is_flag=True,
    help="Denoise the image at the end, guided by the albedo and the normals of visible surfaces. "
    "The noisy image is kept in NAME.noisy.exr.",
)
@view_options("the render")
@click.option("--quiet", is_flag=True, help="Show only warnings and errors.")
@click.option(
    "--json", "as_json", is_flag=True,
    help="Print JSON objects to stdout, one per line: progress events, warnings, and the end.",
)
@click.option(
    # With one thread, Mitsuba 3.9.1 deadlocks when it reads or writes an EXR file
    "--threads", type=click.IntRange(2, MAX_THREADS), metavar="N",
    help="Threads of each process, from 2 to 1024.  [default: all cores, divided among --workers]",
)
@scene_options
@click.argument("scene", type=FilledPath(), shell_complete=candidates.scenes)
def render(
    scene: Path,
    output: Path,
    specification: str | None,
    spp: int | None,
    seconds: float | None,
    seed: int,
    sensors: tuple[int, ...] | None,
    frames: range | None,
    parameters: str | None,
    checkpoint: Path | None,
    every: Interval,
    preview: Path | None,
    add: int | None,
    until: float | None,
    workers: int | None,
    dask: str | None,
    denoise: bool,
    tev: str | None,
    port: int | None,
    control: bool,
    quiet: bool,
    as_json: bool,
    threads: int | None,
    size: tuple[int, int] | None,
    crop: tuple[int, int, int, int] | None,
    rfilter: str,
    max_depth: int | None,
    definitions: Sequence[tuple[str, str]],
    plugins: Sequence[str],
    variant: str,
) -> int:
    """Render SCENE (an XML file) to an image.

    Ctrl-C, SIGTERM and SIGHUP end the render after the running pass and keep the image so far: in
    FILE, or in NAME.partial.EXT if FILE already exists. A second signal, half a second later or
    more, ends the process at once, unless the image is being written.

    Mitsuba's own integrators render in passes. A structured sampler stratifies the samples of a
    pass (64 per pixel or more, 16 for large images), not of the whole render.

    With --checkpoint, --until, --workers, --dask or --preview, all integrators render in batches:
    independent renders with different seeds. An EXR then also holds the variance of the image.
    The other batches use what an integrator learns in the first one. SIGUSR1 saves the render after
    the running batch.
    """
    if specification and not plugins:
        check_integrator(specification)
    from ..inputs.scenes import check_scene_file

    check_scene_file(scene)
    from ..inputs.chosen import LastScene
    from .image_render import Order, is_finished, render_image
    from .long_job import LongOptions
    from .reports import Report

    report = Report(quiet, as_json)
    if add is not None and checkpoint is None:
        raise click.UsageError("--add needs --checkpoint: the folder with the samples so far")
    if add is not None and spp is not None:
        raise click.UsageError("--add and --spp cannot be combined")
    check_executor(workers, dask)
    if preview is not None and preview.absolute() == output.absolute():
        raise click.UsageError("--preview must differ from --output")
    is_long = checkpoint or until or workers or dask or preview
    if spp is not None and seconds is not None and not is_long:
        raise click.UsageError("--spp and --time cannot be combined, except in a render in batches")
    order = Order(
        scene, specification, spp, seconds, size, variant, tuple(plugins), denoise, threads,
        LongOptions(
            checkpoint, every, add, until, workers or 0, dask or "", preview is not None
        ) if is_long else None,
        is_one_of_many=frames is not None or (sensors is not None and len(sensors) != 1),
        preview=preview, changes=SceneChanges(crop, rfilter, max_depth),
    )  # fmt: skip
    if order.is_one_of_many and add is not None:
        raise click.UsageError("--add is for one image: give --spp, the total of each image")
    if parameters is not None and frames is None:
        raise click.UsageError("--parameters needs --frames")
    # Before the first batch and after the last one, SIGUSR1 is ignored: there is nothing to save
    ignored = requests_to_keep(signal.SIG_IGN) if is_long else contextlib.nullcontext()
    with report.only_events(), ignored, viewing(tev, port, control, report) as viewer:
        order = order._replace(viewer=viewer)
        function = None
        if parameters is not None:
            from .frame_parameters import load_function

            select_variant(variant, plugins)  # the function may use Mitsuba types
            plugins = ()  # already registered
            function = load_function(parameters)
        if sensors == ():
            sensors = _all_sensors(scene, definitions, variant, plugins, frames, function)
            plugins = ()
        result, scenes = 0, LastScene()
        for picture in list(pictures(output, definitions, sensors or [None], seed, frames)):
            if order.is_one_of_many and is_finished(order, picture):
                report.note(f"{picture.output}: exists already")
                continue
            code = render_image(order, picture, plugins, report, scenes, function)
            plugins = ()
            if code > 1:
                return code
            result = max(result, code)
    return result


def _all_sensors(scene, definitions, variant, plugins, frames, function) -> list[int]:
    """The indices of the scene's sensors in the first frame."""
    from ..inputs.scenes import load_scene

    select_variant(variant, plugins)
    (picture,) = pictures(Path("#"), definitions, [None], 0, frames and frames[:1])
    values = dict(picture.definitions)
    if function:
        values |= function(picture.frame).definitions
    loaded = load_scene(scene, parameters=values, keep_integrator=False)
    return list(range(len(loaded.scene.sensors())))
