"""The command ``mitsuba-ext``: render, compare, list, doctor.

Mitsuba's own command cannot load plugins written in Python. Exit codes: 0, 1 (a comparison in which
an integrator failed, a problem that the doctor found), 2 (bad input: one line on stderr), 130
(Ctrl-C).
"""

from __future__ import annotations

import contextlib
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import __version__

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

INTERRUPTED = 130

_MAX_SEED = 2**32 - 1

#: Width of tables that go to a file or a pipe, where there is no terminal to ask.
_PIPE_WIDTH = 160


class _Size(click.ParamType):
    name = "size"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)x(\d+)", value)
        if not match or not int(match.group(1)) or not int(match.group(2)):
            self.fail(f'expected something like 640x360, found "{value}"', param, ctx)
        return int(match.group(1)), int(match.group(2))


class _Definition(click.ParamType):
    name = "key=value"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, str]:
        key, equals, text = value.partition("=")
        if not key or not equals:
            self.fail(f'expected key=value, found "{value}"', param, ctx)
        return key, text


def _scene_options(command: Callable) -> Callable:
    """What ``render`` and ``compare`` share."""
    for decorator in (
        click.option(
            "--size", type=_Size(), metavar="WxH",
            help="Size of the image, instead of the film's.",
        ),
        click.option(
            "-D", "definitions", type=_Definition(), multiple=True, metavar="KEY=VALUE",
            help="A $KEY parameter of the scene file. Can be repeated.",
        ),
        click.option(
            "--variant", default="llvm_ad_rgb", show_default=True, help="Mitsuba's variant."
        ),
        click.argument("scene", type=click.Path(path_type=Path)),
    ):
        command = decorator(command)
    return command


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="mitsuba-ext")
def cli() -> None:
    """Light transport techniques for Mitsuba 3."""


@cli.command(short_help="Render a scene to an image.")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, metavar="FILE",
    help="Image to write: .exr (float, with metadata), .png, .jpg, .hdr or .pfm.",
)
@click.option(
    "--integrator", "specification", metavar="NAME[:key=value,…]",
    help="Use this integrator instead of the scene's. It takes over max_depth and rr_depth "
    "from there unless it sets them.",
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
    "--seed", type=click.IntRange(0, _MAX_SEED), default=0, metavar="N",
    show_default=True, help="Seed of the random numbers.",
)
@_scene_options
def render(
    scene: Path,
    output: Path,
    specification: str | None,
    spp: int | None,
    seconds: float | None,
    seed: int,
    size: tuple[int, int] | None,
    definitions: Sequence[tuple[str, str]],
    variant: str,
) -> int:
    """Render SCENE (an XML file) to an image."""
    from .compare import images, machine, timing
    from .scenes import InputError, load_scene, make_integrator, one_line, parse_integrator

    if spp is not None and seconds is not None:
        raise click.UsageError("--spp and --time exclude each other")
    images.check_target(output)
    name, parameters = parse_integrator(specification) if specification else ("", {})
    _select(variant)
    loaded = load_scene(scene, size, dict(definitions), keep_integrator=not specification)
    if specification:
        integrator, parameters = make_integrator(name, parameters, inherited=loaded.depth)
    else:
        integrator, name = loaded.scene.integrator(), loaded.integrator_name
        parameters = dict(loaded.depth)
    if integrator is None:
        raise InputError(f"{scene}: the scene has no integrator: name one with --integrator")

    film = loaded.scene.sensors()[0].film()
    interrupted = measuring = False
    start = time.perf_counter()
    try:
        with _progress() as progress:
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
        "spp": report.spp if report else timing.sample_count(loaded.scene, spp or 0),
        "seconds": elapsed,
        "versions": machine.versions(),
    }
    images.write_film(output, film, metadata)
    if interrupted:
        click.echo(f"interrupted: {output} has the samples so far", err=True)
        return INTERRUPTED
    click.echo(f"{output}: {metadata['spp']} spp in {elapsed:.1f} s")
    return 0


