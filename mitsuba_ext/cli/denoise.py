"""``mitsuba-ext denoise``: denoises an image."""

from __future__ import annotations

from pathlib import Path

import click

from .common import FilledPath, say


@click.command(short_help="Denoise an image.")
@click.option(
    "-o", "--output", type=FilledPath(), metavar="FILE",
    help="Image to write: .exr, .png, .jpg, .hdr or .pfm.  [default: NAME.denoised.EXT]",
)
@click.argument("image", type=FilledPath(), metavar="IMAGE")
def denoise(image: Path, output: Path | None) -> int:
    """Denoise IMAGE with Open Image Denoise (pip install 'mitsuba_ext[denoise]').

    It is guided by the layers of an EXR whose names end with "albedo" and "normal", such as those
    of --integrator "aov:aovs=albedo:albedo,normal:sh_normal,img=[path]".
    """
    from ..images import image_files
    from ..images.denoising import denoise_file, denoiser
    from ..inputs.variants import select_variant
    from ..util.errors import InputError

    target = output or image.with_name(f"{image.stem}.denoised{image.suffix}")
    if target.exists() and target.samefile(image):
        raise InputError(f"{target}: is the image itself, which is kept: choose another --output")
    image_files.check_target(target)
    denoiser()
    select_variant("scalar_rgb")
    guides = denoise_file(image, [target], {})
    say(f"{target}: guided by {' and '.join(guides) or 'nothing but the image'}", err=False)
    return 0
