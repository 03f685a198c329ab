"""The base class of our integrators that render in stages: the methods that Mitsuba calls, and
errors in the place of Mitsuba's where those are cryptic.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images.coverage import Coverage, channel_names
from ..long_renders.intervals import Interval
from ..rendering import camera
from ..rendering import render as rendering
from ..rendering.device import SampleBytes
from ..rendering.interrupts import interrupted
from ..rendering.request import Request, Watch
from ..rendering.stages import Learning, Schedule, Stage
from ..rendering.statistics import RenderStatistics
from ..rendering.turns import in_turn
from ..startup.registry import variant_bound
from ..util.errors import did_you_mean
from ..util.parameters import read_parameter

#: Stands for "no limit" in counts.
NO_LIMIT = 0xFFFFFFFF

#: Parameters on which the image of a checkpointed render does not depend.
_NOT_OF_THE_IMAGE = ("timeout", "checkpoint", "checkpoint_every")


@variant_bound
class StagedIntegrator(mi.SamplingIntegrator):
    """An integrator that renders in stages and passes (``render.py``).

    .. pluginparameters::

     * - timeout
       - |float|
       - Seconds after which to stop, learning and compilation included; 0 or less for no limit. The
         number of samples follows from the speed of the first passes (short ones, until one
         compiles nothing, and then one of a quarter of the time left), and not from the clock, so
         that stopping does not prefer fast samples. Pilots get at most a quarter of the samples
         that fit. Learning ends when it has taken a third of the time. It does not begin in renders
         of about a second, nor where compiling its kernels would take longer than that. The limit
         is met as closely as the speed is steady; a short pass of each pilot that has begun, and
         one of the last stage, are always rendered. (Default: -1)

     * - checkpoint
       - |string|
       - A folder in which the render is saved: a second render (of the same scene, seed and
         parameters) continues from there, up to ``spp``, which may be higher than before. It
         renders in batches, as ``mitsuba-ext render --checkpoint`` does. Only the outermost
         integrator can have it. (Default: none)
     * - checkpoint_every
       - |string|
       - How often it is saved: :monosp:`60s`, :monosp:`10m`, :monosp:`2h` or :monosp:`100spp`. Only
         with :monosp:`checkpoint`. (Default: 60s)

    Attributes:
        sees_all: True, as it renders ``moving`` and lightweight shapes.
        progress: Called after each pass with the fraction done; it may raise or call ``cancel``.
        watch: Is shown the unfinished image after some of the passes
            (:class:`~mitsuba_ext.rendering.request.Watch`); ``None`` if nobody watches.
        masks: The names and types of the masks that it renders; none by default.
        coverage: What covers each pixel, after a render with masks
            (:class:`~mitsuba_ext.images.coverage.Coverage`).
        statistics: The statistics of the last render
            (:class:`~mitsuba_ext.rendering.statistics.RenderStatistics`).
    """

    sees_all = True
    masks: tuple[tuple[str, str], ...] = ()
    coverage: Coverage | None = None

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        self._own: dict[str, Any] = {}
        # Read before the base class reads them, as its errors do not name the plugin
        self.timeout = read_parameter(self.name, props, "timeout", -1.0)
        read_parameter(self.name, props, "hide_emitters", False)
        super().__init__(props)
        # Deprecated by Mitsuba, which warns in the log
        self.samples_per_pass = read_parameter(
            self.name, props, "samples_per_pass", NO_LIMIT, minimum=1
        )
        self.checkpoint = read_parameter(self.name, props, "checkpoint", "")
        if self.checkpoint:
            self.checkpoint_every = self._interval(props)
        self.progress: Callable[[float], None] | None = None
        self.watch: Watch | None = None
        self.statistics = RenderStatistics()
        self.is_cancelled = False

    # ---- What a subclass overrides ----

    def plan_learning(
        self, request: Request, spp: int, kernels: float = math.inf
    ) -> Learning:
        """See :class:`mitsuba_ext.rendering.staged.Staged`."""
        return Learning()

    def pace_stage(self, request: Request, spp: int) -> Stage | None:
        """See :class:`mitsuba_ext.rendering.staged.Staged`."""
        return None

    @property
    def sample_cost(self) -> int:
        """The approximate time of a sample relative to a path: passes take fewer samples
        if it is larger."""
        return 1

    @property
    def sample_bytes(self) -> SampleBytes:
        """The memory of a sample in a pass."""
        return SampleBytes()

    @property
    def channel_bytes(self) -> int:
        """The memory of a sample in a pass for the channels of light path expressions."""
        return 0

    def samples_per_set(self, spp: int) -> int:
        """How many of the ``spp`` samples of a pixel form a set, in a render with a timeout, which
        does not stop within a set."""
        return 1

    @property
    def needs_equal_samples(self) -> str:
        """Why all pixels must get the same number of samples; empty if they need not. The text
        ends a sentence in an error message, and says what to change."""
        return ""

    @property
    def default_spp(self) -> int:
        """Samples per pixel of a render that does not say how many; 0 for the sampler's number."""
        return 0

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: Learning
    ) -> Schedule:
        """Makes one stage for each entry of ``samples`` (samples per pixel): pilots, and the last
        one."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        """The parameters that ``str()`` shows besides the common ones: those that
        :meth:`parameter` has read, without empty texts."""
        return {key: value for key, value in self._own.items() if value != ""}

    def common_parameters(self) -> dict[str, Any]:
        """The parameters that ``str()`` shows of all integrators with this base class."""
        if not self.checkpoint:
            return {"timeout": self.timeout}
        every = self.checkpoint_every
        return {
            "timeout": self.timeout,
            "checkpoint": self.checkpoint,
            "checkpoint_every": f"{every.spp}spp" if every.spp else f"{every.seconds:g}s",
        }

    # ---- What Mitsuba calls ----

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True, **wishes):
        """Renders. ``wishes`` are further attributes of
        :class:`~mitsuba_ext.rendering.request.Request`, such as a ``timeout`` in the place of the
        parameter of that name."""
        spp = self._checked(scene, spp) or self.default_spp
        self.look_at(scene)
        sensor = camera.find_sensor(scene, sensor)
        if not isinstance(seed, mi.UInt32):
            seed = operator.index(seed)
        elif not dr.flag(dr.JitFlag.FreezingScope):  # when no array can be read
            seed = int(seed[0])
        own = {"timeout": self.timeout, "progress": self.progress, "watch": self.watch}
        known = [field.name for field in fields(Request)]
        for key in wishes:
            if key not in known:
                hint = did_you_mean(key, known)
                raise TypeError(f'"{self.name}": render() has no argument "{key}"{hint}')
        request = Request(
            scene, sensor, seed & 0xFFFFFFFF, spp, develop, evaluate, **{**own, **wishes}
        )
        if request.is_batch:
            with in_turn(self, sensor):
                return self.render_once(request)
        with in_turn(self, sensor, self._forget_cancel):
            image = self._render_kept(request) if self.checkpoint else self.render_once(request)
        return self.with_masks(image) if develop else image

    def render_once(self, request: Request) -> mi.TensorXf:
        """Renders the whole image, or one batch of a checkpointed render."""
        return rendering.render(self, request)

    @property
    def has_expressions(self) -> bool:
        """Whether it has channels of light path expressions."""
        return False

    def look_at(self, scene: mi.Scene) -> None:
        """Makes what the channels of :meth:`aov_names` need to know of a scene. A render calls it
        first."""

    @property
    def has_ray_aovs(self) -> bool:
        """Whether :meth:`sample_aovs` returns any channels."""
        return bool(self.aov_names())

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        """The values of the channels that :meth:`aov_names` names; none by default."""
        return []

    def mask_names(self) -> list[str]:
        """The channels of the masks. They follow the channels of :meth:`aov_names` in the image
        that :meth:`render` returns. The film does not hold them, because a film adds up samples."""
        return channel_names(self.masks)

    def with_masks(self, image: mi.TensorXf) -> mi.TensorXf:
        """The image that the film develops, with the channels of the masks of the last render."""
        if not self.masks or self.coverage is None:
            return image
        planes = self.coverage.channels(self.masks).values()
        pixels = np.concatenate([image.numpy(), np.stack([*planes], axis=2)], axis=2)
        return mi.TensorXf(pixels)

    def cancel(self) -> None:
        """Ends the running render after the current pass (call it from ``progress`` or from another
        thread); the image of the finished passes is returned."""
        self.is_cancelled = True

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        raise self.no_gradients()

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        raise self.no_gradients()

    def to_string(self) -> str:
        parameters = {**self.common_parameters(), **self.parameters()}
        lines = ",\n".join(f"  {key} = {value}" for key, value in parameters.items())
        return f"{self.name}[\n{lines}\n]"

    # ---- Checkpointed renders ----

    def _forget_cancel(self) -> None:
        """Forgets that an earlier render was cancelled. (Not in turn: whoever cancels a render that
        waits for its turn means this one.)"""
        self.is_cancelled = False

    def _interval(self, props: mi.Properties) -> Interval:
        text = read_parameter(self.name, props, "checkpoint_every", "60s")
        try:
            return Interval.parse(text)
        except ValueError as error:
            raise ValueError(f'"{self.name}": the parameter "checkpoint_every": {error}') from None

    def _render_kept(self, request: Request) -> mi.TensorXf:
        # Imported here: the modules of batches are above this one, and import it
        from ..long_renders.kept_render import KeptRender

        begin, sensor = time.perf_counter(), request.sensor
        shown = {**self.common_parameters(), **self.parameters()}
        shown = {key: value for key, value in shown.items() if key not in _NOT_OF_THE_IMAGE}
        kept = KeptRender(self, Path(self.checkpoint), self.checkpoint_every, str(shown))
        state, is_interrupted = kept.run(
            request.scene, sensor, request.seed, request.spp,
            request.timeout if request.is_timed else None, request.progress, request.watch,
        )  # fmt: skip
        totals = state.totals
        self.statistics = RenderStatistics(
            len(state.done), state.spp, time.perf_counter() - begin, totals.compile_seconds,
            totals.learning_seconds, dict(totals.rays), totals.connections,
            self.statistics.zero_radiance, totals.learned, dict(totals.effects),
            totals.memory_bytes, is_interrupted or self.is_cancelled, totals.tracing_seconds,
            dict(totals.kernels),
        )  # fmt: skip
        image = camera.develop(sensor.film(), request.develop, request.evaluate)
        self.coverage = state.coverage
        if is_interrupted:
            raise interrupted(self.name)
        return image

    def check_sampled(self) -> None:
        """
        Raises:
            ValueError: Another integrator draws the samples of this one, which has the parameter
                ``checkpoint``.
        """
        if self.checkpoint:
            raise ValueError(
                f'"{self.name}": the parameter "checkpoint" has no effect where another integrator '
                f"draws the samples: leave it out"
            )

    # ---- Helpers ----

    def parameter(
        self, props: mi.Properties, key: str, default: Any, none: str = "", **accepted: Any
    ) -> Any:
        """Reads and checks a parameter of the scene, which ``str()`` then shows: see
        :func:`mitsuba_ext.util.parameters.read_parameter`, also for what ``accepted`` can be.

        Parameters:
            none: What ``str()`` shows in the place of 0 and of an empty text.
        """
        value = read_parameter(self.name, props, key, default, **accepted)
        self._own[key] = (value or none) if none else value
        return value

    def _checked(self, scene: Any, spp: Any) -> int:
        """The argument ``spp`` of :meth:`render`.

        Raises:
            TypeError: An argument has another type.
            ValueError: The integrator or the scene is of another variant than the active one.
        """
        if type(scene).__name__ != "Scene":  # each variant has a class of this name
            raise TypeError(
                f'"{self.name}": a scene is needed (from mi.load_file or mi.load_dict), found an '
                f"object of type {type(scene).__name__}"
            )
        for what, value in ((f'"{self.name}"', self), ("the scene", scene)):
            if value.variant_name() != mi.variant():
                raise ValueError(
                    f'{what} was made in the variant "{value.variant_name()}", and the active one '
                    f'is "{mi.variant()}": select that one, or make it again'
                )
        try:
            return operator.index(spp)
        except TypeError:
            raise TypeError(
                f'"{self.name}": spp is {spp!r}; it must be a whole number'
            ) from None

    def no_gradients(self) -> NotImplementedError:
        """The error for a render with gradients."""
        return NotImplementedError(
            f'"{self.name}" does not compute gradients: use an integrator made for that, such as '
            f'"composed_prb" or "prb".'
        )
