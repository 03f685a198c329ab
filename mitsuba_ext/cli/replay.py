"""``mitsuba-ext replay``: shows the paths behind the pixels of a render."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..inputs.names import check_integrator
from ..inputs.scene_changes import SceneChanges
from ..inputs.variants import select_variant
from ..util.parameters import MOST_SPP
from . import candidates
from .common import (
    MAX_SEED,
    MAX_THREADS,
    FilledPath,
    PixelType,
    console_for_tables,
    say,
    scene_options,
)

if TYPE_CHECKING:
    import numpy as np

    from ..inputs.chosen import Chosen
    from ..replay import FoundLight, PathVertex, PixelPaths, SamplePath

#: The integrator and the samples per pixel of the image under a picture, if there is no other.
_BACKGROUND, _BACKGROUND_SPP = "composed_path", 16


@click.command(short_help="Show the paths behind bright pixels.")
@click.option(
    "--pixel", "pixels", type=PixelType(), multiple=True, metavar="X,Y",
    help="A pixel of the image: column and row, counted from 0 in the upper left corner (of the "
    "crop window, with --crop). Can be repeated.",
)
@click.option(
    "--brightest", type=click.IntRange(1, 64), metavar="N",
    help="Instead of --pixel: render, and show the N pixels that a single sample brightens most.  "
    "[default: 1 without --pixel]",
)
@click.option(
    "--top", type=click.IntRange(1, 1000), default=3, metavar="K", show_default=True,
    help="The number of samples to show of each pixel.",
)
@click.option(
    "--integrator", "specification", metavar="INTEGRATOR", shell_complete=candidates.integrators,
    help="The integrator that has rendered the image; see 'mitsuba-ext render --help'.  [default: "
    "as there]",
)
@click.option(
    "--spp", type=click.IntRange(1, MOST_SPP), metavar="N",
    help="Samples per pixel of the render.  [default: the scene's]",
)
@click.option(
    "--seed", type=click.IntRange(0, MAX_SEED), default=0, metavar="N", show_default=True,
    help="Seed of the render.",
)
@click.option(
    "-s", "--sensor", type=click.IntRange(min=0), default=0, metavar="N", show_default=True,
    help="The sensor, counted from 0.",
)
@click.option(
    "-o", "--output", type=FilledPath(), metavar="FILE",
    help="Draw the paths over the image, in this .png, .jpg, .svg or .pdf.",
)
@click.option(
    "--image", type=FilledPath(), metavar="FILE",
    help="The image under the paths.  [default: the image that --brightest renders; with --pixel, "
    f"{_BACKGROUND_SPP} samples per pixel of {_BACKGROUND}]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for scripts.")
@click.option(
    "--threads", type=click.IntRange(2, MAX_THREADS), metavar="N",
    help="Threads of the process, from 2 to 1024.  [default: all cores]",
)
@scene_options
@click.argument("scene", type=FilledPath(), shell_complete=candidates.scenes)
def replay(
    scene: Path,
    pixels: tuple[tuple[int, int], ...],
    brightest: int | None,
    top: int,
    specification: str | None,
    spp: int | None,
    seed: int,
    sensor: int,
    output: Path | None,
    image: Path | None,
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
    """Show the brightest samples of pixels of SCENE, and the vertices of their paths.

    They are the samples of 'mitsuba-ext render' with the same options (without --time, --checkpoint
    and others that render in batches), taken again with the same random numbers. Samples belong to
    the pixel in which they begin: with a reconstruction filter wider than a pixel, the image also
    has a share of their neighbours' samples.
    """
    if pixels and brightest:
        raise click.UsageError("--pixel and --brightest cannot be combined")
    if image is not None and output is None:
        raise click.UsageError("--image needs --output, the picture to draw")
    if specification and not plugins:
        check_integrator(specification)
    from ..inputs.scenes import check_scene_file

    check_scene_file(scene)
    from ..inputs.chosen import LastScene
    from ..util.errors import InputError, one_line

    select_variant(variant, plugins)
    if threads:
        import drjit as dr

        dr.set_thread_count(threads)
    chosen = LastScene().choose(
        scene, size, dict(definitions), specification, sensor,
        changes=SceneChanges(crop, rfilter, max_depth),
    )  # fmt: skip
    if chosen.note:
        say(chosen.note)
    from .. import replay as replaying

    try:
        background = _prepared(chosen, output, image)
        found, rendered = _replayed(chosen, pixels, brightest or 1, top, seed, spp or 0)
        if output is not None:
            if background is None:
                background = _background(chosen) if rendered is None else rendered
            replaying.draw_paths(output, background, chosen.scene, chosen.sensor, found)
    except InputError:
        raise
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{chosen.loaded.source}: {one_line(error)}") from error
    if as_json:
        about = {"scene": str(scene), "integrator": chosen.named.name, "seed": seed}
        record = {**about, "pixels": [pixel.as_dict() for pixel in found]}
        click.echo(json.dumps(_without_nan(record), allow_nan=False))
        return 0
    if not found:
        say("no pixel stands out: the samples of each pixel are equally bright", err=False)
    for pixel in found:
        _print(pixel)
    if output is not None:
        say(str(output), err=False)
    return 0


def _prepared(chosen: Chosen, output: Path | None, image: Path | None) -> np.ndarray | None:
    """The image under the paths, if a file has it; checked, with the target, before anything is
    rendered."""
    if output is None:
        return None
    from ..images.reading import read_image
    from ..replay.drawing import check_picture
    from ..util.errors import InputError

    check_picture(output, chosen.sensor)
    if image is None:
        return None
    pixels, (width, height) = read_image(image)[0], chosen.sensor.film().crop_size()
    if pixels.shape[:2] != (height, width):
        raise InputError(
            f"{image}: has {pixels.shape[1]}x{pixels.shape[0]} pixels, and the render "
            f"{width}x{height}: give the image of this render, or its --size"
        )
    return pixels


def _replayed(
    chosen: Chosen, pixels: Sequence[tuple[int, int]], brightest: int, top: int, seed: int,
    spp: int,
) -> tuple[list[PixelPaths], np.ndarray | None]:  # fmt: skip
    """The paths of the pixels, or of the brightest ones if there are none; and the image if it was
    rendered."""
    from .. import replay as replaying

    what = chosen.scene, chosen.named.integrator, chosen.sensor, seed, spp
    scene, *others = what
    rendered = None
    if not pixels:
        pixels, rendered = replaying.bright_pixels(scene, brightest, *others, in_passes=True)
    if not pixels:
        return [], rendered
    return replaying.paths_of_pixels(scene, pixels, *others, top, in_passes=True), rendered


def _background(chosen: Chosen) -> np.ndarray:
    import mitsuba as mi

    from ..images.image_files import film_channels, to_rgb

    integrator = mi.load_dict({"type": _BACKGROUND, **chosen.loaded.settings})
    image = integrator.render(chosen.scene, chosen.sensor, spp=_BACKGROUND_SPP)
    return to_rgb(image, film_channels(chosen.sensor.film()))


def _without_nan(value: Any) -> Any:
    """The value with ``None`` for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# ---- Tables ----


