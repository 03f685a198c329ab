"""Path guiding in primary sample space."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.planning.technique import ParameterReader
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.guided_directions.decisions import GuidedDirections
from mitsuba_ext.techniques.guided_directions.learner import GuideLearner
from mitsuba_ext.techniques.guided_directions.parameters import (
    Guided,
    GuidedFlights,
    GuidedRoulette,
)
from mitsuba_ext.techniques.weighted_points.connections import Connections


@registry.plugin
class PSSGuided(WalkIntegrator):
    r"""
    .. _integrator-pss_guided:

    Path guiding in primary sample space (:monosp:`pss_guided`)
    -----------------------------------------------------------

    A path tracer that learns from its first samples which random numbers lead the BSDF to sample
    directions from which light comes, and draws these numbers more often. It is unbiased, needs no
    knowledge of materials and lights, and guides all BSDFs in the same way. It is
    :monosp:`composed_path` with :monosp:`guided_directions`, whose page says how it learns.

    .. pluginparameters::

     * - regions
       - |string|
       - What a tree of samples belongs to: a region of :monosp:`surfaces`, or one of the
         :monosp:`tiles` of the film, as in the thesis. (Default: surfaces)
     * - tile
       - |int|
       - Edge of a tile in pixels; accepted only with :monosp:`tiles`. (Default: 16)
     * - bounces
       - |int|
       - Maximum number of directions of a path that are guided. Later bounces that are not worth
         the time are not guided. (Default: 6; 2 with tiles)
     * - nee_first_bounce
       - |bool|
       - Whether to connect the first vertex of a path to lights. False is the setting of the
         measurements in the thesis, for comparisons; point lights and parallel light are connected
         to in any case. (Default: true)
     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which the integrator learns; at most an eighth of
         all samples (a quarter in short renders). They count towards the image. With fewer than 3,
         nothing is guided. With a stratified sampler, pilots consist of whole passes, and can be
         longer. (Default: 32)
     * - save_learned, load_learned
       - |string|
       - Names of files. The render saves all that it has learned to :monosp:`save_learned`. With
         :monosp:`load_learned`, it takes no pilot samples, but uses what a render of the same
         scene, with the same parameters and film size, has saved, even from another camera.
         (Default: none)
     * - keep_learned
       - |bool|
       - Whether to keep what is learned for later renders of this process (frames, notebooks). A
         later render of the same scene, with the same parameters and film size, then takes no pilot
         samples, even from another camera. It learns again if it would take more pilot samples than
         the earlier render. An image then depends on the renders before it. (Default: false)
     * - always_guide
       - |bool|
       - Whether to guide all :monosp:`bounces`, even if the pilots show that guiding does not pay.
         (Default: false)
     * - max_memory
       - |float|
       - Memory for what is recorded and learned, in MiB. (Default: 512)
     * - clamp_direct, clamp_indirect
       - |float|
       - **Biased**: the largest light of a sample, see :class:`composed_path`. 0 clamps nothing.
         (Default: 0)
     * - caustics
       - |string|
       - Whether paths also connect to lights through smooth glass and mirrors
         (:monosp:`manifold`, or :monosp:`bounded_manifold`, which is **biased**), as in
         :class:`composed_path`. (Default: scattered)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** light arrives indirectly: through doors, windows and gaps, from lit corners, via
    mirrors and glossy objects. **Not when** most light is direct (use :monosp:`neepp` to choose
    among many lights), when an image has fewer than 16 samples per pixel, or for caustics of small
    lights seen through glass, which camera paths do not find.

    After a render, :monosp:`integrator.statistics.learned` describes what was learned, and
    :monosp:`integrator.guide` is the learned guide (see examples/learned_samples.py).

    Participating media are rendered as in :monosp:`volpath`. The directions in which fog scatters
    are guided, too, and in homogeneous media also how far a path flies before it scatters.
    Gradients are not supported (use :class:`composed_prb`); neither are scalar and
    polarized variants. Nested in :monosp:`moment`, it takes no pilot samples.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 2 (Eqs. 2.5 to 2.13, Algorithm 1): trees of
    film tiles. The regions of surfaces, the estimates, and the measurement of the gain are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="pss_guided">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'pss_guided',
            'max_depth': 8
    """

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        connects_first = self.reader(props)("nee_first_bounce", True)
        none = None if connects_first else ParameterReader.of_defaults(self.name, count=0)
        self.fill(
            props,
            directions=Guided(self.reader(props)),
            roulette=GuidedRoulette(),
            flights=GuidedFlights(),
            connections=Connections(none) if none else None,
            caustics=read_slot(self.name, props, "caustics"),
        )

    @property
    def learner(self) -> GuideLearner | None:
        """The learner of the last render, with its measurements; ``None`` if there was no pilot."""
        return self.learners.get("directions")

    @property
    def guide(self) -> GuidedDirections | None:
        """The guide that the last render has learned; ``None`` if nothing was guided."""
        return self.learner.guide if self.learner is not None else None
