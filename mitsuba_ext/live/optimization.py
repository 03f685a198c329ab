"""Shows an optimization while it runs: its loss, the noise of its gradients, and its images."""

from __future__ import annotations

import io
import math
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The weight of earlier steps in the moments of gradients: a mean over about ten steps.
_KEPT = 0.9

#: The least time between two pictures in a notebook, in seconds.
_PERIOD = 2.0


class OptimizationProgress:
    """A progress bar for the steps of an optimization, and plots of what has happened. ::

        progress = OptimizationProgress(optimizer, 250)
        for step in progress:
            parameters.update(optimizer)
            image = mi.render(scene, parameters, integrator=integrator, seed=step, spp=2)
            loss = dr.mean(dr.square(image - target), axis=None)
            dr.backward(loss)
            progress.add(loss, image)
            optimizer.step()
        progress.plot().savefig("optimization.png")

    In a terminal, it prints one line. In a notebook, it also shows the plots, which are redrawn
    every two seconds; a cell that ends with ``progress`` shows them again.

    *Noise* is the standard deviation of the gradients between steps, divided by their mean, over
    about ten steps and all elements of all parameters (the root of the sum of the squares of each).
    Above 1, a step has more noise than gradient, as always near the optimum, where gradients
    vanish. Before, more samples, a smaller learning rate, or ``control_variate`` may help.

    Parameters:
        optimizer: The optimizer, such as ``mi.ad.Adam``, with its parameters.
        steps: Number of steps.
        quiet: Whether nothing is printed.

    Attributes:
        losses: The loss of each step.
        noises: The noise of the gradients at each step; NaN at the first step, and where there are
            no gradients.
        seconds: The time since the first step, after each step.
        image: The last image that was added.
    """

    def __init__(self, optimizer: Any, steps: int, quiet: bool = False) -> None:
        if steps < 1:
            raise ValueError(f'OptimizationProgress: "steps" is {steps}; it must be at least 1')
        self._optimizer, self._steps, self._quiet = optimizer, steps, quiet
        self.losses: list[float] = []
        self.noises: list[float] = []
        self.seconds: list[float] = []
        self.image: mi.TensorXf | None = None
        self._first: mi.TensorXf | None = None
        self._moments: dict[str, tuple[Any, Any]] = {}
        self._begin = self._drawn = time.monotonic()
        self._display: Any = None

    def __iter__(self) -> Iterator[int]:
        """The numbers of the steps."""
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeRemainingColumn(),
                   TextColumn("{task.description}"))  # fmt: skip
        self._begin = time.monotonic()
        with Progress(*columns, disable=self._quiet) as bar:
            task = bar.add_task("", total=self._steps)
            for step in range(self._steps):
                yield step
                bar.update(task, advance=1, description=self._described())
                self._draw(is_last=step + 1 == self._steps)

    def add(self, loss: Any, image: mi.TensorXf | None = None) -> None:
        """Adds a step: after ``dr.backward``, and before ``optimizer.step()``, which clears the
        gradients. Waits until the step is computed.

        Parameters:
            loss: A number.
            image: The image of the step, or one of them; ``None`` to show none.
        """
        self.losses.append(float(np.array(dr.detach(loss)).ravel()[0]))
        self.noises.append(self._noise())
        self.seconds.append(time.monotonic() - self._begin)
        if image is not None:
            self.image = dr.detach(image)
            self._first = self.image if self._first is None else self._first

    def plot(self) -> Figure:
        """The loss and the noise of the gradients over the steps, and the first and the last
        image, as a figure of matplotlib."""
        from matplotlib.figure import Figure

        images = [] if self.image is None else [self._first, self.image]
        figure = Figure(figsize=(7 + 2 * len(images), 2.6), layout="constrained")
        axes = figure.subplots(1, 2 + len(images))
        for axis, name, values in zip(axes, ("loss", "noise"), (self.losses, self.noises)):
            axis.plot(np.arange(1, len(values) + 1), values)
            if any(value > 0 for value in values):
                axis.set_yscale("log")
            axis.set_title("noise of the gradients" if name == "noise" else name)
            axis.set_xlabel("step")
            axis.xaxis.get_major_locator().set_params(integer=True)
        for axis, name, image in zip(axes[2:], ("first image", "last image"), images):
            colours = image[..., :3] if image.shape[-1] > 3 else image  # the rest is no colour
            axis.imshow(np.squeeze(np.array(mi.util.convert_to_bitmap(colours))), cmap="gray")
            axis.set_title(name)
            axis.axis("off")
        return figure

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.plot().savefig(file, format="png", dpi=80)
        return file.getvalue()

    def _noise(self) -> float:
        means = variances = 0.0
        for key in self._optimizer.keys():
            g = dr.grad(self._optimizer[key])
            if dr.width(g) == 0:
                continue
            g = dr.ravel(g) if not dr.is_tensor_v(g) else g.array
            mean, square = self._moments.get(key, (0.0, 0.0))
            mean, square = (
                _KEPT * kept + (1 - _KEPT) * new for kept, new in ((mean, g), (square, g * g))
            )
            dr.eval(mean, square)
            self._moments[key] = mean, square
            # The moments begin with 0. Divided here, so that all steps share their kernels
            share = 1 - _KEPT ** len(self.losses)
            squared_mean = float(dr.sum(dr.square(mean))[0]) / share**2
            means += squared_mean
            variances += float(dr.sum(square)[0]) / share - squared_mean
        is_known = means > 0 and len(self.losses) > 1
        return math.sqrt(max(variances, 0) / means) if is_known else math.nan

    def _described(self) -> str:
        if not self.losses:
            return ""
        loss, noise = self.losses[-1], self.noises[-1]
        return f"loss {loss:.4g}" + ("" if math.isnan(noise) else f", noise {noise:.2g}")

    def _draw(self, is_last: bool) -> None:
        """Shows the plots in a notebook."""
        now = time.monotonic()
        if self._quiet or not self.losses or not _in_notebook():
            return
        if not is_last and now - self._drawn < _PERIOD:
            return
        from IPython.display import display

        self._drawn = now
        if self._display is None:
            self._display = display(self, display_id=True)
        else:
            self._display.update(self)


def _in_notebook() -> bool:
    """Whether this is a kernel of Jupyter."""
    module = sys.modules.get("IPython")
    shell = module.get_ipython() if module is not None else None
    return type(shell).__name__ == "ZMQInteractiveShell"
