"""Shows the progress of a render in batches."""

from __future__ import annotations

import time

from rich.progress import Progress

from ..long_renders.long_render import LongRender
from .reports import Report, Speed, time_left


class LongProgress:
    """Shows the samples, their speed, the error estimated from the batches, and the time left.

    Parameters:
        report: Receives the progress as events.
        bars: Show the progress on a terminal.
        name: The name of the integrator.
        pixel_count: The number of pixels of the image.
    """

    def __init__(self, report: Report, bars: Progress, name: str, pixel_count: int) -> None:
        self._report, self._bars, self._name = report, bars, name
        self._pixel_count = pixel_count
        self._bar = bars.add_task(name, total=None, left="")
        self._begin, self._speed = time.perf_counter(), Speed()

    def __call__(self, render: LongRender) -> None:
        """Shows the progress; called after each batch."""
        spp, error = render.state.spp, render.error
        text, samples, left = f"{self._name}, {spp} spp", None, None
        if (per_second := self._speed(spp)) is not None:
            samples = per_second * self._pixel_count
            text += f", {samples / 1e6:.3g} million samples/s"
            left = render.spp_left and render.spp_left / per_second
        if error is not None:
            text += f", relMSE about {error:.2g}"
        goal = render.goal_spp or None
        self._bars.update(
            self._bar, description=text, completed=spp, total=goal, left=time_left(left)
        )
        self._report.progress(
            spp=spp, goal_spp=goal, batches=len(render.state.done), relmse=error,
            samples_per_second=samples, seconds=time.perf_counter() - self._begin,
            seconds_left=left,
        )  # fmt: skip
