"""Adaptive sampling: more samples for pixels whose error is large."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.wrapping_integrator import WrappingIntegrator
from mitsuba_ext.rendering.adaptive_job import AdaptiveJob
from mitsuba_ext.rendering.render import render
from mitsuba_ext.startup import registry
from mitsuba_ext.util.parameters import MOST_SPP

#: The name of the channel that holds the sample counts.
_COUNTS = "samples"


@registry.plugin
class AdaptiveSampling(WrappingIntegrator):
    r"""
    .. _integrator-adaptive:

    Adaptive sampling (:monosp:`adaptive`)
    --------------------------------------

    Renders with a nested integrator, and takes more samples in pixels with a large error. The image
    is unbiased.

    .. pluginparameters::

     * - threshold
       - |float|
       - Relative error of a pixel (one standard error) at which it needs no more samples; 0 spends
         all samples. (Default: 0)
     * - pass_spp
       - |int|
       - Samples per pixel of the first pass, and of each later pass on average; 0 for an eighth of
         all samples. (Default: 0)
     * - count_samples
       - |bool|
       - Whether to add a channel :monosp:`samples` to the image, with the number of samples of each
         pixel. Not available with :monosp:`specfilm`. (Default: false)
     * - (Common parameters)
       - |float|
       - The parameters of :class:`StagedIntegrator`: timeout, checkpoint.
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or an integrator of this package. Its own
         :monosp:`timeout` is ignored.

    **Use it when** the error of the worst pixels matters, some parts of the image are much noisier
    than others, and samples there take no longer than elsewhere; or when the render should stop at
    a :monosp:`threshold`. **Not when** the mean error matters, noise is about the same everywhere,
    noisy pixels are also the slow ones (objects in front of an empty background), or a stratified
    sampler does better than independent samples. The page ``docs/results/adaptive.md`` of the
    source tree has figures: in the three scenes measured, at equal time, the 95th percentile of the
    errors was 0.93 to 1.21 times as large as with uniform sampling, and the mean error 1.06 to 1.31
    times.

    The sensor's number of samples (:monosp:`spp`) is the mean over all pixels. The first pass takes
    the same number of samples in each pixel, and so do the pilot passes of a nested integrator that
    learns. Each later pass distributes its samples in proportion to the power 4/3 of each pixel's
    relative standard deviation, which is estimated from all earlier passes in the pixel and its
    eight neighbours. The power 4/3 minimises the sum of the fourth powers of the relative errors.
    In each pass, every pixel gets at least an eighth of the mean number of samples. Relative errors
    are defined as in relMSE: relative to the square root of the pixel's squared brightness plus a
    hundredth of the squared mean of the image.

    **Why it is unbiased.** The mean over samples is biased if their number depends on their values:
    a pixel whose rare bright path no sample has found yet looks converged, gets few samples and
    stays dark. Here, each pass has a weight, and adds that weight times the mean of its own
    samples. The weight and the number of samples are decided before the pass. The expected mean of
    each pass is therefore right, whatever the earlier passes found, and the weights of all passes
    add up to one. With a :monosp:`threshold`, the last pass of a pixel is also decided before it
    begins: its number of samples follows from the variance estimated from earlier passes. A pixel
    can therefore miss the threshold: if no sample in its neighbourhood has found the bright paths
    when its last pass is decided, it stays noisier. The weight of the first pass is half its share
    of the samples, because it gives noisy pixels no more samples than others. A bright spot from an
    early pass stays in the image, because nothing that a pass has added is removed. The source
    renders a pixel again if its deviation was far above the estimate, which is biased. Here,
    estimates contain the pixel's own earlier samples, and such pixels hardly occur.

    With a reconstruction filter wider than a pixel, samples are scaled such that all parts of the
    image plane have the same density. As always, the film divides by the sum of filter weights,
    which is a random number except with the box filter.

    With a stratified sampler, each set of :monosp:`pass_spp` / 4 samples is stratified separately.
    Mitsuba's :monosp:`stratified` is refused: the random numbers of its sets depend on each other,
    which biases images (by up to 12 % in a quarter of an image), also with :monosp:`path`. Use
    :monosp:`multijitter`.

    Integrators that add light to pixels other than the pixel of the camera ray are refused
    (:monosp:`light_tracer`, Markov chains, and :monosp:`bdpt` unless its :monosp:`light_image` is
    off). Weighted point sets for camera rays (:monosp:`weighted_numbers`) are refused as well.
    Nested in :monosp:`moment` or :monosp:`aov`, it returns the samples of its nested integrator,
    without adaptive sampling. Gradients are not supported (use :class:`composed_prb`).

    Source: D. Cline, PhD thesis, 2007, section 5.5; the parameters have the names of Mitsuba's pull
    request 1731. D. Kirk, J. Arvo, *Unbiased Sampling Techniques for Image Synthesis*, SIGGRAPH
    1991 (the bias). C. Stein, *A Two-Sample Test for a Linear Hypothesis Whose Power is Independent
    of the Variance*, Annals of Mathematical Statistics 16(3), 1945 (a last sample whose size is
    decided in advance). The weights of the passes are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="adaptive">
                <integer name="pass_spp" value="16"/>
                <integrator type="path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'adaptive',
            'pass_spp': 16,
            'nested': {
                'type': 'path',
                'max_depth': 8
            }
    """

    #: The weights of its passes add up to one in the film: they are not numbers of samples.
    film_counts_samples = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.threshold = self.parameter(props, "threshold", 0.0, minimum=0.0)
        self.pass_spp = self.parameter(
            props, "pass_spp", 0, none="an eighth", minimum=0, maximum=MOST_SPP
        )
        self.counts_samples = self.parameter(props, "count_samples", False)
        self.refuse_equal_samples("pixels cannot get different numbers of samples of {nested}")

    def accepts(self, nested: mi.SamplingIntegrator) -> bool:
        return not self.is_of_this_kind(nested)

    @property
    def needs_equal_samples(self) -> str:
        return "they are distributed already"

    def render_once(self, request):
        return render(self, request, AdaptiveJob)

    def aov_names(self) -> list[str]:
        return [*self.nested.aov_names(), *([_COUNTS] if self.counts_samples else [])]

    @property
    def has_ray_aovs(self) -> bool:
        return self.counts_samples or super().has_ray_aovs

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        """The AOVs of the nested integrator. The sample count is 0 here: it is known after the
        render only."""
        found = super().sample_aovs(scene, sampler, ray)
        return [*found, *([mi.Float(0)] if self.counts_samples else [])]
