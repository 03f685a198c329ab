"""Renders one image of ``mitsuba-ext render``, and writes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..images import denoising, image_files
from ..images.coverage import channel_names
from ..inputs.chosen import LastScene
from ..inputs.scene_changes import SceneChanges
from ..inputs.variants import select_variant
from ..long_renders.batch_renderer import RenderRequest
from ..long_renders.folder import CheckpointFolder
from ..rendering.scene_guides import render_guides
from ..startup import machine
from ..util import marks
from ..util.errors import InputError
from . import statistics
from .common import kernels_compiled, say
from .frame_parameters import FrameParameters
from .frames import Picture
from .long_job import LongJob, LongOptions
from .render_job import RenderJob
from .reports import Report
from .stopping import stopping

if TYPE_CHECKING:
    from ..live.viewer import Viewer

#: The fraction of the requested time below which the requested time is also shown.
_USED = 0.8


class Order(NamedTuple):
    """The options shared by all images of a call."""

    scene: Path
    specification: str | None
    spp: int | None
    seconds: float | None
    size: tuple[int, int] | None
    variant: str
    plugins: tuple[str, ...]
    denoise: bool
    threads: int | None
    long: LongOptions | None
    is_one_of_many: bool
    preview: Path | None
    changes: SceneChanges
    viewer: Viewer | None = None


def is_finished(order: Order, picture: Picture) -> bool:
    """Whether nothing is left to do for one of several images."""
    if not picture.output.exists():
        return False
    long = order.long
    if long is None or long.folder is None:
        return True
    # This call may request more samples than the last one. The error is in the state
    if long.until is not None:
        return False
    return not order.spp or CheckpointFolder(long.folder / picture.name).load().spp >= order.spp


def render_image(
    order: Order, picture: Picture, plugins: Sequence[str], report: Report, scenes: LastScene,
    function: Callable[[int], FrameParameters] | None = None,
) -> int:  # fmt: skip
    """Renders an image and returns the exit code.

    Args:
        order: The options shared by all images of the call.
        picture: The image to render.
        plugins: Modules to import, which register other plugins.
        report: Shows the progress and the end of the render.
        scenes: Keeps the loaded scene for the next image.
        function: Returns the changes that the frame with a given number makes to the scene.

    Raises:
        InputError: An input cannot be read or used, or a file cannot be written. If samples already
            exist, their image is written.
    """
    output, definitions, sensor_index, seed = picture[:4]
    values, long = None, order.long
    if function is not None:
        changed = function(picture.frame)
        definitions = tuple((dict(definitions) | changed.definitions).items())
        values = changed.values
    if long and long.folder and picture.name:
        long = replace(long, folder=long.folder / picture.name)
    for file in filter(None, (output, order.preview)):
        image_files.check_target(file)
    if order.denoise:
        image_files.check_target(_noisy(output))
        denoising.denoiser()
    guides = {}
    remarks: list[str] = []

    def metadata() -> dict[str, object]:
        return {
            "scene": str(order.scene),
            "scene_parameters": dict(definitions),
            **({"scene_values": values} if values else {}),
            **({"changes": changed} if (changed := order.changes.described()) else {}),
            "integrator": job.name,
            "parameters": job.parameters,
            "seed": seed,
            "spp": job.spp,
            "seconds": job.seconds,
            "interrupted": job.is_interrupted,
            **({image_files.REMARKS: remarks} if remarks else {}),
            "versions": machine.versions(),
            "statistics": job.totals.known(),
            **job.about(),
        }

    def write(
        target: Path, others: Mapping[str, np.ndarray] | None = None, is_final: bool = True
    ) -> None:
        layers, about = {**job.variance(), **(others or {})}, metadata()
        if job.coverage is not None:
            layers.update(job.coverage.channels(job.integrator.masks))
            about.update(job.coverage.metadata(job.integrator.masks))
        # The render waits while an unfinished image is written, so do not compress it
        image_files.write_film(target, job.film, about, layers, is_compressed=is_final)

    def show(is_asked: bool) -> None:
        if is_asked or (long and long.folder):
            # An existing file counts as a finished frame, so the unfinished image has another name
            write(picture.unfinished if order.is_one_of_many else output, is_final=False)
        if order.preview:
            image_files.write_film(order.preview, job.film, metadata())

    report.image = {}
    if picture.name:
        report.image = {"file": str(output), "frame": picture.frame, "sensor": picture.sensor}
    with marks.written_alone(output), stopping() as stop:
        job = None
        try:
            select_variant(order.variant, plugins)
            if order.threads:
                import drjit as dr

                dr.set_thread_count(order.threads)
            compiled = kernels_compiled()
            if long:
                job = LongJob(
                    RenderRequest(
                        str(order.scene), order.size, definitions, order.specification,
                        sensor_index or 0, seed, order.variant, order.plugins,
                        threads=order.threads or 0, values=values, changes=order.changes,
                    ),
                    long, scenes,
                )  # fmt: skip
            else:
                chosen = scenes.choose(
                    order.scene, order.size, dict(definitions), order.specification,
                    sensor_index or 0, values, changes=order.changes,
                )  # fmt: skip
                job = RenderJob(chosen, seed)
            is_new = kernels_compiled() > compiled
            masks = channel_names(getattr(job.integrator, "masks", ()))
            _look_at(job)
            for file in filter(None, (output, order.preview)):
                image_files.check_film(file, job.film, [*job.integrator.aov_names(), *masks])
            if masks and output.suffix.lower() != ".exr":
                report.warn(f"{output}: only an .exr can hold masks")
            if job.chosen.note:
                report.note(job.chosen.note)
            remarks += job.chosen.remarks(is_sensor_chosen=sensor_index is not None)
            for remark in remarks:
                report.warn(remark)
            if order.denoise and (remark := denoising.remark(job.film)):
                report.warn(remark)
            if order.viewer:
                job.viewer = order.viewer
                order.viewer.begin(
                    order.scene.stem, _facts(order, picture, job),
                    getattr(job.integrator, "film_counts_samples", True),
                )  # fmt: skip
            if is_new:
                # The render's kernels take longer to compile, and nothing can be printed meanwhile
                report.note("compiling kernels (later renders like this one find them in a cache)")
            if order.denoise:
                guides = render_guides(job.scene, job.sensor, seed)
            job.run(order.spp, order.seconds, show, report)
        except (KeyboardInterrupt, Exception) as error:
            # After SIGHUP, showing progress on the closed terminal raises an OSError. If a signal
            # interrupts loading the scene, Mitsuba reports an error of a plugin
            is_of_signal = isinstance(error, OSError) or job is None or not job.has_image()
            if not isinstance(error, KeyboardInterrupt) and not (stop.is_asked and is_of_signal):
                raise
            if job is None or not job.has_image():
                say("interrupted before there was an image: nothing written")
                return stop.exit_code
            # After a signal in the last pass, the image may be complete
            job.is_interrupted = not job.is_complete()

        stop.wait()
        if order.viewer:
            job.show(order.viewer)
            order.viewer.is_interrupted = job.is_interrupted
        target = output
        is_kept = long is not None and long.folder is not None and not order.is_one_of_many
        if job.is_interrupted and (output.exists() or order.is_one_of_many) and not is_kept:
            target = picture.unfinished
        if order.denoise:
            noisy = _noisy(target)
            write(noisy, guides)
            denoising.denoise_file(noisy, filter(None, (target, order.preview)), metadata())
        else:
            write(target)
            if order.preview:
                image_files.write_film(order.preview, job.film, metadata())
        if order.is_one_of_many and target == output:
            picture.unfinished.unlink(missing_ok=True)
        bad, pixel_count = image_files.count_non_finite(job.film)
        if bad:
            report.warn(f"{bad} of {pixel_count} pixels of {target} are NaN or infinite")
        figures = {
            "file": str(target), "spp": job.spp, "seconds": job.seconds, "bad_pixels": bad,
            "statistics": {
                "integrator": job.name, "seeds": job.seeds, "versions": machine.versions(),
                **job.totals.known(),
            },
        }  # fmt: skip
        costs = statistics.lines(job.totals, job.name, job.seeds, machine.versions())
        if job.is_interrupted:
            older = "" if target == output else f" ({output} is an older image, and was kept)"
            older = older if output.exists() else ""
            said = f"interrupted {job.how_far()}: {target}{older}"
            report.end(said, costs, is_interrupted=True, **figures)
            if job.failure:
                raise job.failure
            return stop.exit_code
    count = 0 if is_new else kernels_compiled() - compiled  # otherwise it was printed above
    kernels = f"{count} kernel{'' if count == 1 else 's'}"
    remark = f" (compiled {kernels}: the next such render starts faster)" if count else ""
    asked = None if long else order.seconds
    # Time is left if more samples would have exceeded it
    of = f" of {asked:g}" if asked and job.seconds < _USED * asked else ""
    report.end(f"{output}: {job.spp} spp in {job.seconds:.1f}{of} s{remark}", costs, **figures)
    if job.failure:
        raise job.failure
    return 1 if bad else 0


def _noisy(path: Path) -> Path:
    """The file of the image before denoising."""
    return path.with_name(f"{path.stem}.noisy.exr")


def _facts(order: Order, picture: Picture, job: RenderJob | LongJob) -> dict[str, str]:
    """What a viewer says of the image."""
    parameters = ", ".join(f"{key} {value}" for key, value in job.parameters.items())
    return {
        "title": picture.output.name,
        "Scene": str(order.scene),
        "Integrator": f"{job.name}{f' ({parameters})' if parameters else ''}",
        "Seed": str(picture.seed),
        **({"Frame": str(picture.frame)} if picture.frame is not None else {}),
        **({"Sensor": str(picture.sensor)} if picture.sensor is not None else {}),
        "Variant": order.variant,
    }


def _look_at(job: LongJob | RenderJob) -> None:
    """Tells the integrator the scene, on which the names of its channels depend.

    Raises:
        InputError: The channels that it should render are not possible in this scene.
    """
    if hasattr(job.integrator, "look_at"):
        try:
            job.integrator.look_at(job.chosen.scene)
        except ValueError as error:
            raise InputError(f"{job.chosen.loaded.source}: {error}") from error