@cli.command(short_help="Measure the speed and the error of integrators on a scene.")
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
@_scene_options
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
    from .compare import Experiment, images, load_reference, render_reference, tables
    from .scenes import load_scene

    if reference_file and reference_spp:
        raise click.UsageError("--reference and --reference-spp exclude each other")
    _select(variant)
    loaded = load_scene(scene, size, dict(definitions), keep_integrator=False)
    experiment = Experiment(loaded, integrators, spp, range(seeds))
    reference = load_reference(reference_file, loaded.size) if reference_file else None
    _make_folder(out)
    images.check_folder(out)

    interrupted = False
    try:
        with _progress() as progress:
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

    console = _console()
    console.print(tables.table(experiment))
    console.print(tables.footnote(experiment), highlight=False, markup=False, soft_wrap=True)
    tables.write_results(out / "results.json", experiment)
    console.print(f"{out / 'results.json'}", highlight=False, markup=False, soft_wrap=True)
    if interrupted:
        click.echo("interrupted: the results are of the finished runs", err=True)
        return INTERRUPTED
    return 1 if any(contender.error for contender in experiment.contenders) else 0


@cli.command("list", short_help="Show the plugins, or the parameters of one.")
@click.argument("name", required=False)
def list_plugins(name: str | None) -> int:
    """Show the plugins, or the page of the plugin NAME."""
    from rich.table import Table

    from . import pages, registry

    files = {kind: registry.plugin_files(kind) for kind in registry.plugin_names()}
    console = _console()
    if name is None:
        overview = Table("plugin", "kind", "what it does")
        for kind, paths in files.items():
            for path in paths:
                page = pages.read_page(path)
                overview.add_row(page.name, kind[:-1], page.title or page.summary)
        console.print(overview)
        return 0
    file = next((path for paths in files.values() for path in paths if path.stem == name), None)
    if file is None:
        known = ", ".join(sorted(path.stem for paths in files.values() for path in paths))
        raise click.UsageError(f'no plugin "{name}" (there are: {known})')
    page = pages.read_page(file)
    if page.title:
        console.print(page.title, style="bold", highlight=False, markup=False)
    if page.parameters:
        parameters = Table("parameter", "type", "default", "description")
        for parameter in page.parameters:
            parameters.add_row(
                parameter.name, parameter.type, parameter.default or "–", parameter.description
            )
        console.print(parameters)
    console.print(page.text, highlight=False, markup=False)
    return 0


@cli.command(short_help="Check the installation.")
def doctor() -> int:
    """Check Mitsuba's version, the LLVM library, and a small render."""
    from . import doctor as doctor_module

    return doctor_module.main()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code."""
    from .scenes import InputError

    try:
        code = cli.main(arguments, prog_name="mitsuba-ext", standalone_mode=False)
    except click.Abort:
        click.echo("interrupted", err=True)
        return INTERRUPTED
    except click.ClickException as error:
        if not list(sys.argv[1:] if arguments is None else arguments):
            error.show()  # the help: nothing was asked for
        else:
            _complain(error.format_message())
        return 2
    except InputError as error:
        _complain(str(error))
        return 2
    except BrokenPipeError:
        return 1
    except OSError as error:  # a full disk, a folder that went away
        _complain(str(error))
        return 2
    return code if isinstance(code, int) else 0


def _complain(message: str) -> None:
    click.echo(f"mitsuba-ext: {' '.join(message.split())}", err=True)


def _select(variant: str) -> None:
    import mitsuba as mi

    from .scenes import InputError, one_line

    if variant not in mi.variants():
        raise InputError(f'unknown variant "{variant}" (there are: {", ".join(mi.variants())})')
    try:
        mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        raise InputError(f'the variant "{variant}" does not start: {one_line(error)}') from error


def _make_folder(folder: Path) -> None:
    from .scenes import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error


def _film_is_prepared(film: Any) -> bool:
    try:
        film.develop()
    except RuntimeError:
        return False
    return True


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    """A progress bar on stderr, if that is a terminal."""
    from rich import progress as bars
    from rich.console import Console

    terminal = sys.stderr.isatty()
    console = Console(stderr=True, quiet=not terminal)
    columns = (
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.TimeElapsedColumn(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(
        *columns, console=console, disable=not terminal, transient=True
    ) as progress:
        yield progress


def _console() -> Console:
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)


if __name__ == "__main__":
    sys.exit(main())