def _print(pixel: PixelPaths) -> None:
    from rich import box
    from rich.table import Table

    console = console_for_tables()
    x, y = pixel.pixel
    console.print(
        f"pixel {x},{y}: {_numbers(pixel.value)} from {pixel.spp} "
        f"sample{'' if pixel.spp == 1 else 's'}", style="bold", highlight=False,
    )  # fmt: skip
    for path in pixel.paths:
        table = Table(
            "", "event", "shape", "BSDF", "position", "throughput", "pdf", "roulette",
            "light found by", "light", "pdf", "MIS", "radiance", title=_title(path),
            title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0),
        )  # fmt: skip
        for row in _rows(path):
            table.add_row(*row)
        console.print(table, highlight=False)


def _title(path: SamplePath) -> str:
    what = "a light path" if path.sample is None else f"sample {path.sample}"
    nm = f", wavelengths {_numbers(path.wavelengths)} nm" if path.wavelengths else ""
    return f"{what}: {_numbers(path.radiance)}, {100 * path.share:.3g} % of the pixel{nm}"


def _rows(path: SamplePath) -> Iterator[list[str]]:
    for number, vertex in enumerate(path.vertices, start=1):
        first = [
            str(number), *_event(vertex), _numbers(vertex.position),
            _number(max(vertex.throughput, default=0.0)), _number(vertex.pdf),
            "" if vertex.survival == 1 else _number(vertex.survival),
        ]  # fmt: skip
        yield from _with_lights(first, vertex.lights)
    if path.lights:
        yield from _with_lights([""] * 8, path.lights)


def _event(vertex: PathVertex) -> list[str]:
    if vertex.kind == "surface":
        return [vertex.event, vertex.shape, vertex.bsdf]
    return [vertex.event, vertex.kind, ""]


def _with_lights(first: list[str], lights: Sequence[FoundLight]) -> Iterator[list[str]]:
    """Rows that begin with ``first``: one for each light, and one for all merges."""
    merges = [light for light in lights if light.technique == "merge"]
    rows = [_light(light) for light in lights if light.technique != "merge"]
    if merges:
        total = [sum(channel) for channel in zip(*(light.radiance for light in merges))]
        rows.append([f"{len(merges)} merges", "", "", "", _numbers(total)])
    for row in rows or [[""] * 5]:
        yield [*first, *row]
        first = [""] * len(first)


def _light(light: FoundLight) -> list[str]:
    technique = light.technique
    if light.light_vertices is not None:
        technique += f" of {light.light_vertices} vertices"
    return [
        technique, light.light, _number(light.pdf), _number(light.mis), _numbers(light.radiance)
    ]


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(_number, values))
