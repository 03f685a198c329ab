"""Renders one image of ``mitsuba-ext render``, and writes it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import denoising
from ..chosen import Chosen
from ..compare import images, machine
from ..long_renders.batch_renderer import RenderRequest
from ..variants import select_variant
from . import statistics
from .common import kernels_compiled, say
from .frames import Picture
from .long_job import LongJob, LongOptions
from .render_job import RenderJob
from .reports import Report
from .stopping import stopping


class Order(NamedTuple):
    """What all images of a call have in common; see the options."""

    scene: Path
    specification: str | None
    spp: int | None
    seconds: float | None
    size: tuple[int, int] | None
    variant: str
    denoise: bool
    threads: int | None
    long: LongOptions | None
    is_one_of_many: bool


def render_image(
    order: Order, picture: Picture, plugins: Sequence[str], report: Report
) -> int:
    """Renders an image and returns the exit code."""
    output, definitions, sensor_index, seed = picture
    images.check_target(output)
    if order.denoise:
        denoising.denoiser()
    guides = {}

    def metadata() -> dict[str, object]:
        return {
            "scene": str(order.scene),
            "scene_parameters": dict(definitions),
            "integrator": job.name,
            "parameters": job.parameters,
            "seed": seed,
            "spp": job.spp,
            "seconds": job.seconds,
            "interrupted": job.is_interrupted,
            "versions": machine.versions(),
            "statistics": job.totals.known(),
            **job.about(),
        }

    def write(target: Path, others: Mapping[str, np.ndarray] | None = None) -> None:
        images.write_film(target, job.film, metadata(), {**job.variance(), **(others or {})})

    with stopping() as stop:
        job = None
        try:
            select_variant(order.variant, plugins)
            if order.threads:
                import drjit as dr

                dr.set_thread_count(order.threads)
            compiled = kernels_compiled()
            if order.long:
                job = LongJob(
                    RenderRequest(
                        str(order.scene), order.size, definitions, order.specification,
                        sensor_index or 0, seed, order.variant, tuple(plugins),
                        threads=order.threads or 0,
                    ),
                    order.long,
                )  # fmt: skip
            else:
                chosen = Chosen.load(
                    order.scene, order.size, dict(definitions), order.specification,
                    sensor_index or 0,
                )  # fmt: skip
                job = RenderJob(chosen, seed)
            is_new = kernels_compiled() > compiled
            images.check_film(output, job.film, job.integrator.aov_names())
            for remark in job.remarks(is_sensor_chosen=sensor_index is not None):
                report.warn(remark)
            if order.denoise and (remark := denoising.remark(job.film)):
                report.warn(remark)
            if is_new:
                # The render's kernels take longer to compile, and nothing can be printed meanwhile
                report.note("compiling kernels (later renders like this one find them in a cache)")
            if order.denoise:
                guides = denoising.render_guides(job.scene, job.sensor, seed)
            # A frame that is there counts as finished
            current = (lambda: None) if order.is_one_of_many else functools.partial(write, output)
            job.run(order.spp, order.seconds, current, report)
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
        is_kept = order.long is not None and order.long.folder is not None
        if job.is_interrupted and (output.exists() or order.is_one_of_many) and not is_kept:
            target = output.with_name(f"{output.stem}.partial{output.suffix}")
        if order.denoise:
            noisy = target.with_name(f"{target.stem}.noisy.exr")
            write(noisy, guides)
            denoising.denoise_file(noisy, target, metadata())
        else:
            write(target)
        bad, pixel_count = images.count_non_finite(job.film)
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
            return stop.exit_code
    is_slow = kernels_compiled() > compiled and not is_new  # else it was printed above
    remark = " (compiled kernels: the next such render starts faster)" if is_slow else ""
    report.end(f"{output}: {job.spp} spp in {job.seconds:.1f} s{remark}", costs, **figures)
    return 1 if bad else 0
