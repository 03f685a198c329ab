"""``mitsuba-ext relight``: mixes the lights of an image after the render."""

from __future__ import annotations

from pathlib import Path

import click

from .common import FilledPath, say


@click.command(short_help="Change the brightness of lights after the render.")
@click.option(
    "-o", "--output", type=FilledPath(), metavar="FILE",
    help="Image to write: .exr, .png, .jpg, .hdr or .pfm.  [default: NAME.relit.EXT]",
)
@click.option("--denoise", is_flag=True, help="Denoise the mixed image, with the guides in IMAGE.")
@click.argument("image", type=FilledPath(), metavar="IMAGE")
@click.argument("factors", nargs=-1, metavar="NAME=FACTOR…")
def relight(image: Path, factors: tuple[str, ...], output: Path | None, denoise: bool) -> int:
    """Multiply the light of some layers of IMAGE, an EXR, by factors: one number, or three for red,
    green and blue, as in key=0.3 sky=1.5,1.4,1.2.

    Layers of lights come from a render with a channel for each light group, or for light path
    expressions: --integrator "auto:aovs=g:light_groups". Without factors, the layers of IMAGE are
    listed.
    """
    from ..images import image_files, relighting
    from ..inputs.variants import select_variant
    from ..util.errors import InputError

    numbers = dict(_factor(text) for text in factors)
    target = output or image.with_name(f"{image.stem}.relit{image.suffix}")
    if numbers and target.exists() and target.samefile(image):
        raise InputError(f"{target}: is the image itself, which is kept: choose another --output")
    select_variant("scalar_rgb")
    if not numbers:
        channels, _metadata = image_files.read_exr(image)
        for layer in relighting.layers(channels):
            say(layer, err=False)
        return 0
    image_files.check_target(target)
    relighting.relight_file(image, numbers, [target], denoise)
    say(f"{target}: {' '.join(factors)}", err=False)
    return 0


def _factor(text: str) -> tuple[str, float | list[float]]:
    from ..util.errors import InputError

    name, equals, value = text.rpartition("=")
    try:
        numbers = [float(number) for number in value.split(",")]
    except ValueError:
        numbers = []
    if not name or not equals or len(numbers) not in (1, 3) or min(numbers) < 0:
        raise InputError(
            f"{text}: must be NAME=FACTOR, with a factor of one number or three that are not "
            f"negative, such as key=0.3 or sky=1.5,1.4,1.2"
        )
    return name, numbers[0] if len(numbers) == 1 else numbers
