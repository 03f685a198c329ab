"""The variance of each pixel, for any integrator, from independent batches."""

from __future__ import annotations

import time
from collections.abc import Callable
from textwrap import indent

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.rendering.batches import Batches, batch_seeds, each_batch, sample_count
from mitsuba_ext.rendering.camera import develop as develop_film
from mitsuba_ext.rendering.camera import find_sensor
from mitsuba_ext.rendering.request import Watch
from mitsuba_ext.rendering.statistics import RenderStatistics
from mitsuba_ext.rendering.turns import in_turn, let_others, tell
from mitsuba_ext.scene.nesting import refuse_checkpoint
from mitsuba_ext.startup import registry
from mitsuba_ext.util.parameters import MOST_SPP, read_parameter

_PREFIX = "variance."

_MOST_BATCHES = 1 << 16


# Not a SamplingIntegrator: "aov" and "moment" call sample() of nested integrators, which this one
# lacks. So they refuse it when the scene is loaded.
@registry.plugin
class Variance(mi.AdjointIntegrator):
    r"""
    .. _integrator-variance:

    Variance from batches (:monosp:`variance`)
    ------------------------------------------

    Renders the nested integrator in independent batches, each with a seed of its own. The image is
    the mean of the batches, and the channels :monosp:`variance.R`, :monosp:`variance.G` and
    :monosp:`variance.B` estimate the variance of this mean, which is the squared standard error of
    each pixel.

    .. pluginparameters::

     * - batches
       - |int|
       - Number of batches, 2 to 65536. (Default: 16)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one. Any integrator that renders an image is
         accepted.

    **Use it when** you need error bars, a noise map for a denoiser, or weights for comparing
    images, and the integrator does not work with Mitsuba's :monosp:`moment`, such as
    :monosp:`ptracer` or one that learns. **Not when** the nested integrator benefits from one long
    render: it learns again in each batch (with a sixteenth of the samples, by default), and a
    structured sampler stratifies the samples of each batch only. Otherwise, the only extra cost is
    reading each batch back: choose batches of several samples per pixel.

    **Meaning of the variance.** It is the variance of the image, which is the mean of all samples,
    and not the variance of one sample (for an independent sampler and the box filter, the latter is
    variance · spp). A variance estimated from n batches itself has a relative standard error of
    about √(2 / (n - 1)): 37 % from 16 batches, 13 % from 128; more if the noise has heavy tails.
    Average it over pixels before you rely on it. With a reconstruction filter wider than a pixel,
    the errors of neighbouring pixels are correlated: a mean over pixels then has more variance than
    independent pixels would give it. Each batch divides by the filter weights of its own samples.
    This biases pixels at an edge: by up to 1 % of its contrast with one sample per batch, and by a
    quarter of that with four. Filters with negative lobes, such as :monosp:`lanczos`, need at least
    four samples per batch; the box filter has no bias.

    **Samples.** Each batch takes spp / batches samples per pixel, rounded up (with stratified
    samplers, to a number that they support). It renders at least 2 batches, and as many as are
    needed to reach spp. There can therefore be fewer batches than requested; with more than two,
    the excess is less than one batch. At least 2 samples per pixel are required. A
    :monosp:`timeout` of the nested integrator applies to each batch.

    **Channels.** Names follow the film: for the pixel format :monosp:`luminance` and in monochrome
    variants there is only :monosp:`variance.Y`, for :monosp:`xyz` there are :monosp:`variance.X`,
    :monosp:`variance.Y` and :monosp:`variance.Z`. Alpha has no variance channel. The means of the
    nested integrator's AOVs come before these channels. Set the film's :monosp:`component_format`
    to :monosp:`float32`: in files written by :monosp:`film.write`, the default half precision
    rounds variances below 6e-8 to zero.

    Ctrl-C, and :monosp:`cancel()` after the running batch, keep the image of the finished batches
    (after a single batch, the variance is NaN: unknown). :monosp:`progress` is called after each
    batch; :monosp:`nested` is the nested integrator. :monosp:`statistics` is the sum over the
    batches if the nested integrator has statistics. Gradients are not supported; neither are
    :monosp:`specfilm`, and scalar and polarized variants. It cannot be nested in :monosp:`aov` or
    :monosp:`moment`; nest these in it instead.

    Source: batch means are textbook statistics; the update follows B. P. Welford, *Note on a Method
    for Calculating Corrected Sums of Squares and Products*, Technometrics 4(3), 1962.

    .. tabs::
        .. code-tab:: xml

            <integrator type="variance">
                <integer name="batches" value="32"/>
                <integrator type="ptracer">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'variance',
            'batches': 32,
            'nested': {
                'type': 'ptracer',
                'max_depth': 8
            }
    """

    #: True, because each render checks whether the nested integrator supports motion.
    sees_all = True

    #: Each pixel of its film has the weight one, and not the number of samples.
    film_counts_samples = False

    def __init__(self, props: mi.Properties) -> None:
        # Without properties, because the base class would read some that have no effect here
        super().__init__(mi.Properties(props.plugin_name()))
        self.name = props.plugin_name()
        self.batch_count = read_parameter(
            self.name, props, "batches", 16, minimum=2, maximum=_MOST_BATCHES
        )
        self.nested = self._nested(props)
        self.progress: Callable[[float], None] | None = None
        self.watch: Watch | None = None
        self.statistics = RenderStatistics()
        self.is_cancelled = False
        self._aov_names = [
            *self.nested.aov_names(),
            *(_PREFIX + color for color in ("Y" if mi.is_monochromatic else "RGB")),
        ]

    def _nested(self, props: mi.Properties) -> mi.Integrator:
        children = [child for _, child in props.objects()]
        if len(children) != 1 or not isinstance(children[0], mi.Integrator):
            found = ", ".join(child.class_name() for child in children) or "none"
            raise ValueError(
                f'"{self.name}": exactly one integrator must be nested in it; found {found}'
            )
        # type(self) and not ``Variance``, which is another class once another variant is selected
        if isinstance(children[0], type(self)):
            raise ValueError(f'"{self.name}": cannot be nested in another "{self.name}"')
        refuse_checkpoint(self.name, children[0])
        if getattr(children[0], "masks", ()):
            raise ValueError(
                f'"{self.name}": the masks in the parameter "aovs" of the nested integrator are '
                f"not mean values, and have no variance: leave them out here"
            )
        taken = {_PREFIX + color for color in "RGBXYZ"} & set(children[0].aov_names())
        if taken:
            raise ValueError(
                f'"{self.name}": the nested integrator has an AOV of the name "{min(taken)}"'
            )
        return children[0]

    # ---- What Mitsuba calls ----

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        sensor = find_sensor(scene, sensor)
        with in_turn(self, sensor, self._forget_cancel):
            return self._render(scene, sensor, seed, spp, develop, evaluate)

    def _forget_cancel(self) -> None:
        self.is_cancelled = False

    def _render(self, scene, sensor, seed, spp, develop, evaluate) -> mi.TensorXf:
        start = time.perf_counter()
        self.statistics = RenderStatistics()
        film = sensor.film()
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{self.name}": does not work with the film "{film.class_name()}": use an '
                f'"hdrfilm".'
            )
        batch_count, batch_spp = self._plan(sensor, spp)
        seeds = batch_seeds(seed, batch_count)
        batches = None
        try:
            for batches in each_batch(self.nested, scene, sensor, batch_spp, seeds):
                self._count(batch_spp)
                if self.watch is not None and self.watch.is_due():
                    self._fill(film, batches)
                    self.watch.show(film, batches.spp, self.statistics)
                if self.progress is not None:
                    tell(self.progress, batches.count / batch_count)
                let_others()
                if self.is_cancelled:
                    break
        finally:
            # Also after an exception, the film gets the mean of the finished batches
            if batches is not None:
                self._fill(film, batches)
            self.statistics.interrupted = batches is None or batches.count < batch_count
            self.statistics.seconds = time.perf_counter() - start
        return develop_film(film, develop, evaluate)

    def aov_names(self) -> list[str]:
        """The channel names for the film of the last render; before the first render, those for an
        RGB (or monochrome) film."""
        return self._aov_names

    def cancel(self) -> None:
        """Ends the running render after the current batch (call it from ``progress`` or from
        another thread); the image of the finished batches is returned."""
        self.is_cancelled = True

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        raise self._no_gradients()

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        raise self._no_gradients()

    def to_string(self) -> str:
        nested = indent(str(self.nested), "  ").lstrip()
        return f"{self.name}[\n  batches = {self.batch_count},\n  integrator = {nested}\n]"

    # ---- Helpers ----

    def _plan(self, sensor: mi.Sensor, spp: int) -> tuple[int, int]:
        """The number of batches, and the samples per pixel of each."""
        spp = spp or sample_count(sensor, 0)
        if spp > MOST_SPP:
            raise ValueError(f'"{self.name}": spp is {spp}; it must be at most {MOST_SPP}')
        if spp < 2:
            raise ValueError(
                f'"{self.name}": a variance needs at least 2 samples per pixel, found spp = {spp}; '
                f'set "spp", or "sample_count" of the sampler'
            )
        batch_spp = sample_count(sensor, -(-spp // self.batch_count))
        return max(2, -(-spp // batch_spp)), batch_spp

    def _fill(self, film: mi.Film, batches: Batches) -> None:
        """Fills the film with mean and variance."""
        base = batches.image_channel_count
        names, aovs = list(batches.channels[:base]), list(batches.channels[base:])
        has_alpha = names[-1] == "A"
        colors = names[:-1] if has_alpha else names
        variances = [_PREFIX + color for color in colors]
        self._aov_names = [*aovs, *variances]

        image = batches.mean[..., : len(colors)]
        layers = [
            _as_rgb(image, colors),
            batches.mean[..., base - 1 : base] if has_alpha else None,
            np.ones_like(image[..., :1]),  # the weight that the film divides by
            batches.mean[..., base:],
            batches.variance[..., : len(colors)],
        ]
        pixels = np.concatenate([layer for layer in layers if layer is not None], axis=2)
        film.prepare(self._aov_names)
        tensor = mi.TensorXf(pixels.astype(np.float32))
        film.put_block(mi.ImageBlock(tensor, offset=film.crop_offset()))

    def _count(self, batch_spp: int) -> None:
        """Adds a batch to the statistics."""
        total, batch = self.statistics, getattr(self.nested, "statistics", None)
        memory = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
        total.memory = max(total.memory, memory)
        if not isinstance(batch, RenderStatistics):
            total.passes += 1
            total.spp += batch_spp
            return
        black = total.zero_radiance * total.spp + batch.zero_radiance * batch.spp
        for key in (
            "passes", "spp", "compile_seconds", "tracing_seconds", "learning_seconds", "connections"
        ):  # fmt: skip
            setattr(total, key, getattr(total, key) + getattr(batch, key))
        total.rays = {key: total.rays[key] + batch.rays[key] for key in total.rays}
        total.zero_radiance = black / max(1, total.spp)
        total.learned = batch.learned

    def _no_gradients(self) -> NotImplementedError:
        return NotImplementedError(
            f'"{self.name}" does not compute gradients: use an integrator made for that, such as '
            f'"prb", without it.'
        )


def _as_rgb(image: np.ndarray, colors: list[str]) -> np.ndarray:
    """The RGB values from which the film develops ``image``. A film stores RGB, and converts it to
    its pixel format when it is developed."""
    if colors == ["R", "G", "B"]:
        return image
    if colors == ["Y"]:
        return np.repeat(image, 3, axis=2)  # the weights of the luminance add up to 1
    to_xyz = mi.srgb_to_xyz(mi.Color3f(np.eye(3, dtype=np.float32))).numpy().astype(np.float64)
    return image @ np.linalg.inv(to_xyz).T
