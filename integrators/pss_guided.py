"""Path guiding in primary sample space."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.composition.guide_parameters import Guiding
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.decisions.directions.guided_directions import LaterConnections
from mitsuba_ext.decisions.learner import Learner
from mitsuba_ext.transport.path_decisions import EmitterSampling


@registry.plugin
class PSSGuided(WalkIntegrator):
    r"""
    .. _integrator-pss_guided:

    Path guiding in primary sample space (:monosp:`pss_guided`)
    -----------------------------------------------------------

    A path tracer that learns from its first samples which random numbers choose directions from
    which light comes, and draws these more often. It is unbiased, knows nothing of materials or of
    lights, and guides all BSDFs alike.

    .. pluginparameters::

     * - regions
       - |string|
       - What has a tree of samples: :monosp:`surfaces` (voxels, and the sides of the surfaces in
         them; all bounces use the trees of the places where they happen), or :monosp:`tiles` (of
         the film, as in the thesis; the samples of a path's first bounce decide about the tree of
         the second, and so on). (Default: surfaces)
     * - tile
       - |int|
       - Edge of a tile in pixels; known only with :monosp:`tiles`. (Default: 16)
     * - bounces
       - |int|
       - How many directions of a path are guided, at most; those that do not pay are left out. At
         most 5 with tiles. (Default: 6; 2 with tiles)
     * - nee_first_bounce
       - |bool|
       - Connect the first vertex of a path to lights? False is the setting in which the thesis
         measures, for comparisons; lights without extent are connected to all the same.
         (Default: true)
     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most a quarter of all. They count towards the
         image. With 0, or where they are fewer than 3, nothing is guided. A sampler that is
         stratified over all samples may need longer pilots. (Default: 32)
     * - always_guide
       - |bool|
       - Guide all :monosp:`bounces`, also where the pilots show that it does not pay? Then
         images of different seeds, or the frames of an animation, are all made in the same way and
         by the same kernels. (Default: false)
     * - max_memory
       - |float|
       - Memory for what is recorded and learned, in MiB. Where the pilots need more, they record
         a part of their paths. Trees of tiles of a few pixels come on top. (Default: 512)
     * - max_depth
       - |int|
       - Longest path in the image, -1 for no limit. 1 shows visible emitters only, 2 adds direct
         illumination, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth at which Russian roulette begins. A path is more likely to survive the more it
         is expected to bring, compared to its pixel: throughput times the radiance that the pilots
         found around the place. Where the pilots show that this does not pay, and with
         :monosp:`tiles`, the throughput decides as in :monosp:`path` (what guiding adds to it does
         not count). (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. It is kept as by :monosp:`neepp`.
         (Default: -1)
     * - aovs
       - |string|
       - Arbitrary output variables, in the syntax of Mitsuba's :monosp:`aov` integrator, such as
         :monosp:`depth:depth,nn:sh_normal`. (Default: none)

    **Use it when** light comes by way of other surfaces: through doors, windows and gaps, from lit
    corners, along mirrors and glossy things. **Not when** most light is direct (use
    :monosp:`neepp` to choose among many lights), when an image has fewer than 16 samples per pixel,
    or for caustics of small lights seen through glass, which paths from the camera do not find.

    Each tree is a k-d tree over the two numbers by which a BSDF chooses a direction. Its density is
    what paths brought on average from there on, drawn to what was found in larger surroundings
    where there are few samples, and mixed with uniform numbers. The second of three pilots shows
    what the trees of the first are worth. From that follows how much of the samples trees decide
    (40, 60 or 80 %), how many bounces are worth the time of guiding them, and which roulette is
    better; if no guide pays, learning ends there, and the rest is rendered as by :monosp:`path`.
    After a render, :monosp:`integrator.statistics.learned` tells, and :monosp:`integrator.guide`
    holds what was learned (see examples/learned_samples.py).

    The number that chooses a lobe of the BSDF is not guided, and neither are mirrors and glass
    (with tiles they are, in vain). Participating media are ignored, as by :monosp:`path`. Gradients
    are not supported (use :monosp:`prb`), nor are scalar and polarized variants. Nested in
    :monosp:`moment` there is no pilot.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 2 (Eqs. 2.5 to 2.13, Algorithm 1): trees of
    film tiles. J. Vorba, J. Křivánek, *Adjoint-Driven Russian Roulette and Splitting in Light
    Transport Simulation*, 2016: roulette (without splitting). Regions of surfaces, the estimates,
    and the measurement of the gain are ours.

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
        self.guiding = Guiding(self, props)
        self.nee_first_bounce = self.parameter(props, "nee_first_bounce", True)

    @property
    def guide(self):
        """What the last render has learned (``GuidedDirections``); ``None`` where nothing was
        guided."""
        return self.guiding.guide

    @property
    def learner(self):
        """Who learned in the last render (``GuideLearner``), with what it measured; ``None``
        where there was no pilot."""
        return self.guiding.learner

    def decisions(self, scene: mi.Scene, seed: int) -> dict[str, Any]:
        if self.nee_first_bounce:
            return {}
        return {"next_event": LaterConnections(EmitterSampling())}

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        return self.guiding.pilots(scene, spp, self.max_depth)

    def learners(self, scene: mi.Scene, sensor: mi.Sensor, samples: int) -> list[Learner]:
        return self.guiding.learners(
            scene, sensor, samples, self.max_depth, self.rr_depth
        )

    def parameters(self) -> dict[str, Any]:
        return {**self.guiding.parameters(), "nee_first_bounce": self.nee_first_bounce}
