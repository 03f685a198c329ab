"""Energy redistribution path tracing."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.metropolis_integrator import MetropolisIntegrator
from mitsuba_ext.bases.path_mutations import (
    MOST,
    camera_samples,
    path_target,
    read_switches,
)
from mitsuba_ext.estimators.chains.noise_filters import NoiseFilters
from mitsuba_ext.estimators.chains.path_target import PathTarget
from mitsuba_ext.estimators.chains.redistribution import (
    RedistributionRender,
    RedistributionSettings,
)  # fmt: skip
from mitsuba_ext.estimators.chains.small_steps import SmallSteps
from mitsuba_ext.estimators.chains.target import ImageTarget
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.startup import registry

#: The parameters that only chains of primary samples have.
_PRIMARY = (
    "bidirectional", "next_event", "proposal_filter", "most_consecutive",
)  # fmt: skip


@registry.plugin
class EnergyRedistribution(MetropolisIntegrator):
    r"""
    .. _integrator-erpt:

    Energy redistribution path tracing (:monosp:`erpt`)
    ---------------------------------------------------

    Takes independent samples, and distributes the excess energy of the outliers among them by short
    Markov chains.

    .. pluginparameters::

     * - mutations
       - |string|
       - What the chains mutate: :monosp:`primary`, the random numbers of a sample, or
         :monosp:`path`, the vertices of a light path (:class:`mlt`). With :monosp:`path`, each
         sample is a single path, made by one of the techniques of :class:`bdpt`. (Default: primary)
     * - bidirectional
       - |bool|
       - Whether chains sample the paths of :class:`bdpt`; if not, they sample the paths of
         :monosp:`path`. A mutation of :class:`bdpt` takes about three times as long, and finds
         caustics of small lamps. (Default: false)
     * - outliers
       - |float|
       - A sample is an outlier if it is more than this many times as bright as its part of the
         image. Its energy above this limit goes to chains; all other energy is added to the film as
         in plain Monte Carlo. 0 gives all energy to chains, as the original does. (Default: 10;
         with paths 0)
     * - mutations_per_pixel
       - |int|
       - Number of mutations per pixel if all energy is redistributed. If only a fraction of the
         energy is, the same fraction of mutations is made. 0 stands for ``spp``. (Default: 0)
     * - chain_length
       - |int|
       - Number of mutations of each chain. (Default: 100)
     * - luminance_samples
       - |int|
       - Minimum number of independent samples that first measure the brightness of the image and of
         its parts. (Default: 100000)
     * - proposal_filter
       - |int|
       - Makes the noise of the chains' light more even, but is **biased**: each pixel is multiplied
         by the expected number of mutations that are proposed there, and divided by their actual
         number. The expected number is the mean over a square that is this many pixels wide; the
         thesis uses 7. 0 stands for no filter. (Default: 0)
     * - most_consecutive
       - |int|
       - Removes specks, but is **biased** towards black: of the consecutive visits of a chain to a
         pixel, only this many are added to the image. The thesis uses 10 or 20. 0 stands for all.
         (Default: 0)
     * - bidirectional_mutation
       - |bool|
       - With :monosp:`mutations=path`: whether to replace a part of the path by a random walk from
         both sides. (Default: false)
     * - lens_perturbation, multi_chain_perturbation, caustic_perturbation
       - |bool|
       - With :monosp:`mutations=path`: as in :class:`mlt`. (Default: true)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`MetropolisIntegrator`: direct_samples, chain_file, next_event,
         max_depth, rr_depth, hide_emitters, timeout, aovs, checkpoint.

    ``spp`` is the number of independent samples per pixel.

    **Use it when** an image of :monosp:`path` is fine except for bright spots that need a very
    large number of samples: caustics seen through water or glass, light through a small hole; with
    ``bidirectional``, when the same holds for :class:`bdpt`. With ``mutations=path``, also for
    caustics of small lamps, and light through gaps. **Not when** there are no bright spots: it is
    then :monosp:`path` at a somewhat higher cost.

    Chains change the random numbers of a sample by small steps (:class:`pssmlt`), and deposit the
    same energy at each visit. They begin at independent samples, so there is no start-up bias,
    whatever their length.

    With :monosp:`mutations=path`, chains use lens and caustic perturbations. They sample paths of
    up to 32 segments; camera samples find longer ones. The parameters :monosp:`bidirectional` and
    :monosp:`next_event` and the filters must not be given then.
    Participating media are refused.

    Source: D. Cline, PhD thesis, 2007, chapter 8; D. Cline, J. Talbot, P. Egbert, *Energy
    Redistribution Path Tracing*, ACM Transactions on Graphics 24(3), 2005; B. Bitterli, W. Jarosz,
    *Selectively Metropolised Monte Carlo Light Transport Simulation*, ACM Transactions on Graphics
    38(6), 2019.

    .. tabs::
        .. code-tab:: xml

            <integrator type="erpt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'erpt',
            'max_depth': 8
    """

    #: Chains of bidirectional paths cost more than they gained on most scenes
    is_bidirectional = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.mutations = self.parameter(
            props, "mutations", "primary", choices=("primary", "path")
        )
        if self.has_paths:
            self._refuse_primary(props)
        # Single paths are noisier than samples of random walks: nearly all of them are outliers
        outliers = 0.0 if self.has_paths else 10.0
        self.outliers = self.parameter(props, "outliers", outliers, minimum=0.0)
        self.mutations_per_pixel = self.parameter(
            props, "mutations_per_pixel", 0, minimum=0, maximum=1 << 24
        )
        self.chain_length = self.parameter(
            props, "chain_length", 100, minimum=1, maximum=1 << 20
        )
        self.luminance_samples = self.read_luminance_samples(props)
        self.switches = read_switches(self, props, bidirectional=False) if self.has_paths else None
        self.steps = SmallSteps()
        self.filters = NoiseFilters() if self.has_paths else self._read_filters(props)

    def _read_filters(self, props: mi.Properties) -> NoiseFilters:
        width = self.parameter(props, "proposal_filter", 0, minimum=0, maximum=1 << 10)
        most = self.parameter(props, "most_consecutive", 0, minimum=0, maximum=1 << 20)
        if self.bidirectional and (width or most):
            name = "proposal_filter" if width else "most_consecutive"
            raise ValueError(
                f'"{self.name}": "{name}" needs "bidirectional" to be false: proposals of '
                f"bidirectional paths belong to many pixels"
            )
        return NoiseFilters(width, most)

    @property
    def has_paths(self) -> bool:
        """Whether chains change light paths, not primary samples."""
        return self.mutations == "path"

    def _refuse_primary(self, props: mi.Properties) -> None:
        for key in _PRIMARY:
            if key in props:
                raise ValueError(
                    f'"{self.name}": "{key}" is for chains of primary samples; it must '
                    f'not be given where "mutations" is "path"'
                )

    def schedule(self, request, samples, learning):
        if not self.has_paths or self.max_depth <= MOST:
            return super().schedule(request, samples, learning)
        return camera_samples(self, self.setting(request, sum(samples)))

    def target(self, setting):
        if self.has_paths:
            return path_target(self, setting, self.switches)
        return super().target(setting)

    def chain_render(
        self, target: ImageTarget | PathTarget, request: Request, *render: Any
    ) -> RedistributionRender:
        settings = RedistributionSettings(
            self.chain_length, self.mutations_per_pixel, self.outliers, self.luminance_samples,
            self.steps, self.filters, self.state_file(target, request.seed),
        )  # fmt: skip
        return RedistributionRender(settings, self, target, request, *render)

    def parameters(self) -> dict[str, Any]:
        shown = super().parameters()
        # With mutations of paths, mutations of primary samples have no effect
        return {k: v for k, v in shown.items() if not (self.has_paths and k in _PRIMARY)}
