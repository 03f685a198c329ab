"""Path guiding in primary sample space."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.composition.connections import Connections
from mitsuba_ext.composition.decision_parameters import ParameterReader
from mitsuba_ext.composition.directions import Guided
from mitsuba_ext.composition.roulette import GuidedRoulette
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.decisions.directions.guided_directions import GuidedDirections
from mitsuba_ext.learning.directions.guide_learner import GuideLearner
from mitsuba_ext.startup import registry


@registry.plugin
class PSSGuided(WalkIntegrator):
    r"""
    .. _integrator-pss_guided:

    Path guiding in primary sample space (:monosp:`pss_guided`)
    -----------------------------------------------------------

    A path tracer that learns from its first samples which random numbers choose directions from
    which light comes, and draws these more often. It is unbiased, knows nothing of materials or of
    lights, and guides all BSDFs alike. It is :monosp:`composed_path` with
    :monosp:`guided_directions`, whose page says how it learns.

    .. pluginparameters::

     * - regions
       - |string|
       - What has a tree of samples: :monosp:`surfaces`, or :monosp:`tiles` of the film, as in the
         thesis. (Default: surfaces)
     * - tile
       - |int|
       - Edge of a tile in pixels; known only with :monosp:`tiles`. (Default: 16)
     * - bounces
       - |int|
       - How many directions of a path are guided, at most; those that do not pay are left out.
         (Default: 6; 2 with tiles)
     * - nee_first_bounce
       - |bool|
       - Connect the first vertex of a path to lights? False is the setting in which the thesis
         measures, for comparisons; lights without extent are connected to all the same. (Default:
         true)
     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most a quarter of all. They count towards the
         image. With 0, or where they are fewer than 3, nothing is guided. A sampler that is
         stratified over all samples may need longer pilots. (Default: 32)
     * - save_learned, load_learned
       - |string|
       - Files. The first is written: what was learned, as a whole. The second is read in place of
         pilots: what a render of the same scene, with the same parameters and size of film, has
         saved. (Default: none)
     * - always_guide
       - |bool|
       - Guide all :monosp:`bounces`, also where the pilots show that it does not pay? (Default:
         false)
     * - max_memory
       - |float|
       - Memory for what is recorded and learned, in MiB. (Default: 512)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs,
         checkpoint.

    **Use it when** light comes by way of other surfaces: through doors, windows and gaps, from lit
    corners, along mirrors and glossy things. **Not when** most light is direct (use :monosp:`neepp`
    to choose among many lights), when an image has fewer than 16 samples per pixel, or for caustics
    of small lights seen through glass, which paths from the camera do not find.

    After a render, :monosp:`integrator.statistics.learned` tells what was found, and
    :monosp:`integrator.guide` holds it (see examples/learned_samples.py).

    Participating media are rendered as by :monosp:`volpath`; in them, directions are guided by
    tiles only. Gradients are not supported (use
    :monosp:`prb`), nor are scalar and polarized variants. Nested in :monosp:`moment` there is no
    pilot.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 2 (Eqs. 2.5 to 2.13, Algorithm 1): trees of
    film tiles. Regions of surfaces, the estimates, and the measurement of the gain are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="pss_guided">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'pss_guided',
            'max_depth': 8
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        connects_first = self.parameter(props, "nee_first_bounce", True)
        none = None if connects_first else ParameterReader.of_defaults(self.name, count=0)
        self.fill(
            props,
            directions=Guided(self.reader(props)),
            roulette=GuidedRoulette(),
            connections=Connections(none) if none else None,
        )

    @property
    def learner(self) -> GuideLearner | None:
        """Who learned in the last render, with what it measured; ``None`` where there was no
        pilot."""
        return self.learners.get("directions")

    @property
    def guide(self) -> GuidedDirections | None:
        """What the last render has learned; ``None`` where nothing was guided."""
        return self.learner.guide if self.learner is not None else None
